"""Interpolation: the perspective-correct formula, its hand-written gradients, and slivers (SPEC 11)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapeenh import Camera, barycentrics, interpolate, orthographic_camera, perspective_camera, rasterize
from shapeenh.types import replace
from tests.reference import raster as twin
from tests.test_visibility import H, W, cast, make, soup, tessellation

CAMERAS = {
    "perspective": lambda: perspective_camera((0, 0.5, 4), (0, 0, 0), fov_degrees=40, aspect=W / H),
    "orthographic": lambda: orthographic_camera((1, 2, 3), (0, 0, 0), height=3.0, aspect=W / H),
    "inside": lambda: perspective_camera((0.1, 0.2, 0.3), (1, 0, -1), fov_degrees=80, aspect=W / H),
}


def scene(name, rng, dtype):
    vertices, faces = soup(rng, 60, 0.5)
    mesh, camera = make(vertices, faces, dtype), cast(CAMERAS[name](), dtype)
    attribute = jnp.asarray(rng.normal(size=(mesh.vertices.shape[0], 4)), dtype)
    return attribute, mesh, camera, rasterize(mesh, camera, height=H, width=W)


def plain(attribute, vertices, camera, faces, triangle):
    """The same function in ordinary jax.numpy, differentiated by autodiff."""
    m = camera.projection @ camera.view
    clip = jnp.concatenate([vertices, jnp.ones_like(vertices[:, :1])], 1) @ m.T
    face = faces[jnp.maximum(triangle, 0)]
    height, width = triangle.shape
    p = ((jnp.arange(width) + 0.5) * 2 / width - 1)[None, :, None]
    q = (1 - (jnp.arange(height) + 0.5) * 2 / height)[:, None, None]
    c = clip[face]
    ax, ay = c[..., 0] - p * c[..., 3], c[..., 1] - q * c[..., 3]
    e = jnp.stack([ax[..., i - 2] * ay[..., i - 1] - ay[..., i - 2] * ax[..., i - 1] for i in range(3)], -1)
    b = e / jnp.where(triangle >= 0, e.sum(-1), 1)[..., None]
    return jnp.where((triangle >= 0)[..., None], jnp.sum(b[..., None] * attribute[face], -2), 0)


@pytest.mark.parametrize("name", CAMERAS)
def test_values_against_the_twin(dtype, rng, name):
    attribute, mesh, camera, seen = scene(name, rng, dtype)
    got = interpolate(attribute, mesh, camera, seen)
    assert got.dtype == dtype
    want, weights = twin.interpolate(
        attribute, mesh.vertices, mesh.faces, camera.view, camera.projection, np.asarray(seen.triangle)
    )
    wide = weights.min(-1) > -1 / 100  # the others are held at the edge of a face thinner than a pixel
    assert wide.mean() > 0.98
    tolerance = 1e-11 if dtype == np.float64 else 2e-3  # float32: weights of faces a few pixels small
    assert np.abs(np.asarray(got) - want)[wide].max() < tolerance
    assert np.median(np.abs(np.asarray(got) - want)) < (1e-14 if dtype == np.float64 else 1e-6)
    b = np.asarray(barycentrics(mesh, camera, seen))
    assert np.abs(b - weights)[wide].max() < tolerance
    mask = np.asarray(seen.triangle) >= 0
    assert np.abs(b.sum(-1) - mask).max() < 20 * np.finfo(dtype).eps
    assert (np.asarray(got)[~mask] == 0).all()


def test_a_linear_attribute_is_linear_on_the_surface(dtype, rng):
    """The interpolated world position lies on the pixel's ray and in the plane of the floor, far beyond the corners."""
    vertices, faces = tessellation(rng, 5.0, 12)
    mesh = make(vertices[:, [0, 2, 1]] * [1, 1, -1], faces, dtype)
    camera = cast(perspective_camera((0.3, 1.0, 0.2), (0.1, 0.4, -3), fov_degrees=70, aspect=W / H), dtype)
    seen = rasterize(mesh, camera, height=H, width=W)
    point = np.asarray(interpolate(mesh.vertices, mesh, camera, seen), np.float64)
    mask = np.asarray(seen.triangle) >= 0
    clip = twin.clip_coordinates(point[mask], camera.view, camera.projection)
    x, y = (clip[:, 0] / clip[:, 3] + 1) * W / 2 - 0.5, (1 - clip[:, 1] / clip[:, 3]) * H / 2 - 0.5
    row, column = np.nonzero(mask)
    tolerance = 1e-9 if dtype == np.float64 else 2e-3
    assert np.abs(x - column).max() < tolerance
    assert np.abs(y - row).max() < tolerance
    assert np.abs(point[mask][:, 1]).max() < tolerance


@pytest.mark.parametrize("name", CAMERAS)
def test_gradients_equal_autodiff(x64, rng, name):
    attribute, mesh, camera, seen = scene(name, rng, x64)
    b = np.asarray(barycentrics(mesh, camera, seen))
    usual = (np.asarray(seen.triangle) >= 0) & (b.min(-1) > 1e-9)
    cotangent = jnp.asarray(rng.normal(size=(H, W, 4)) * usual[..., None])

    def ours(attribute, vertices, camera):
        return jnp.sum(cotangent * interpolate(attribute, replace(mesh, vertices=vertices), camera, seen))

    def autodiff(attribute, vertices, camera):
        return jnp.sum(cotangent * plain(attribute, vertices, camera, mesh.faces, seen.triangle))

    args = (attribute, mesh.vertices, camera)
    got, want = jax.grad(ours, (0, 1, 2))(*args), jax.grad(autodiff, (0, 1, 2))(*args)
    for g, w in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert np.abs(g - w).max() <= 1e-10 * max(1, np.abs(w).max())
    assert np.abs(got[2].view).max() > 1


