"""Borders that XLA's fusion does not cross.

XLA re-fuses: it computes a producer again inside every consumer, and a stencil over a stencil over a logarithm is 20
times slower for it; `optimization_barrier` does not stop that. A conditional does, on a predicate that is true but not
known to be so. Imports nothing of ours.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax


def unknown_truth(*arrays):
    """True, but not for the compiler, as long as one of the arrays that are not empty is no constant of the program.

    From all of them, because somebody's jit may close over some: then they are constants, and a border that rests on
    one of those alone is folded away.
    """
    total = jnp.int32(0)
    for array in (array for array in arrays if array.size):
        first = lax.stop_gradient(array[(0,) * array.ndim])
        if jnp.issubdtype(first.dtype, jnp.floating):
            first = lax.bitcast_convert_type(lax.convert_element_type(first, jnp.float32), jnp.int32)
        total = total + lax.convert_element_type(first, jnp.int32)
    return total >= jnp.iinfo(jnp.int32).min


def stored(always, function, *args):
    """`function(*args)`, evaluated once and stored.

    `always` is a predicate that is true at run time but unknown at compile time, such as `unknown_truth`'s. A border
    next to another one needs its own: under the same predicate XLA makes one branch of both, and fuses within it.
    """
    shapes = jax.eval_shape(function, *args)

    def never(*_):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    return lax.cond(always, jax.checkpoint(function, prevent_cse=False), never, *args)
