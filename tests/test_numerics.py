"""The primitives: values against float64 NumPy, gradients at the bad points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapeenh import checks, numerics


def test_hypot_and_norm_survive_extreme_scales(dtype, rng):
    v = jnp.asarray(rng.normal(size=(50, 3)), dtype)
    for scale in (1e-30, 1.0, 1e30):
        expected = np.linalg.norm(np.asarray(v, np.float64), axis=-1) * scale
        np.testing.assert_allclose(numerics.norm(v * scale), expected, rtol=1e-6)
    np.testing.assert_allclose(
        numerics.safe_hypot(v[:, 0] * 1e30, v[:, 1] * 1e30) / 1e30, np.hypot(v[:, 0], v[:, 1]), rtol=1e-6
    )


@pytest.mark.parametrize(
    "f",
    [
        lambda v: numerics.safe_hypot(v[0], v[1]),
        lambda v: numerics.norm(v),
        lambda v: numerics.normalize(v).sum(),
        lambda v: numerics.safe_sqrt(v[0]),
        lambda v: numerics.safe_divide(v[0], v[1]),
        lambda v: numerics.safe_power(v[0], v[1]),
        lambda v: numerics.eigenvalues(v)[0],
    ],
)
def test_value_and_gradient_are_finite_at_zero(f, dtype):
    value, gradient = jax.value_and_grad(f)(jnp.zeros(3, dtype))
    assert value == 0
    assert np.all(np.isfinite(gradient))


def test_matrix_function_is_the_spectral_one(x64, rng):
    h = jnp.asarray(rng.normal(size=(200, 3)))
    out = numerics.matrix_function(h, jnp.exp, lambda a, b: jnp.exp(b) * jnp.expm1(a - b) / (a - b))
    full = np.stack([np.stack([h[:, 0], h[:, 1]], -1), np.stack([h[:, 1], h[:, 2]], -1)], -1)
    k, q = np.linalg.eigh(full)
    expected = np.einsum("nij,nj,nkj->nik", q, np.exp(k), q)
    np.testing.assert_allclose(out, np.stack([expected[:, 0, 0], expected[:, 0, 1], expected[:, 1, 1]], -1), rtol=1e-12)


def test_eigenvalues_are_ordered_and_symmetric_functions_of_them_have_exact_gradients_at_umbilics(x64):
    g = jax.grad(lambda t: sum(jnp.tanh(k) for k in numerics.eigenvalues(t)))(jnp.array([0.3, 0.0, 0.3]))
    np.testing.assert_allclose(g, (1 - np.tanh(0.3) ** 2) * np.array([1.0, 0.0, 1.0]), rtol=1e-12)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: checks.check_shape("normal", np.zeros((2, 3)), (None, None, 3)),
            r"normal has shape \(2, 3\).*any, any, 3",
        ),
        (lambda: checks.check_finite("vertices", np.array([1.0, np.nan])), "vertices holds 1 NaN"),
        (lambda: checks.check_range("gamma", 2.0, -1, 1), r"gamma is 2.0.*\[-1, 1\]"),
        (lambda: checks.check_range("invariant", 0.0, 0, 1, open_ends=True), r"\]0, 1\["),
        (lambda: checks.check_range("alpha", np.inf, 0, np.inf), "alpha is inf"),
        (lambda: checks.check_size("height", 0), "height is 0; accepted are integers from 1"),
        (lambda: checks.check_size("height", 2.5), "height is 2.5"),
        (lambda: checks.check_choice("kind", "x", ("a", "b")), "kind is 'x'; accepted are 'a', 'b'"),
    ],
)
def test_errors_say_what_was_given_and_what_is_accepted(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_quotients_have_gradients_where_the_square_of_the_denominator_underflows():
    a, b = jnp.float32(3e-30), jnp.float32(1e-30)
    d_a, d_b = jax.grad(numerics.safe_divide, argnums=(0, 1))(a, b)
    assert np.allclose([d_a, d_b], [1e30, -3e30], rtol=1e-6)
    assert jax.grad(numerics.safe_divide, argnums=1)(1, jnp.float32(0)) == 0
    assert np.allclose(jax.jacfwd(lambda b: numerics.safe_divide(2.0, b))(jnp.arange(3.0)), np.diag([0, -2.0, -0.5]))
