"""The whole chain: laws of the picture, recompilation."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from tests.test_visibility import FACES, VERTICES, H, W

SIZE = {"height": H, "width": W}


def padded(mesh, dtype):
    """As large as the meshes of `test_visibility`, so that all share the compiled rasteriser."""
    mesh = se.pad_mesh(mesh, vertices=VERTICES, faces=FACES)
    return jax.tree.map(lambda a: a.astype(dtype) if a.dtype.kind == "f" else a, mesh)


def scene(dtype=np.float32, lights=12):
    mesh = padded(se.torus(segments=16), dtype)
    camera = se.frame_mesh(mesh, direction=(0.2, 0.9, 0.7), aspect=4 / 3)
    lamps = se.sample_environment(se.procedural_studio(), lights)
    material = se.named_material("stone")
    cast = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, dtype), tree)  # noqa: E731
    return mesh, camera, cast(lamps), cast(material)


def test_the_picture_has_light_where_the_mask_is_and_nowhere_else(dtype):
    mesh, camera, lights, material = scene(dtype)
    image = se.render(mesh, camera, lights, material, se.LightWarp(30.0), sigma=1.0, **SIZE)
    mask = np.asarray(se.render_gbuffer(mesh, camera, **SIZE).mask)
    assert image.shape == (H, W, 3)
    assert image.dtype == dtype
    assert np.all(np.isfinite(image))
    assert np.all(np.asarray(image)[~mask] == 0)
    assert np.all(np.asarray(image)[mask].max(axis=-1) > 0)


@pytest.mark.parametrize("samples", [1, 2])
def test_repeated_pictures_have_the_same_bytes(samples):
    """As large as makes several cores share the work."""
    mesh, camera, lights, material = scene()
    size = {"height": 4 * H, "width": 4 * W}
    seen = [np.asarray(se.rasterize(mesh, camera, **size).triangle).tobytes() for _ in range(3)]
    assert seen[0] == seen[1] == seen[2]
    picture = lambda: se.render(mesh, camera, lights, material, se.LightWarp(30.0), sigma=1.0, samples=samples, **size)  # noqa: E731
    first, *others = (np.asarray(picture()).tobytes() for _ in range(3))
    assert all(first == other for other in others)


@functools.cache
def compiled():
    """jit of (enhancement, sigma) -> picture of the scene in float64."""
    mesh, camera, lights, material = scene(np.float64)
    return jax.jit(lambda look, sigma: se.render(mesh, camera, lights, material, look, sigma=sigma, **SIZE))


@pytest.mark.parametrize(
    "enhancement",
    [se.LightWarp(0.0, 0.0), pytest.param(se.RadianceScaling(0.4, 0.0, 0.0), marks=pytest.mark.thorough)],
)
def test_strength_zero_is_the_plain_picture(enhancement, x64):
    mesh, camera, lights, material = scene(x64)
    plain = se.render(mesh, camera, lights, material, **SIZE)
    same = se.render(mesh, camera, lights, material, enhancement, sigma=1.0, **SIZE)
    np.testing.assert_allclose(same, plain, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(compiled()(enhancement, 1.0), plain, rtol=1e-5, atol=1e-5)


def test_flat_places_do_not_change(x64):
    mesh = padded(se.plane(segments=3), np.float64)
    camera = se.frame_mesh(mesh, direction=(0.4, 0.3, 1.0))
    _, _, lights, material = scene(np.float64)
    plain = se.render(mesh, camera, lights, material, **SIZE)
    warped = se.render(mesh, camera, lights, material, se.LightWarp(80.0, 0.5), sigma=3.0, **SIZE)
    np.testing.assert_allclose(warped, plain, rtol=1e-8, atol=1e-10)


def test_jit_and_eager_agree(x64):
    warp, sigma = se.LightWarp(25.0, 0.3), 1.5
    eager = se.render(*scene(x64), warp, sigma=sigma, **SIZE)
    np.testing.assert_allclose(eager, compiled()(warp, sigma), rtol=1e-10, atol=1e-10)


def test_the_picture_does_not_depend_on_the_resolution():
    mesh, camera, lights, material = scene()
    images = [
        se.render(mesh, camera, lights, material, se.LightWarp(25.0), sigma=8.0, height=k * H, width=k * W)
        for k in (1, 2)
    ]
    small, large = np.asarray(images[0]), np.asarray(images[1])
    pooled = large.reshape(H, 2, W, 2, 3).mean(axis=(1, 3))
    inside = np.ones((H, W), bool)
    mask = np.asarray(se.render_gbuffer(mesh, camera, **SIZE).mask)
    for shift in (-2, 2):
        for axis in (0, 1):
            inside &= np.roll(mask, shift, axis)
    difference = np.abs(small - pooled).mean(axis=-1)[inside & mask]
    assert np.median(difference) < 0.01 * small[mask].mean()


def test_values_do_not_recompile(compilations):
    mesh, _, lights, material = scene()

    def picture(alpha, gamma, sigma, shift):
        moved = se.frame_mesh(mesh, direction=(0.2 + shift, 0.9, 0.7), aspect=4 / 3)
        lamps = se.Lights(lights.direction, lights.radiance * (1 + shift))
        stone = dataclasses.replace(material, shininess=material.shininess + shift)
        return se.render(mesh, moved, lamps, stone, se.LightWarp(alpha, gamma), sigma=sigma, **SIZE)

    picture(20.0, 0.5, 1.0, 0.0)
    compilations.clear()
    picture(35.0, 0.25, 2.0, 0.1)
    picture(50.0, 0.75, 3.0, 0.2)
    assert compilations == []


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda a: se.render(*a, 3, **SIZE), "enhancement is a int"),
        (lambda a: se.render(*a, se.LightWarp(np.nan), **SIZE), "alpha is nan"),
        (
            lambda a: se.render(*a, se.LightWarp(1.0, 2.0), **SIZE),
            r"gamma is 2.0; accepted are finite numbers in \[-1, 1\]",
        ),
        (lambda a: se.render(*a, se.RadianceScaling(0.0), **SIZE), r"invariant is 0.0"),
        (lambda a: se.render(*a, se.LightWarp(1.0), sigma=-1.0, **SIZE), "sigma is -1"),
        (lambda a: se.render(*a, height=0, width=4), "height is 0"),
        (lambda a: se.render(None, *a[1:], **SIZE), "mesh is a NoneType"),
    ],
)
def test_errors(call, words):
    with pytest.raises(ValueError, match=words):
        call(scene())
