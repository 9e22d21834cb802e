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


def stored(always, function, *args):
    """Evaluate `function` once and store what it returns.

    `always` is a predicate that is true at run time but unknown at compile time: a conditional on it is a border that
    fusion does not cross.
    """
    shapes = jax.eval_shape(function, *args)

    def never(*_):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    return lax.cond(always, function, never, *args)


def lower_bound(ends, rank):
    """The first i with ends[i] > rank, for ascending `ends`; a branchless bisection, all ranks at once."""
    n = ends.shape[0]
    low = jnp.zeros(rank.shape, jnp.int32)
    step = 1
    while step < n:
        step *= 2
    while step >= 1:
        middle = low + (step - 1)
        go = (middle < n) & (take(ends, jnp.minimum(middle, n - 1)) <= rank)
        low = jnp.where(go, low + step, low)
        step //= 2
    return jnp.minimum(low, n - 1)