def test_gradients_of_held_weights(x64, rng):
    """A needle that the snapped pixel misses by more than 1/64 of its height: central differences of the held value."""
    vertices = np.array([(-20.0, 0.4999, 0), (20, 0.4987, 0.5), (3, 0.4965, -0.7)])
    view = np.eye(4)
    view[2, 3] = -100
    camera = Camera(jnp.asarray(view), jnp.asarray(np.diag([2 / W, 2 / H, -1 / 100, 1])))
    mesh = make(vertices, [(0, 1, 2)], x64)
    seen = rasterize(mesh, camera, height=H, width=W)
    assert (np.asarray(seen.triangle) >= 0).any()
    attribute = jnp.asarray(rng.normal(size=(1280, 2)))

    def value(attribute, v):
        return jnp.sum(interpolate(attribute, replace(mesh, vertices=v), camera, seen) ** 2)

    v = mesh.vertices
    got = jax.grad(value, 1)(attribute, v)
    for k in range(3):
        step = jnp.zeros_like(v).at[k, 1].set(1e-8)
        want = (value(attribute, v + step) - value(attribute, v - step)) / 2e-8
        assert abs(got[k, 1] - want) <= 1e-5 * max(1, abs(want))


@pytest.mark.parametrize("height", [1e-1, 1e-2, 1e-3, 1e-5])
def test_slivers_throw_no_sparks(dtype, rng, height):
    """Values stay within the corners' range (to 1/64 of it), depth-spanning needles under perspective included."""
    start, end = rng.uniform(-1, 1, (40, 3)), rng.uniform(-1, 1, (40, 3)) - [0, 0, 20]
    third = (start + end) / 2 + height / 40 * rng.normal(size=(40, 3))
    vertices = np.stack([start, end, third], 1).reshape(-1, 3)
    mesh = make(vertices, np.arange(120).reshape(-1, 3), dtype)
    camera = cast(CAMERAS["perspective"](), dtype)
    seen = rasterize(mesh, camera, height=H, width=W)
    attribute = jnp.asarray(rng.uniform(size=(1280, 3)), dtype)
    value = interpolate(attribute, mesh, camera, seen)
    assert float(value.min()) >= -0.05
    assert float(value.max()) <= 1.05
    grads = jax.grad(lambda a, m, c: jnp.sum(interpolate(a, replace(mesh, vertices=m), c, seen)), (0, 1, 2))(
        attribute, mesh.vertices, camera
    )
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(grads))


def test_gradients_are_reproducible_and_empty_pixels_have_none(rng):
    attribute, mesh, camera, seen = scene("perspective", rng, np.float32)
    grad = jax.jit(jax.grad(lambda a, m, c: jnp.sum(jnp.sin(interpolate(a, m, c, seen))), (0, 2)))
    first, second = grad(attribute, mesh, camera), grad(attribute, mesh, camera)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert np.array_equal(a, b)
    empty = replace(seen, triangle=jnp.full((H, W), -1, jnp.int32))
    nothing = jax.grad(lambda a: jnp.sum(interpolate(a, mesh, camera, empty) + 1))(attribute)
    assert (np.asarray(nothing) == 0).all()


def test_vmap_over_cameras_and_attributes(x64, rng):
    attribute, mesh, camera, seen = scene("perspective", rng, x64)
    both = jnp.stack([attribute, 2 * attribute])
    out = jax.vmap(lambda a: interpolate(a, mesh, camera, seen))(both)
    assert np.allclose(out[1], 2 * out[0], atol=1e-12)
    moved = cast(perspective_camera((0.2, 0.4, 4), (0, 0, 0), fov_degrees=40, aspect=W / H), x64)
    cameras = jax.tree.map(lambda a, b: jnp.stack([a, b]), camera, moved)

    def total(camera):
        return jnp.sum(interpolate(attribute, mesh, camera, seen) ** 2)

    single = jax.jit(jax.value_and_grad(total))
    values, grads = jax.vmap(jax.value_and_grad(total))(cameras)
    for k in range(2):
        value, grad = single(jax.tree.map(lambda a, k=k: a[k], cameras))
        assert np.isclose(value, values[k], rtol=1e-12)
        assert np.allclose(grad.view, grads.view[k], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("height", "width"), [(1, 1), pytest.param(3, 70, marks=pytest.mark.slow)])
def test_small_images(rng, height, width):
    attribute, mesh, camera, _ = scene("perspective", rng, np.float32)
    seen = rasterize(mesh, camera, height=height, width=width)
    got = np.asarray(interpolate(attribute, mesh, camera, seen))
    want, weights = twin.interpolate(
        attribute, mesh.vertices, mesh.faces, camera.view, camera.projection, np.asarray(seen.triangle)
    )
    assert got.shape == (height, width, 4)
    assert np.abs(got - want)[weights.min(-1) > -1 / 100].max(initial=0) < 2e-3


def test_errors_name_the_argument(rng):
    attribute, mesh, camera, seen = scene("perspective", rng, np.float32)
    with pytest.raises(ValueError, match=r"attribute has shape \(1280,\)"):
        interpolate(attribute[:, 0], mesh, camera, seen)
    with pytest.raises(ValueError, match=r"attribute has shape \(7, 4\); accepted is \[1280, any\]"):
        interpolate(attribute[:7], mesh, camera, seen)
    with pytest.raises(ValueError, match="attribute holds 1 NaN"):
        interpolate(attribute.at[3, 1].set(jnp.nan), mesh, camera, seen)
    with pytest.raises(ValueError, match="visibility is a "):
        interpolate(attribute, mesh, camera, seen.triangle)
