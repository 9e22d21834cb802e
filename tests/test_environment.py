"""Environment maps and their lights: energy, convention, error against many lights, gradients, bad pixels."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.scene import environment
from tests.reference.differences import assert_gradient

METHODS = ("uniform", "importance", "median_cut")


def integral(radiance):
    """Over the sphere, float64, by the solid angles of rows between exact borders."""
    h, w = radiance.shape[:2]
    theta = np.pi * np.arange(h + 1) / h
    solid = (np.cos(theta[:-1]) - np.cos(theta[1:])) * 2 * np.pi / w
    return np.sum(np.asarray(radiance, np.float64) * solid[:, None, None], axis=(0, 1))


@pytest.fixture
def radiance(rng):
    """A noisy map with a dark half and a few very bright pixels."""
    out = rng.uniform(size=(32, 64, 3)) * (np.arange(64) < 40)[None, :, None]
    out[5, 7] = [900, 800, 500]
    out[20, 30] = [50, 90, 300]
    return out


# ------------------------------------------------------------------------------------------- energy and directions


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [1, 2, 3, 16, 54, 257, 1024])
def test_lights_carry_the_integral_of_the_map(dtype, radiance, method, count):
    lights = se.sample_environment(jnp.asarray(radiance, dtype), count, method=method)
    assert lights.direction.shape == lights.radiance.shape == (count, 3)
    assert lights.radiance.dtype == dtype
    np.testing.assert_allclose(np.sum(np.asarray(lights.radiance, np.float64), 0), integral(radiance), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(lights.direction, axis=-1), 1, rtol=1e-6)
    assert np.all(np.asarray(lights.radiance) >= 0)


@pytest.mark.parametrize("method", METHODS)
def test_sampling_is_deterministic(radiance, method):
    a, b = (se.sample_environment(jnp.asarray(radiance, jnp.float32), 54, method=method) for _ in range(2))
    np.testing.assert_array_equal(a.direction, b.direction)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("pixel", "direction"),
    [((16, 32), (0, 0, -1)), ((16, 48), (1, 0, 0)), ((16, 0), (0, 0, 1)), ((0, 10), (0, 1, 0)), ((31, 5), (0, -1, 0))],
)
def test_a_bright_pixel_shines_from_where_the_convention_says(dtype, method, pixel, direction):
    radiance = np.full((32, 64, 3), 1e-6)
    radiance[pixel] = 1e4
    lights = se.sample_environment(jnp.asarray(radiance, dtype), 16, method=method)
    brightest = np.argmax(np.sum(lights.radiance, axis=-1))
    assert np.dot(lights.direction[brightest], direction) > 0.99


def test_a_uniform_map_has_uniform_lights(x64):
    lights = se.sample_environment(jnp.ones((128, 256, 3)), 100, method="uniform")
    share = np.asarray(lights.radiance[:, 0]) / (4 * np.pi / 100)
    assert share.min() > 0.8
    assert share.max() < 1.2
    np.testing.assert_allclose(np.mean(lights.direction, axis=0), 0, atol=0.03)


@pytest.mark.parametrize("method", METHODS)
def test_more_lights_come_closer_to_the_map(x64, method):
    """Irradiance for many normals against the sum over all pixels; the error falls with the number of lights."""
    radiance = environment.procedural_sky(height=64)
    direction, solid = (
        np.asarray(f(height=64, width=128)) for f in (environment.map_directions, environment.map_solid_angles)
    )
    normal = np.random.default_rng(1).normal(size=(100, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)

    def irradiance(l, energy):
        return np.maximum(normal @ l.T, 0) @ energy

    exact = irradiance(direction.reshape(-1, 3), (np.asarray(radiance) * solid[..., None]).reshape(-1, 3))
    errors = []
    for count in (16, 64, 256, 1024):
        lights = se.sample_environment(radiance, count, method=method)
        got = irradiance(np.asarray(lights.direction), np.asarray(lights.radiance))
        errors.append(np.sqrt(np.mean((got / exact - 1) ** 2)))
    assert errors[-1] < 0.02
    assert errors[-1] < 0.4 * errors[0]


# ------------------------------------------------------------------------------------------- rotation


def test_rotation_by_matrix_and_by_angle(x64, radiance):
    plain = se.sample_environment(jnp.asarray(radiance), 54)
    quarter = jnp.asarray([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    a = se.sample_environment(jnp.asarray(radiance), 54, rotation=quarter)
    b = se.sample_environment(jnp.asarray(radiance), 54, rotation=np.pi / 2)
    np.testing.assert_allclose(a.direction, plain.direction @ quarter.T, atol=1e-14)
    np.testing.assert_allclose(b.direction, a.direction, atol=1e-14)


def test_lights_turn_with_the_camera(x64, radiance):
    lights = se.sample_environment(jnp.asarray(radiance), 10)
    camera = se.perspective_camera((3.0, 2.0, 1.0), (0.0, 0.0, 0.0), fov_degrees=40.0, aspect=1.0)
    turned = se.rotate_lights(lights, camera)
    np.testing.assert_allclose(turned.direction, lights.direction @ camera.view[:3, :3].T, atol=1e-14)
    back = se.Lights(jnp.asarray([[3.0, 2.0, 1.0]]) / np.sqrt(14), jnp.ones((1, 3)))
    np.testing.assert_allclose(se.rotate_lights(back, camera).direction, [[0, 0, 1]], atol=1e-12)


# ------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("method", METHODS)
def test_gradient_in_the_map(x64, rng, method):
    radiance = jnp.asarray(rng.uniform(0.5, 1.5, size=(8, 16, 3)))
    a, b = jnp.asarray(rng.normal(size=(5, 3))), jnp.asarray(rng.normal(size=(5, 3)))

    def f(r):
        lights = se.sample_environment(r, 5, method=method)
        return jnp.sum(a * lights.radiance) + jnp.sum(b * lights.direction)

    np.testing.assert_allclose(jax.jit(f)(radiance), f(radiance), rtol=1e-12)
    assert_gradient(f, radiance, steps=(1e-6, 1e-7))


def test_gradient_in_the_rotation(x64, radiance):
    weight = jnp.asarray(np.random.default_rng(2).normal(size=(7, 3)))
    assert_gradient(
        lambda r: jnp.sum(weight * se.sample_environment(jnp.asarray(radiance), 7, rotation=r).direction),
        jnp.asarray(0.3),
    )


# ------------------------------------------------------------------------------------------- bad input


def test_bad_pixels_are_replaced_and_counted_once(radiance):
    bad = radiance.copy()
    bad[0, 0] = [-1, 2, 3]
    bad[1, 1] = np.nan
    bad[2, 2, 0] = np.inf
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        lights = se.sample_environment(bad, 16)
    assert [str(w.message)[:32] for w in caught] == ["radiance_map: 3 of 2048 pixels h"]
    assert np.all(np.isfinite(lights.radiance))
    clean = bad.copy()
    clean[0, 0, 0], clean[1, 1], clean[2, 2, 0] = 0, 0, 900
    np.testing.assert_allclose(np.sum(lights.radiance, axis=0), integral(clean), rtol=1e-5)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: se.sample_environment(np.ones((4, 8)), 4), r"radiance_map has shape \(4, 8\)"),
        (
            lambda: se.rotate_lights(se.Lights(np.eye(3), np.eye(3)), se.Camera(np.full((4, 4), np.nan), np.eye(4))),
            "camera.view holds 16 NaN",
        ),
        (lambda: se.sample_environment(np.ones((4, 8, 3)), 0), "count is 0; accepted are integers from 1"),
        (lambda: se.sample_environment(np.ones((4, 8, 3)), 2.5), "count is 2.5"),
        (lambda: se.sample_environment(np.zeros((4, 8, 3)), 4), "radiance_map holds no energy"),
        (lambda: se.sample_environment(np.ones((4, 8, 3)), 4, method="best"), "method is 'best'"),
        (lambda: se.sample_environment(np.ones((4, 8, 3)), 4, rotation=np.ones(2)), r"rotation has shape \(2,\)"),
        (lambda: se.procedural_sky(height=2), "height is 2"),
        (lambda: se.procedural_sky(sun=(0.0, 0.0, 0.0)), r"sun is \(0.0, 0.0, 0.0\)"),
    ],
)
def test_wrong_arguments_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize("make", [se.procedural_sky, se.procedural_studio])
def test_embedded_maps_have_variation(make):
    radiance = np.asarray(make(height=64))
    assert radiance.shape == (64, 128, 3)
    assert np.all(np.isfinite(radiance))
    assert radiance.min() > 0
    # Light warping shows what the light holds: a map without contrast shows nothing.
    assert radiance.max() > 50 * np.median(radiance)
