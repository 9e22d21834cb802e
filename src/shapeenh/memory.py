"""Memory that a process keeps. Imports nothing of ours."""

from __future__ import annotations

import ctypes
import platform

# Parameters of `mallopt` (glibc's malloc.h), and what asks it to keep what was freed.
_TRIM_THRESHOLD, _MMAP_MAX, _ARENA_MAX = -1, -4, -8
_KEEPING = {
    _MMAP_MAX: 0,  # large blocks from the heap, not from mappings that end with them
    _TRIM_THRESHOLD: -1,  # the heap's free end is not handed back
    _ARENA_MAX: 1,  # one heap: those of other threads are too small for large blocks
}


def keep_memory() -> bool:
    """Ask the C library to keep what is freed, for this process, instead of handing it back to the system each time.

    Else, on Linux, every large array is written into new pages, and each page is filled with zeros at its first touch:
    up to half the time of a large image or of a gradient (docs/skipping.md, `python -m benchmarks.pages`). No number
    of a picture changes. The process then holds what it needed at most at one time, and compiling takes 1.3 times as
    long, since threads share one heap. To be called before the first computation: threads that have a heap of their own
    by then keep it.

    Returns: whether the C library took it. False where there is no glibc (macOS, Windows, musl); nothing changes then.

    >>> import shapeenh as se
    >>> se.keep_memory()
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    library = ctypes.CDLL(None)
    return all([library.mallopt(parameter, value) == 1 for parameter, value in _KEEPING.items()])
