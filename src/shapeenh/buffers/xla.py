"""Two XLA idioms that the rasteriser and the resolve are built from. Imports nothing of ours."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

HALVINGS = 3


def take(array, index):
    """array[index] along the first axis, the indices known to be in range and not negative."""
    return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def lower_bound(ends, rank):
    """The first i < count with ends[first + i] > rank, for an ascending stretch of `ends`; a branchless bisection,
    all ranks at once."""
    count = ends.shape[0]
    top = 1 << max(count - 1, 0).bit_length()

    def halve(_, state):
        low, step = state
        for k in range(HALVINGS):  # several a turn: a turn has its cost
            half = step >> k
            middle = low + (half - 1)
            go = (half > 0) & (middle < count) & (take(ends, jnp.minimum(middle, count - 1)) <= rank)
            low = jnp.where(go, low + half, low)
        return low, step >> HALVINGS

    state = jnp.zeros(rank.shape, jnp.int32), jnp.int32(top)
    low = lax.fori_loop(jnp.int32(0), jnp.int32(-(-top.bit_length() // HALVINGS)), halve, state)[0]
    return jnp.minimum(low, count - 1)
