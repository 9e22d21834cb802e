"""Programs for wide registers give the same under every transformation, and only outermost ones ask for them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapeenh import wide


@pytest.fixture
def traced():
    """A function made by `jit_wide`, and the list of its traces."""
    traces = []

    def function(x, *, power):
        traces.append(power)
        return x**power

    return wide.jit_wide(function, static_argnames="power"), traces


def test_it_is_compiled_once(traced):
    cube, traces = traced
    assert cube(2.0, power=3) == cube(2.0, power=3) == 8
    assert traces == [3]


TRANSFORMED = {
    "jit": lambda f: jax.jit(f)(2.0),
    "jit of a constant": lambda f: jax.jit(lambda x: f(2.0) + 0 * x)(1.0),
    "vmap": lambda f: jax.vmap(f)(jnp.full(3, 2.0))[1],
    "vmap over something else": lambda f: jax.vmap(lambda x: f(2.0) + 0 * x)(jnp.ones(3))[1],
    "value and gradient": lambda f: jax.value_and_grad(f)(2.0)[0],
    "gradient in something else": lambda f: jax.value_and_grad(lambda x: x * f(2.0))(1.0)[0],
    "gradient of jit": lambda f: jax.value_and_grad(jax.jit(f))(2.0)[0],
    "jvp": lambda f: jax.jvp(f, (2.0,), (1.0,))[0],
    "linearize": lambda f: jax.linearize(f, 2.0)[0],
    "checkpoint": lambda f: jax.value_and_grad(jax.checkpoint(f))(2.0)[0],
    "scan": lambda f: jax.lax.scan(lambda c, x: (c, f(x)), 0.0, jnp.full(3, 2.0))[1][1],
    "scan of a constant": lambda f: jax.lax.scan(lambda c, x: (c, f(2.0)), 0.0, jnp.ones(3))[1][1],
    "lowered": lambda f: jax.jit(f).lower(2.0).compile()(2.0),
}


@pytest.mark.parametrize("transform", TRANSFORMED.values(), ids=TRANSFORMED)
def test_it_can_be_transformed(traced, transform):
    cube, _ = traced
    np.testing.assert_allclose(transform(lambda x: cube(x, power=3)), 8, rtol=1e-6)


def test_derivatives_are_those_of_the_function(traced):
    cube, _ = traced
    assert jax.grad(lambda x: cube(x, power=3))(2.0) == 12
    assert jax.hessian(lambda x: cube(x, power=3))(2.0) == 12
    assert jax.eval_shape(lambda x: cube(x, power=3), 2.0).shape == ()


def test_a_compiler_without_the_option_is_not_asked(traced, monkeypatch):
    monkeypatch.setattr(wide, "OPTIONS", {"no_such_option": 1})
    wide._is_accepted.cache_clear()
    try:
        assert not wide._is_accepted()
        assert traced[0](2.0, power=3) == 8
    finally:
        wide._is_accepted.cache_clear()
