"""SPEC 5's laws of the warp, its twin with eigenvectors, and its gradients at singular points."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from tests.reference import light as reference
from tests.reference.differences import assert_gradient

TOLERANCE = {"float32": 1e-5, "float64": 1e-10}

# Compiled once per precision: what the tests call over and over.
tensor_of, warp, unwarp, jacobian = (jax.jit(f) for f in (se.warp_tensor, se.warp, se.unwarp, se.warp_jacobian))


@jax.jit
@functools.partial(jax.value_and_grad, argnums=(0, 1, 2))
def everything(l, h, a):
    """Sum of all values, to look for NaN in its gradients."""
    tensor = se.warp_tensor(h, a)
    return sum(jnp.sum(p) for p in (se.warp(l, tensor), se.unwarp(l, tensor), se.warp_jacobian(l, tensor)))


def unit(rng, shape):
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def hessians(rng, count, low=-3, high=3):
    """Random tensors over orders of magnitude, some of them umbilic, degenerate or zero."""
    h = rng.normal(size=(count, 3)) * 10 ** rng.uniform(low, high, (count, 1))
    h[::7, 1], h[::7, 2] = 0, h[::7, 0]
    h[3::11] = [1e-2, 0, 0]
    h[5::13] = 0
    return h


def special_directions():
    """Near and at the poles, on both sides of the horizon, and all around."""
    tilt = np.concatenate([[0], 10.0 ** np.arange(-30, 0, 2), [1.0, np.pi / 2 - 1e-6, np.pi / 2]])
    phi = np.linspace(0, 2 * np.pi, 7)[:-1] + 0.1
    up = np.stack([np.sin(tilt)[:, None] * np.cos(phi), np.sin(tilt)[:, None] * np.sin(phi)], -1)
    z = np.broadcast_to(np.cos(tilt)[:, None, None], (*up.shape[:2], 1))
    return np.concatenate([np.concatenate([up, s * z], -1).reshape(-1, 3) for s in (1, -1)])


# ------------------------------------------------------------------------------------------- laws


@pytest.mark.parametrize("alpha", [-30.0, 0.3, 1e3, 1e6])
def test_warped_directions_are_unit_and_unwarp_undoes_warp(dtype, rng, alpha):
    tol = TOLERANCE[dtype.name]
    l = jnp.asarray(np.concatenate([unit(rng, (2000,)), special_directions()]), dtype)
    tensor = tensor_of(jnp.asarray(hessians(rng, len(l)), dtype), alpha)
    warped = warp(l, tensor)
    np.testing.assert_allclose(np.linalg.norm(warped, axis=-1), 1, atol=tol)
    np.testing.assert_allclose(unwarp(warped, tensor), l, atol=tol)
    np.testing.assert_allclose(warp(unwarp(l, tensor), tensor), l, atol=tol)


def test_no_strength_and_no_curvature_are_the_identity_exactly(dtype, rng):
    l = jnp.asarray(np.concatenate([unit(rng, (500,)), special_directions()]), dtype)
    h = jnp.asarray(hessians(rng, len(l)), dtype)
    for tensor in (tensor_of(h, 0.0), tensor_of(jnp.zeros_like(h), 1e6)):
        np.testing.assert_array_equal(tensor, np.broadcast_to([1, 0, 1], h.shape))
        np.testing.assert_array_equal(warp(l, tensor), l)
        np.testing.assert_array_equal(unwarp(l, tensor), l)
        np.testing.assert_array_equal(jacobian(l, tensor), 1)


def test_opposite_strength_gives_the_inverse_tensor(x64, rng):
    h = jnp.asarray(hessians(rng, 500))
    a, b = tensor_of(h, 30.0), tensor_of(h, -30.0)
    np.testing.assert_allclose(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1], 1, rtol=1e-12)
    np.testing.assert_allclose(a[:, 0] * b[:, 1] + a[:, 1] * b[:, 2], 0, atol=1e-12)


@pytest.mark.parametrize("eigen", [(0.577, 0.577), (1.73, 1.73), (1.73, 0.577), (1.2, 0.9)])
def test_jacobian_integrates_to_the_sphere(x64, eigen):
    # Gauss-Legendre in z, the rectangle rule in azimuth: both converge geometrically for this smooth periodic J,
    # but for the pole l = -z, where J is bounded and direction-dependent: hence many nodes.
    z, w = np.polynomial.legendre.leggauss(1500)
    phi = 2 * np.pi * (np.arange(64) + 0.5) / 64
    r = np.sqrt(1 - z * z)
    l = np.stack([r[:, None] * np.cos(phi), r[:, None] * np.sin(phi), np.broadcast_to(z[:, None], (1500, 64))], -1)
    j = jacobian(jnp.asarray(l), jnp.array([eigen[0], 0.0, eigen[1]]))
    assert np.sum(w[:, None] * np.asarray(j)) * 2 * np.pi / 64 == pytest.approx(4 * np.pi, rel=1e-9)


def tangent_determinant(l, tensor):
    """|det| of the derivative of W^-1 between the tangent planes at l' and at W^-1(l')."""

    def basis(n):
        a = jnp.where(jnp.abs(n[0]) < 0.5, jnp.array([1.0, 0, 0]), jnp.array([0, 1.0, 0]))
        u = jnp.cross(n, a)
        u = u / jnp.linalg.norm(u)
        return jnp.stack([u, jnp.cross(n, u)])

    derivative = jax.jacobian(lambda d: unwarp(d / jnp.linalg.norm(d), tensor))(l)
    return jnp.abs(jnp.linalg.det(basis(unwarp(l, tensor)) @ derivative @ basis(l).T))


@pytest.mark.parametrize("alpha", [1.0, -1e6, 1e6])
def test_jacobian_is_the_determinant_of_the_derivative_on_the_sphere(x64, rng, alpha):
    h = hessians(rng, 300, -2, 0)
    directions = special_directions()
    # Autodiff reaches down to 1e-8 rad of the pole -z; at the pole itself it has no derivative where lu != lv.
    directions = directions[(directions[:, 2] > 0) | (np.hypot(directions[:, 0], directions[:, 1]) > 1e-9)]
    l = np.concatenate([unit(rng, (300 - len(directions),)), directions])
    tensor = tensor_of(jnp.asarray(h), alpha)
    expected = jax.vmap(tangent_determinant)(jnp.asarray(l), tensor)
    np.testing.assert_allclose(jacobian(jnp.asarray(l), tensor), expected, rtol=1e-7)


def test_jacobian_of_an_umbilic_is_continuous_at_the_pole(dtype):
    tensor = tensor_of(jnp.array([0.05, 0, 0.05], dtype), 30.0)
    at, near = (float(jacobian(jnp.array([x, 0, -1], dtype), tensor)) for x in (0.0, 1e-9))
    assert at == pytest.approx(near, rel=1e-6)
    assert at == pytest.approx(float(tensor[0]) ** 2, rel=1e-5)


# ------------------------------------------------------------------------------------------- the twin


@pytest.mark.parametrize("alpha", [0.03, 30.0, -1e3, 1e6])
def test_equals_the_twin_with_eigenvectors(dtype, rng, alpha):
    tol = TOLERANCE[dtype.name]
    l = jnp.asarray(np.concatenate([unit(rng, (4000,)), special_directions()]), dtype)
    l = l[jnp.hypot(l[:, 0], l[:, 1]) > 0]
    h = jnp.asarray(hessians(rng, len(l)), dtype)
    l64 = np.asarray(l, np.float64)
    l64 = l64 / np.linalg.norm(l64, axis=-1, keepdims=True)
    tensor = tensor_of(h, alpha)
    np.testing.assert_allclose(tensor, reference.warp_tensor(h, alpha), rtol=tol, atol=tol)
    for ours, theirs in ((warp, reference.warp), (unwarp, reference.unwarp)):
        error = np.linalg.norm(np.asarray(ours(l, tensor)) - theirs(l64, h, alpha), axis=-1)
        assert error.max() < tol
    np.testing.assert_allclose(jacobian(l, tensor), reference.jacobian(l64, h, alpha), rtol=tol)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
@pytest.mark.parametrize("alpha", [1.0, 1e-20, -1e6])
def test_extreme_hessians(dtype, rng, scale, alpha):
    h = jnp.asarray(rng.normal(size=(200, 3)) * scale, dtype)
    np.testing.assert_allclose(tensor_of(h, alpha), reference.warp_tensor(h, alpha), rtol=1e-6, atol=1e-6)


# ------------------------------------------------------------------------------------------- gradients


@jax.jit
def weighted_tensor(h, a):
    return jnp.sum(jnp.array([0.3, -0.9, 0.5]) * jnp.sin(se.warp_tensor(h, a)))


@pytest.mark.parametrize(
    "hessian",
    [[0.3, -0.2, 0.5], [0.3, 0.0, 0.3], [0.0, 0.0, 0.0], [0.3, 1e-9, 0.3], [0.2, 0.0, -0.2], [3.0, 0.1, -0.4]],
)
@pytest.mark.parametrize("alpha", [2.0, 0.0, -0.7])
def test_tensor_gradients_at_generic_and_umbilic_hessians(x64, hessian, alpha):
    h = jnp.array(hessian)
    assert_gradient(lambda h: weighted_tensor(h, alpha), h)
    assert_gradient(lambda a: weighted_tensor(h, a), jnp.asarray(alpha))


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-3, 1.0, 1e30])
@pytest.mark.parametrize("alpha", [0.0, 1e-6, 30.0, -1e6, 1e30])
def test_values_and_gradients_are_finite_everywhere(dtype, rng, scale, alpha):
    l = jnp.asarray(special_directions(), dtype)
    h = jnp.asarray(hessians(rng, len(l), 0, 0) * scale, dtype)
    value, gradients = everything(l, h, jnp.asarray(alpha, dtype))
    assert np.isfinite(value)
    for g in gradients:
        assert np.all(np.isfinite(g))


# ------------------------------------------------------------------------------------------- interface


def test_broadcasts_under_vmap_and_jit(dtype, rng):
    l, h = jnp.asarray(unit(rng, (5,)), dtype), jnp.asarray(rng.normal(size=(4, 3)), dtype)
    tensor = se.warp_tensor(h, 2.0)
    grid = jax.jit(se.warp)(l[:, None], tensor[None])
    assert grid.shape == (5, 4, 3)
    assert grid.dtype == dtype
    nested = jax.vmap(lambda d: jax.vmap(lambda t: se.warp(d, t))(tensor))(l)
    np.testing.assert_allclose(grid, nested, rtol=1e-6)
    strengths = se.warp_tensor(h, jnp.arange(4.0, dtype=dtype))
    np.testing.assert_allclose(strengths[2], se.warp_tensor(h[2], 2.0), rtol=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: se.warp_tensor(np.zeros((4, 2)), 1.0), r"hessian has shape \(4, 2\)"),
        (lambda: se.warp_tensor(np.zeros(3), np.nan), "alpha holds 1 NaN"),
        (lambda: se.warp(np.zeros(2), np.zeros(3)), "direction has shape"),
        (lambda: se.warp_jacobian(np.zeros(3), np.zeros((3, 2))), "tensor has shape"),
    ],
)
def test_wrong_arguments_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
