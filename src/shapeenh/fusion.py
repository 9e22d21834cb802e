"""Borders that XLA's fusion does not cross.

XLA re-fuses: it computes a producer again inside every consumer, and a stencil over a stencil over a logarithm is 20
times slower for it; `optimization_barrier` does not stop that. A conditional does, on a predicate that is true but not
known to be so. Imports nothing of ours.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import eval_jaxpr
from jax.custom_derivatives import SymbolicZero


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
    return _truth(total)


@jax.custom_batching.custom_vmap
def _truth(number):
    return number >= jnp.iinfo(jnp.int32).min


@_truth.def_vmap
def _one_truth(axis_size, in_batched, numbers):
    """One for all of a batch: of a batch of predicates `vmap` would make selections, which are no borders."""
    return _truth(jnp.max(numbers)), False


def stored(always, function, *args):
    """`function(*args)`, evaluated once and stored; reverse mode keeps the arguments and evaluates it again.

    `always` is a predicate that is true at run time but unknown at compile time, such as `unknown_truth`'s. A border
    next to another one needs its own: under the same predicate XLA makes one branch of both, and fuses within it.
    *Gradient*: in reverse mode, also with respect to what `function` closes over.
    """
    program, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    found = _stored(program.jaxpr, always, (*program.consts, *jax.tree.leaves(args)))
    return jax.tree.unflatten(jax.tree.structure(shapes), found)


def _evaluate(program, *leaves):
    closed_over = len(program.constvars)
    return eval_jaxpr(program, leaves[:closed_over], *leaves[closed_over:])


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _stored(program, always, leaves):
    def never(*_):
        return [jnp.zeros(v.aval.shape, v.aval.dtype) for v in program.outvars]

    return lax.cond(always, partial(_evaluate, program), never, *leaves)


def _stored_forward(program, always, leaves):
    moving = tuple(() if leaf.perturbed else None for leaf in leaves)
    leaves = tuple(leaf.value for leaf in leaves)
    return _stored(program, always.value, leaves), (always.value, leaves, moving)


def _stored_backward(program, saved, cotangents):
    """Not through the conditional, which would hand all arguments on as copies."""
    always, leaves, moving = saved
    at = [i for i, flag in enumerate(moving) if flag is not None]
    reached = [i for i, c in enumerate(cotangents) if not isinstance(c, SymbolicZero)]

    def pull(some, leaves, cotangents):
        def run(some):
            given = list(leaves)
            for i, leaf in zip(at, some, strict=True):
                given[i] = leaf
            out = _evaluate(program, *given)
            return [out[i] for i in reached]

        return jax.vjp(run, some)[1](cotangents)[0]

    found = stored(always, pull, [leaves[i] for i in at], leaves, [cotangents[i] for i in reached])
    found = dict(zip(at, found, strict=True))
    return None, tuple(found.get(i) for i in range(len(leaves)))


_stored.defvjp(_stored_forward, _stored_backward, symbolic_zeros=True)
