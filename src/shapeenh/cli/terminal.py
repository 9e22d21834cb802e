"""Timing, progress and messages on the user's terminal."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from pathlib import Path

import jax


class Stopwatch:
    """Times the stages and says what goes on, and how long compiling took, on stderr when that is a terminal.

    With `repeat`, a compiled stage is run twice, so that its compile time stands apart from its run time.
    """

    def __init__(self, *, repeat: bool):
        self.repeat = repeat
        self.seconds: dict[str, float | dict[str, float]] = {}

    def once(self, name: str, work):
        result, self.seconds[name] = self._timed(name, work)
        return result

    def stage(self, name: str, work):
        result, first = self._timed(name, work)
        if self.repeat:
            result, run = self._timed(name, work)
            self.seconds[name] = {"compile": round(max(first - run, 0.0), 6), "run": run}
        else:
            self.seconds[name] = first
        return result

    @staticmethod
    def _timed(name: str, work):
        if sys.stderr.isatty():
            print(f"shapeenh: {name} ...", file=sys.stderr)
        with _compiling() as compiled:
            start = time.perf_counter()
            result = jax.block_until_ready(work())
            seconds = round(time.perf_counter() - start, 6)
        if sys.stderr.isatty() and sum(compiled) > 0.1:
            print(f"shapeenh: {name}: {seconds:.1f} s, of which {sum(compiled):.1f} s compiling", file=sys.stderr)
        return result, seconds


@contextlib.contextmanager
def _compiling():
    """A list that grows by the seconds of every compilation."""
    seconds: list[float] = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event in ("/jax/core/compile/jaxpr_to_mlir_module_duration", "/jax/core/compile/backend_compile_duration"):
            seconds.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield seconds
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def use_compilation_cache() -> None:
    """Keep compiled code between runs, unless JAX is told otherwise by its own environment variable."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "shapeenh"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"shapeenh: warning: {one_line(message)}", file=sys.stderr)


def one_line(error) -> str:
    text = str(error) or type(error).__name__
    return " ".join(text.split())
