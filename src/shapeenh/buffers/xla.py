"""XLA idioms that the rasteriser and the resolve are built from."""

from __future__ import annotations

import jax
from jax.experimental.xla_metadata import set_xla_metadata

from shapeenh.fusion import stored


def take(array, index):
    """array[index] along the first axis, the indices known to be in range and not negative."""
    return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def apart(always, function, *args):
    """`function(*args)` stored, as by `fusion.stored`, of what has no derivative, and sooner compiled: on the CPU a
    call that XLA is told not to inline needs no second branch. Other backends are not known to keep such calls."""
    if jax.default_backend() != "cpu":
        return stored(always, function, *args)

    def called(*args):
        with set_xla_metadata(inlineable=None):  # what is called in there may well be inlined
            return function(*args)

    with set_xla_metadata(inlineable="false"):
        return jax.jit(called)(*args)
