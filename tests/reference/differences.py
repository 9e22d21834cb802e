"""Gradients by central differences in float64, with a sweep of step sizes."""

import jax
import jax.numpy as jnp
import numpy as np


def central_difference(f, x, direction, step):
    return (f(x + step * direction) - f(x - step * direction)) / (2 * step)


def assert_gradient(f, x, *, rtol=1e-6, atol=1e-8, directions=4, seed=0, steps=(1e-4, 1e-5, 1e-6)):
    """The gradient of the scalar `f` along random directions equals the best central difference of a step sweep."""
    gradient = jax.grad(f)(x)
    assert np.all(np.isfinite(gradient)), "gradient is not finite"
    rng = np.random.default_rng(seed)
    for _ in range(directions):
        v = jnp.asarray(rng.normal(size=np.shape(x)))
        v = v / jnp.sqrt(jnp.sum(v * v))
        expected = [float(central_difference(f, x, v, h)) for h in steps]
        got = float(jnp.sum(gradient * v))
        error = min(abs(got - e) for e in expected)
        assert error <= atol + rtol * max(abs(got), *map(abs, expected)), f"gradient {got}, differences {expected}"
