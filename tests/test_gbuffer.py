"""The G-buffer of a mesh: against a sphere's closed form, its conventions (SPEC 1, 2, 11)."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from shapeenh import Mesh, interpolate, orthographic_camera, perspective_camera, rasterize, render_gbuffer
from shapeenh.types import replace
from tests.test_visibility import H, W, cast, make


def ball(dtype=np.float32):
    solid = trimesh.creation.icosphere(subdivisions=3)
    mesh = make(solid.vertices, solid.faces, dtype)
    return replace(mesh, normals=mesh.vertices)


def camera_of(kind, dtype=np.float32):
    if kind == "orthographic":
        return cast(orthographic_camera((1, 2, 3), (0.1, 0, 0), height=2.4, aspect=W / H), dtype)
    return cast(perspective_camera((1, 2, 3), (0.1, 0, 0), fov_degrees=38, aspect=W / H), dtype)


def rays(camera):
    """Origin and direction in camera space of the ray through each pixel centre."""
    inverse = np.linalg.inv(np.asarray(camera.projection, np.float64))
    x, y = np.meshgrid((np.arange(W) + 0.5) * 2 / W - 1, 1 - (np.arange(H) + 0.5) * 2 / H)
    at = [np.stack([x, y, np.full_like(x, z), np.ones_like(x)], -1) @ inverse.T for z in (-1.0, 0.5)]
    at = [p[..., :3] / p[..., 3:] for p in at]
    return at[0], at[1] - at[0]


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_a_sphere(dtype, kind):
    mesh, camera = ball(dtype), camera_of(kind, dtype)
    g = render_gbuffer(mesh, camera, height=H, width=W)
    assert {g.depth.dtype, g.normal.dtype, g.position.dtype} == {np.dtype(dtype)}
    mask = np.asarray(g.mask)
    centre = np.asarray(camera.view, np.float64)[:3, 3]
    origin, direction = rays(camera)
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    along = ((centre - origin) * direction).sum(-1)
    miss = np.linalg.norm(origin + along[..., None] * direction - centre, axis=-1)
    assert mask[miss < 0.98].all()
    assert not mask[miss > 1.001].any()
    inner = mask & (miss < 0.95)
    point = origin + (along - np.sqrt(np.maximum(1 - miss**2, 0)))[..., None] * direction
    # 1,280 faces: the chord stays within 0.6 % of the radius, the normals of neighbours differ by 8 degrees
    assert np.abs(np.asarray(g.position) - point)[inner].max() < 0.03
    assert np.median(np.abs(np.asarray(g.position) - point)[inner]) < 0.004
    assert np.abs(np.asarray(g.normal) - (point - centre))[inner].max() < 0.03
    # on the pixel's ray, exactly
    off = np.cross(np.asarray(g.position) - origin, direction)[mask]
    assert np.abs(off).max() < (1e-12 if dtype == np.float64 else 5e-6)


def check_conventions(g):
    mask = np.asarray(g.mask)
    normal, position, depth = (np.asarray(a) for a in (g.normal, g.position, g.depth))
    eps = np.finfo(normal.dtype).eps
    assert np.abs(np.linalg.norm(normal[mask], axis=-1) - 1).max() < 8 * eps
    assert (normal[mask][:, 2] > 0).all()
    assert np.array_equal(depth[mask], -position[mask][:, 2])
    assert (depth[mask] > 0).all()
    for field in (normal, position, depth):
        assert (field[~mask] == 0).all()


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_conventions(dtype, kind):
    g = render_gbuffer(ball(dtype), camera_of(kind, dtype), height=H, width=W)
    check_conventions(g)
    assert np.array_equal(g.mask, rasterize(ball(dtype), camera_of(kind, dtype), height=H, width=W).triangle >= 0)
    assert g.albedo is None
    assert g.uv is None
    assert g.occlusion is None


def test_normals_face_the_viewer_whatever_the_orientation():
    """Turned-over faces, inward normals, or both: the same picture. From inside: the inner side."""
    mesh, camera = ball(), camera_of("perspective")
    upright = np.asarray(render_gbuffer(mesh, camera, height=H, width=W).normal)
    turned = replace(mesh, faces=mesh.faces[:, ::-1])
    for other in (turned, replace(mesh, normals=-mesh.normals), replace(turned, normals=-mesh.normals)):
        assert np.abs(np.asarray(render_gbuffer(other, camera, height=H, width=W).normal) - upright).max() < 1e-5
    inside = cast(perspective_camera((0, 0, 0), (0, 0, -1), fov_degrees=60, aspect=W / H), np.float32)
    g = render_gbuffer(mesh, inside, height=H, width=W)
    check_conventions(g)
    middle = np.asarray(g.normal)[H // 2, W // 2]
    assert middle[2] > 0.99
    unit = np.asarray(g.position) / np.linalg.norm(np.asarray(g.position), axis=-1, keepdims=True)
    assert np.abs(np.asarray(g.normal) + unit).max() < 0.02


def test_only_what_was_asked_for(rng):
    mesh, camera = ball(), camera_of("perspective")
    count = mesh.vertices.shape[0]
    colors, uv = (jnp.asarray(rng.uniform(size=(count, n)), jnp.float32) for n in (3, 2))
    full = replace(mesh, colors=colors, uv=uv)
    g = render_gbuffer(full, camera, height=H, width=W, uv=True)
    seen = rasterize(mesh, camera, height=H, width=W)
    assert np.allclose(g.albedo, interpolate(colors, mesh, camera, seen), atol=1e-6)
    assert np.allclose(g.uv, interpolate(uv, mesh, camera, seen), atol=1e-6)
    plain = render_gbuffer(full, camera, height=H, width=W, albedo=False)
    assert plain.albedo is None
    assert plain.uv is None
    assert np.allclose(plain.normal, g.normal, atol=1e-6)
    with pytest.raises(ValueError, match=r"uv is True, but mesh\.uv is None"):
        render_gbuffer(mesh, camera, height=H, width=W, uv=True)
    with pytest.raises(ValueError, match=r"mesh\.normals has shape"):
        render_gbuffer(replace(mesh, normals=mesh.normals[:3]), camera, height=H, width=W)
    with pytest.raises(ValueError, match=r"mesh\.normals holds 1 NaN"):
        render_gbuffer(replace(mesh, normals=mesh.normals.at[0, 0].set(jnp.nan)), camera, height=H, width=W)


def test_an_empty_mesh():
    nothing = Mesh(jnp.zeros((0, 3)), jnp.zeros((0, 3), jnp.int32), jnp.zeros((0, 3)))
    g = render_gbuffer(nothing, camera_of("perspective"), height=5, width=4)
    assert not np.asarray(g.mask).any()
    assert g.normal.shape == (5, 4, 3)
    assert (np.asarray(g.depth) == 0).all()
