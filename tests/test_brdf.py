"""Ashikhmin-Shirley: the numbers of SPEC 7, reciprocity, energy, the twin, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from tests.reference.brdf import ashikhmin_shirley as twin
from tests.reference.differences import assert_gradient

brdf = jax.jit(se.ashikhmin_shirley)
NORMAL = np.array([0.0, 0.0, 1.0])


def material(diffuse, specular, shininess):
    return se.Material(jnp.full(3, diffuse), jnp.full(3, specular), jnp.asarray(shininess))


def directional_albedo(view_angle, m):
    """Integral of rho <n.l> over the hemisphere, per channel, by Gauss-Legendre in the cosine."""
    z, w = np.polynomial.legendre.leggauss(400)
    z, w = 0.5 * (z + 1), 0.5 * w
    phi = 2 * np.pi * (np.arange(400) + 0.5) / 400
    r = np.sqrt(1 - z * z)
    l = np.stack([r[:, None] * np.cos(phi), r[:, None] * np.sin(phi), np.broadcast_to(z[:, None], (400, 400))], -1)
    e = np.array([np.sin(view_angle), 0, np.cos(view_angle)])
    rho = np.asarray(brdf(jnp.asarray(NORMAL), jnp.asarray(l), jnp.asarray(e), m))
    return np.sum(rho * (w * z)[:, None, None], axis=(0, 1)) * 2 * np.pi / 400


def unit(rng, *shape):
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_directional_albedo_has_the_known_values(x64):
    np.testing.assert_allclose(directional_albedo(0.0, material(1.0, 0.0, 10.0)), 0.9688, atol=5e-5)
    np.testing.assert_allclose(directional_albedo(0.3, material(0.0, 1.0, 10.0)), 0.6963, atol=5e-5)


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.0, 1.4])
@pytest.mark.parametrize("parameters", [(1.0, 0.0, 1.0), (1.0, 0.5, 10.0), (1.0, 1.0, 100.0), (0.5, 0.05, 3.0)])
def test_no_energy_from_nothing(x64, angle, parameters):
    assert np.all(directional_albedo(angle, material(*parameters)) <= 1)


def test_reciprocity(dtype, rng):
    n, l, e = (jnp.asarray(a, dtype) for a in unit(rng, 3, 1000))
    m = se.Material(jnp.asarray([0.7, 0.2, 0.1], dtype), jnp.asarray([0.1, 0.5, 0.9], dtype), jnp.asarray(30.0, dtype))
    np.testing.assert_allclose(brdf(n, l, e, m), brdf(n, e, l, m), rtol=1e-4 if dtype == np.float32 else 1e-11)


def test_equals_the_twin_and_is_dark_behind_the_surface(dtype, rng):
    n, l, e = (jnp.asarray(a, dtype) for a in unit(rng, 3, 3000))
    m = se.Material(jnp.asarray([0.7, 0.2, 0.1], dtype), jnp.asarray([0.1, 0.5, 0.9], dtype), jnp.asarray(30.0, dtype))
    wide = [np.asarray(a, np.float64) for a in (n, l, e, m.diffuse, m.specular)]
    expected = twin(*wide, 30.0)
    got = brdf(n, l, e, m)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, expected, rtol=1e-4 if dtype == np.float32 else 1e-10, atol=1e-30)
    behind = (np.sum(wide[0] * wide[1], -1) < 0) | (np.sum(wide[0] * wide[2], -1) < 0)
    np.testing.assert_array_equal(np.asarray(got)[behind], 0)


def test_without_a_specular_lobe(x64, rng):
    """A matte material is the diffuse term of R_s = 0, whose own lobe is Schlick's at grazing angles."""
    n, l, e = (jnp.asarray(a) for a in unit(rng, 3, 1000))
    black = se.Material(jnp.zeros(3), jnp.zeros(3), jnp.asarray(5.0))
    grey = se.Material(jnp.full(3, 0.5), jnp.zeros(3), jnp.asarray(5.0))
    expected = np.asarray(brdf(n, l, e, grey)) - np.asarray(brdf(n, l, e, black))
    np.testing.assert_allclose(brdf(n, l, e, se.Material(jnp.full(3, 0.5))), expected, rtol=1e-9, atol=1e-14)


def test_fields_may_be_numbers_or_maps(x64, rng):
    n, l = jnp.asarray(NORMAL), jnp.asarray([[0.6, 0, 0.8], [0, 0, 1.0]])
    a = brdf(n, l, n, se.Material(0.5, 0.1, 20.0))
    b = brdf(n, l, n, se.Material(jnp.full((2, 3), 0.5), jnp.full(3, 0.1), jnp.full(2, 20.0)))
    np.testing.assert_allclose(a, b, rtol=1e-14)


def test_gradients(x64, rng):
    n, e = jnp.asarray([0.1, 0.2, 0.97]), jnp.asarray([0.0, 0.0, 1.0])
    weight = jnp.asarray([0.3, 1.0, -0.4])

    @jax.jit
    def f(n, l, e, d, s, k):
        return jnp.sum(weight * se.ashikhmin_shirley(n, l, e, se.Material(d, s, k)))

    arguments = [n, jnp.asarray([0.5, -0.3, 0.8]), e, jnp.full(3, 0.4), jnp.full(3, 0.2), jnp.asarray(12.0)]
    for i, value in enumerate(arguments):
        assert_gradient(lambda v, i=i: f(*arguments[:i], v, *arguments[i + 1 :]), value)


@pytest.mark.parametrize("shininess", [0.0, 1.0, 1e4])
def test_finite_at_grazing_and_opposite_directions(dtype, shininess):
    corner = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 0, -1], [0.6, 0, 0.8], [1e-20, 0, 1]])
    n, l, e = (jnp.asarray(a.reshape(-1, 3), dtype) for a in np.broadcast_arrays(
        corner[:, None, None], corner[None, :, None], corner[None, None, :]
    ))  # fmt: skip
    m = se.Material(jnp.full(3, 0.5, dtype), jnp.full(3, 0.0, dtype), jnp.asarray(shininess, dtype))
    value, gradients = jax.value_and_grad(lambda *a: jnp.sum(se.ashikhmin_shirley(*a)), (0, 1, 2, 3))(n, l, e, m)
    assert np.isfinite(value)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradients))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"diffuse": 1.5}, "material.diffuse is 1.5"),
        ({"specular": [-0.1, 0.0, 0.0]}, "material.specular is -0.1"),
        ({"shininess": -1.0}, "material.shininess is -1"),
    ],
)
def test_wrong_materials_are_named(change, words):
    m = se.Material(**({"diffuse": 0.5, "specular": 0.1, "shininess": 10.0} | change))
    with pytest.raises(ValueError, match=words):
        se.ashikhmin_shirley(NORMAL, NORMAL, NORMAL, m)
