"""Three XLA idioms that the rasteriser and the resolve are built from.

Imports nothing of ours. They exist because XLA re-fuses: a producer is computed again inside every consumer, and
`optimization_barrier` does not stop that. Measured on CPU, a border in the right place halves a frame.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax


def take(array, index):
    """array[index] along the first axis, the indices known to be in range and not negative."""
    return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def unknown_truth(*arrays):
    """True, but not for the compiler, as long as one of the (non-empty) arrays is not a constant of the program.

    From all of them, because somebody's jit may close over some: then they are constants, and a border that rests on
    one of those alone is folded away.
    """
    total = jnp.int32(0)
    for array in arrays:
        first = array[(0,) * array.ndim]
        if jnp.issubdtype(first.dtype, jnp.floating):
            first = lax.bitcast_convert_type(lax.convert_element_type(first, jnp.float32), jnp.int32)
        total = total + lax.convert_element_type(first, jnp.int32)
    return total >= jnp.iinfo(jnp.int32).min


def stored(always, function, *args):
    """Evaluate `function` once and store what it returns.

    `always` is a predicate that is true at run time but unknown at compile time: a conditional on it is a border that
    fusion does not cross.
    """
    shapes = jax.eval_shape(function, *args)

    def never(*_):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    return lax.cond(always, function, never, *args)


def lower_bound(ends, first, count, rank):
    """The first i < count with ends[first + i] > rank, for an ascending stretch of `ends`; a branchless bisection,
    all ranks at once."""
    top = 1 << max(count - 1, 0).bit_length()

    def halve(_, state):
        low, step = state
        middle = low + (step - 1)
        go = (middle < count) & (take(ends, first + jnp.minimum(middle, count - 1)) <= rank)
        return jnp.where(go, low + step, low), step >> 1

    state = jnp.zeros(rank.shape, jnp.int32), jnp.int32(top)
    low = lax.fori_loop(jnp.int32(0), jnp.int32(top.bit_length()), halve, state)[0]
    return jnp.minimum(low, count - 1)
