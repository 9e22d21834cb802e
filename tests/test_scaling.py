"""Radiance scaling: SPEC 6's facts, the twins, gradients, the scaled sum over lights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from tests.reference import light as reference
from tests.reference.differences import assert_gradient
from tests.test_radiance import assert_relative, make_scene

scale, curvature = jax.jit(se.radiance_scale), jax.jit(se.curvature_mapping)


@pytest.fixture
def grid(dtype, rng):
    """kappa, delta, a, gamma over their ranges, ends included."""
    kappa, delta, a = rng.uniform(-1, 1, 2000), rng.uniform(0, 1, 2000), rng.uniform(0.05, 0.95, 2000)
    kappa[:10], delta[:5], delta[5:10] = 0, 0, 1
    return [jnp.asarray(v, dtype) for v in (kappa, delta, a, rng.uniform(0, 6, 2000))]


# ------------------------------------------------------------------------------------------- facts of sigma


def test_levels_that_are_left_alone(grid):
    kappa, delta, a, gamma = grid
    np.testing.assert_allclose(scale(kappa, a, a, gamma), 1, rtol=1e-6)
    np.testing.assert_array_equal(scale(0 * kappa, delta, a, gamma), 1)
    np.testing.assert_array_equal(scale(kappa, delta, a, 0 * gamma), 1)


def test_symmetries(grid):
    kappa, delta, a, gamma = grid
    tolerance = 1e-5 if kappa.dtype == np.float32 else 1e-12
    np.testing.assert_allclose(scale(kappa, delta, a, gamma) * scale(-kappa, delta, a, gamma), 1, rtol=tolerance)
    np.testing.assert_allclose(
        scale(kappa, 1 - delta, a, gamma) * scale(kappa, delta, 1 - a, gamma), 1, rtol=10 * tolerance
    )


def test_ends(grid):
    kappa, _, a, gamma = grid
    e = np.exp(np.asarray(gamma, np.float64) * np.asarray(kappa, np.float64))
    np.testing.assert_allclose(scale(kappa, jnp.zeros_like(a), a, gamma), e, rtol=1e-5)
    np.testing.assert_allclose(scale(kappa, jnp.ones_like(a), a, gamma), 1 / e, rtol=1e-5)
    np.testing.assert_array_equal(
        scale(kappa, jnp.full_like(a, 7.0), a, gamma), scale(kappa, jnp.ones_like(a), a, gamma)
    )


def test_monotone_and_brighter_above_the_invariant_on_convexities(dtype):
    delta = jnp.linspace(0, 1, 101, dtype=dtype)
    convex, concave = (np.asarray(scale(jnp.asarray(k, dtype), delta, 0.3, 2.0)) for k in (-0.7, 0.7))
    assert np.all(np.diff(convex) > 0)
    assert np.all(np.diff(concave) < 0)
    above = np.asarray(delta) > 0.31
    assert np.all(convex[above] > 1)
    assert np.all(concave[above] < 1)


def test_equals_the_printed_form(grid):
    wide = [np.asarray(v, np.float64) for v in grid]
    tolerance = 2e-6 if grid[0].dtype == np.float32 else 1e-11
    np.testing.assert_allclose(scale(*grid), reference.radiance_scale(*wide), rtol=tolerance)


def test_gradients_of_sigma(x64):
    for kappa, delta, a, gamma in (
        (0.4, 0.2, 0.5, 1.5),
        (-0.6, 0.9, 0.3, 3.0),
        (0.0, 0.5, 0.5, 1.0),
        (0.3, 0.5, 0.5, 1.0),
    ):
        for i, value in enumerate((kappa, delta, a, gamma)):
            arguments = [kappa, delta, a, gamma]
            f = lambda v, i=i, arguments=arguments: scale(*arguments[:i], v, *arguments[i + 1 :])  # noqa: E731
            assert_gradient(f, jnp.asarray(value), directions=1)


@pytest.mark.parametrize("gamma", [1e2, 1e6, 1e30])
def test_finite_for_every_strength(dtype, gamma):
    kappa, delta = (a.ravel() for a in np.meshgrid([-1, -1e-3, 0, 1e-20, 1], [0, 1e-30, 0.5, 1]))
    value, gradients = jax.value_and_grad(
        lambda *a: jnp.sum(jnp.log(se.radiance_scale(*a))), (0, 1, 2, 3)
    )(*(jnp.asarray(v, dtype) for v in (kappa, delta, np.full(20, 0.4), np.full(20, gamma))))  # fmt: skip
    assert np.isfinite(value)
    assert all(np.all(np.isfinite(g)) for g in gradients)


# ------------------------------------------------------------------------------------------- facts of kappa


def test_curvature_along_the_principal_directions(dtype):
    k1, k2, angle = 0.7, -0.3, 0.4
    c, s = np.cos(angle), np.sin(angle)
    h = jnp.asarray([k1 * c * c + k2 * s * s, (k1 - k2) * c * s, k1 * s * s + k2 * c * c], dtype)
    u, z = jnp.asarray([c, s, 0], dtype), jnp.asarray([0, 0, 1], dtype)
    for direction, anisotropy, expected in (
        (u, 1.0, k1), (u, -1.0, k2), (u, 0.0, (k1 + k2) / 2), (z, 1.0, (k1 + k2) / 2), (z, -1.0, (k1 + k2) / 2)
    ):  # fmt: skip
        assert float(curvature(h, direction, anisotropy)) == pytest.approx(np.tanh(expected), rel=1e-5)


def test_curvature_equals_the_twin(dtype, rng):
    h, l = rng.normal(size=(500, 3)), rng.normal(size=(500, 3))
    l /= np.linalg.norm(l, axis=-1, keepdims=True)
    h, l = jnp.asarray(h, dtype), jnp.asarray(l, dtype)
    expected = reference.curvature_mapping(h, np.asarray(l, np.float64), 0.6)
    np.testing.assert_allclose(curvature(h, l, 0.6), expected, atol=1e-6 if dtype == np.float32 else 1e-12)


# ------------------------------------------------------------------------------------------- the scaled sum


def test_no_gradient_of_the_curvature_overflows_where_it_is_zero():
    """Large curvature, large cotangent, and a direction that sees none of either: 0, not inf times 0."""
    bent, along = jnp.asarray([1e30, 0, -1e30]), jnp.asarray([0.0, 0, 1])
    _, pull = jax.vjp(lambda h, l: se.curvature_mapping(h, l, 1.0), bent, along)
    assert not np.any(pull(jnp.float32(1e20))[1])


@pytest.mark.parametrize(("anisotropy", "alpha"), [(0.0, 0.0), (-0.7, 0.0), (0.0, 2.0), (0.7, 2.0)])
def test_scaled_radiance_equals_the_twin(dtype, rng, anisotropy, alpha):
    gbuffer, descriptor, lights, material = make_scene(rng, dtype, spread=1.0)
    options = {"invariant": 0.4, "gamma_diffuse": 1.5, "gamma_specular": 0.5, "anisotropy": anisotropy, "alpha": alpha}
    got = se.shade_scaled(gbuffer, descriptor, lights, material, **options)
    wide = [np.asarray(a, np.float64) for a in (gbuffer.normal, descriptor.hessian, lights.direction, lights.radiance)]
    colours = np.asarray(material.diffuse, np.float64), np.asarray(material.specular, np.float64)
    expected = reference.shade_scaled(*wide, *colours, 20.0, 0.4, (1.5, 0.5), anisotropy, alpha)
    expected = np.where(np.asarray(gbuffer.mask)[..., None], expected, 0)
    assert_relative(got, expected, 1e-4 if dtype == np.float32 else 1e-10)


def test_no_strength_is_plain_radiance(dtype, rng):
    gbuffer, descriptor, lights, material = make_scene(rng, dtype)
    plain = np.asarray(se.shade(gbuffer, lights, material), np.float64)
    general = jax.jit(
        lambda g: se.shade_scaled(
            gbuffer, descriptor, lights, material, invariant=0.4, gamma_diffuse=g, gamma_specular=g, anisotropy=0.5
        )
    )(0.0)
    assert_relative(general, plain, 1e-4 if dtype == np.float32 else 1e-10)


def test_concavities_can_have_their_own_strength(x64, rng):
    gbuffer, descriptor, lights, material = make_scene(rng, x64)
    options = {"invariant": 0.4, "gamma_diffuse": 1.5, "gamma_specular": 0.5}
    whole, convex = (
        np.asarray(se.shade_scaled(gbuffer, descriptor, lights, material, concave=c, **options)) for c in (1.0, 0.0)
    )
    plain = np.asarray(se.shade(gbuffer, lights, material))
    hollow = np.asarray(descriptor.hessian[..., 0] + descriptor.hessian[..., 2] > 0)
    np.testing.assert_allclose(convex[hollow], plain[hollow], rtol=1e-12)
    np.testing.assert_allclose(convex[~hollow], whole[~hollow], rtol=1e-12)


def test_strength_may_be_a_map(x64, rng):
    gbuffer, descriptor, lights, material = make_scene(rng, x64)
    left = np.zeros(gbuffer.mask.shape)
    left[:, :10] = 2.0
    mapped = se.shade_warped(gbuffer, descriptor, lights, material, alpha=jnp.asarray(left))
    uniform = se.shade_warped(gbuffer, descriptor, lights, material, alpha=2.0)
    plain = se.shade(gbuffer, lights, material)
    np.testing.assert_allclose(mapped[:, :10], uniform[:, :10], rtol=1e-12)
    np.testing.assert_allclose(mapped[:, 10:], plain[:, 10:], rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"invariant": 0.0}, r"invariant is 0.0; accepted are finite numbers in \]0, 1\["),
        ({"gamma_diffuse": -1.0}, "gamma_diffuse is -1"),
        ({"anisotropy": 1.5}, "anisotropy is 1.5"),
        ({"concave": np.inf}, "concave holds 1 NaN or infinite"),
    ],
)
def test_wrong_arguments_are_named(rng, change, words):
    options = {"invariant": 0.5, "gamma_diffuse": 1.0, "gamma_specular": 1.0} | change
    with pytest.raises(ValueError, match=words):
        se.shade_scaled(*make_scene(rng, np.float32), **options)
