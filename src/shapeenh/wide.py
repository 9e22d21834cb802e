"""Compiled programs for wide registers. Imports `checks` only."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from shapeenh.checks import is_concrete

OPTIONS = {"xla_cpu_prefer_vector_width": 512}


def jit_wide(function, **options):
    """`jax.jit(function, **options)` that asks for registers of 512 bits, where a CPU has them (AVX-512).

    XLA's own choice is 256. What is much arithmetic on few arrays gains by it, up to a quarter of the time; what moves
    data does not. JAX takes such an option for an outermost program only: within somebody's trace this is `jax.jit`.
    Both give the same bits, unless the program holds an approximated operation such as `rsqrt`.
    """
    usual, wide = jax.jit(function, **options), jax.jit(function, compiler_options=OPTIONS, **options)

    @functools.wraps(function)
    def call(*args, **kwargs):
        made_here = jnp.zeros(())  # a tracer within a trace, whatever the arguments are
        outermost = is_concrete(args, kwargs, made_here)
        return (wide if outermost and _is_accepted() else usual)(*args, **kwargs)

    return call


@functools.cache
def _is_accepted() -> bool:
    """Whether the computation runs on a CPU, by a compiler that knows the option."""
    if jax.default_backend() != "cpu":
        return False
    try:
        jax.jit(lambda x: x, compiler_options=OPTIONS).lower(0.0).compile()
    except (jax.errors.JaxRuntimeError, ValueError):
        return False
    return True
