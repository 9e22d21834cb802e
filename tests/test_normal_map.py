"""Textures and normal maps on meshes; sequences of deforming meshes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.buffers.normal_map import vertex_tangents
from shapeenh.types import replace
from tests.reference import sources as plain

H, W = 24, 32


def scene(dtype=np.float32, *, mirrored=False):
    """A bent grid with uv, half of it mirrored on request, seen at an angle."""
    n = 7
    t = np.linspace(-1, 1, n)
    x, y = np.meshgrid(t, t, indexing="xy")
    vertices = np.stack([x, y, 0.3 * x * y + 0.2 * np.cos(2 * x)], axis=-1).reshape(-1, 3).astype(dtype)
    uv = np.stack([np.abs(x) if mirrored else 0.5 + 0.5 * x + 0.1 * y, 0.5 + 0.4 * y + 0.05 * x], axis=-1)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij")
    a = i * n + j
    faces = np.stack([np.stack([a, a + 1, a + n + 1], -1), np.stack([a, a + n + 1, a + n], -1)], 2).reshape(-1, 3)
    mesh = se.make_mesh(vertices, faces, uv=uv.reshape(-1, 2).astype(dtype))
    camera = se.perspective_camera(np.array([0.5, 0.4, 4], dtype), (0, 0, 0), fov_degrees=30.0, aspect=W / H)
    return mesh, camera


def buffers(mesh, camera):
    seen = se.rasterize(mesh, camera, height=H, width=W)
    return se.render_gbuffer(mesh, camera, height=H, width=W, uv=True), seen


def bumps(h=16, w=20, strength=0.5):
    """A tangent-space map with twist, y up."""
    y, x = np.meshgrid(-(np.arange(h) + 0.5), np.arange(w) + 0.5, indexing="ij")
    zx, zy = strength * np.cos(x / 3) * np.cos(y / 2.5), -strength * np.sin(x / 3) * np.sin(y / 2.5)
    n = np.stack([-zx, -zy, np.ones_like(x)], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


# ------------------------------------------------------------------------------------------- textures


@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
def test_sampling_agrees_with_the_twin(wrap, dtype, rng):
    texture = rng.normal(size=(5, 7, 2)).astype(dtype)
    uv = rng.uniform(-1.5, 2.5, (4, 9, 2)).astype(dtype)
    uv[0, :4] = [[0, 0], [1, 1], [0.5, 0.5], [-1, 2]]
    got = np.asarray(se.sample_texture(texture, uv, wrap=wrap))
    assert got.dtype == dtype
    for r, c in np.ndindex(4, 9):
        expected = plain.bilinear(texture.astype(np.float64), *uv[r, c].astype(np.float64), wrap)
        np.testing.assert_allclose(got[r, c], expected, atol=1e-5 if dtype == np.float32 else 1e-12)


def test_texel_centres_and_corners(rng):
    texture = rng.random((3, 4, 1)).astype(np.float32)
    column, row = np.meshgrid(np.arange(4), np.arange(3))
    uv = np.stack([(column + 0.5) / 4, 1 - (row + 0.5) / 3], axis=-1)
    for wrap in ("repeat", "clamp"):
        np.testing.assert_allclose(se.sample_texture(texture, uv, wrap=wrap), texture, atol=1e-6)
    corner = se.sample_texture(texture, np.array([[0.0, 0.0], [1.0, 1.0]]), wrap="clamp")
    np.testing.assert_allclose(corner[:, 0], [texture[2, 0, 0], texture[0, 3, 0]], atol=1e-6)  # (0, 0) is lower left
    np.testing.assert_allclose(se.sample_texture(texture, [[np.nan, 1e30]]).shape, (1, 1))
    assert bool(jnp.isfinite(se.sample_texture(texture, jnp.asarray([[jnp.nan, 1e30], [jnp.inf, -1e30]]))).all())


def test_a_texture_as_albedo():
    mesh, camera = scene()
    g, _ = buffers(mesh, camera)
    ramp = np.stack(np.meshgrid((np.arange(64) + 0.5) / 64, 1 - (np.arange(64) + 0.5) / 64), axis=-1)
    texture = np.concatenate([ramp, np.ones((64, 64, 1))], axis=-1).astype(np.float32)  # colour = (u, v, 1)
    got = se.apply_texture(g, texture, wrap="clamp")
    inner = np.asarray(g.mask) & (np.abs(np.asarray(g.uv) - 0.5).max(axis=-1) < 0.48)
    np.testing.assert_allclose(np.asarray(got.albedo)[inner, :2], np.asarray(g.uv)[inner], atol=1e-5)
    assert np.all(np.asarray(got.albedo)[~np.asarray(g.mask)] == 0)
    assert np.array_equal(got.normal, g.normal)
    with pytest.raises(ValueError, match=r"gbuffer\.uv is None"):
        se.apply_texture(replace(g, uv=None), texture)
    with pytest.raises(ValueError, match="texture has shape"):
        se.apply_texture(g, texture[..., :2])


def test_texture_errors():
    uv = np.zeros((2, 2, 2))
    for texture, message in (
        (np.zeros((3, 3)), "texture has shape"),
        (np.zeros((3, 0, 1)), "at least one texel"),
        (np.zeros((3, 3, 1), np.uint8), "texture has dtype uint8"),
    ):
        with pytest.raises(ValueError, match=message):
            se.sample_texture(texture, uv)
    with pytest.raises(ValueError, match="wrap is 'mirror'"):
        se.sample_texture(np.zeros((3, 3, 1)), uv, wrap="mirror")
    with pytest.raises(ValueError, match="uv has shape"):
        se.sample_texture(np.zeros((3, 3, 1)), uv[..., :1])


# ------------------------------------------------------------------------------------------- tangents


@pytest.mark.parametrize("mirrored", [False, True])
def test_tangents_agree_with_the_twin(mirrored, x64):
    mesh, _ = scene(np.float64, mirrored=mirrored)
    arrays = [np.asarray(a) for a in (mesh.vertices, mesh.faces, mesh.normals, mesh.uv)]
    got, turned = vertex_tangents(mesh.vertices, mesh.faces, mesh.normals, mesh.uv)
    got, turned = np.asarray(got).reshape(-1, 2, 3), np.asarray(turned)
    assert turned.any() == mirrored
    for f, corners in enumerate(plain.tangents(*arrays)):
        for k, (tangent, sign) in enumerate(corners):
            assert (sign < 0) == turned[f]
            np.testing.assert_allclose(got[arrays[1][f, k], int(turned[f])], tangent, atol=1e-9)


def test_degenerate_uv_have_no_tangent_and_finite_gradients(x64):
    mesh, _ = scene(np.float64)
    flat = jnp.zeros_like(mesh.uv)
    got, _ = vertex_tangents(mesh.vertices, mesh.faces, mesh.normals, flat)
    assert not np.any(np.asarray(got))
    loss = lambda v, n, t: jnp.sum(vertex_tangents(v, mesh.faces, n, t)[0] ** 3)  # noqa: E731
    for grad in jax.grad(loss, argnums=(0, 1, 2))(mesh.vertices, mesh.normals, flat):
        assert bool(jnp.isfinite(grad).all())


# ------------------------------------------------------------------------------------------- normal maps


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_flat_map_changes_nothing(mirrored, dtype):
    mesh, camera = scene(dtype, mirrored=mirrored)
    g, seen = buffers(mesh, camera)
    flat = np.tile(np.array([0, 0, 1], dtype), (4, 4, 1))
    got = se.apply_normal_map(g, mesh, camera, seen, flat)
    np.testing.assert_allclose(got.normal, g.normal, atol=1e-6)
    assert got.normal.dtype == dtype
    none = se.apply_normal_map(g, mesh, camera, seen, bumps().astype(dtype), strength=0.0)
    np.testing.assert_allclose(none.normal, g.normal, atol=1e-6)
    np.testing.assert_allclose(got.uv, g.uv, atol=1e-6)


def test_on_a_plane_the_map_is_the_picture(dtype):
    """A square, one texel per pixel: normals are the texels, whichever way green points."""
    mesh = se.plane(size=2.0, segments=6)
    mesh = se.make_mesh(np.asarray(mesh.vertices, dtype), mesh.faces, uv=np.asarray(mesh.uv, dtype))
    camera = se.orthographic_camera(np.array([0, 0, 3], dtype), (0, 0, 0), height=2.0, aspect=W / H)
    g, seen = buffers(mesh, camera)
    square = slice(None), slice((W - H) // 2, (W + H) // 2)
    assert bool(g.mask[square].all())
    n = bumps(H, H).astype(dtype)
    map_ = lambda texels, **options: se.apply_normal_map(g, mesh, camera, seen, texels, **options).normal[square]  # noqa: E731
    np.testing.assert_allclose(map_(n), n, atol=3e-6)
    np.testing.assert_allclose(map_(n * np.array([1, -1, 1], dtype), green="down"), n, atol=3e-6)
    np.testing.assert_allclose(map_(np.round((n + 1) / 2 * 65535).astype(np.uint16)), n, atol=5e-5)


def test_a_face_seen_from_behind_turns_its_mapped_normal_round(x64):
    """A bump on the one side is a dent on the other."""
    mesh, camera = scene(np.float64)
    g, seen = buffers(mesh, camera)
    front = np.asarray(se.apply_normal_map(g, mesh, camera, seen, bumps()).normal)
    inside_out = se.Mesh(mesh.vertices, mesh.faces[:, ::-1], -mesh.normals, uv=mesh.uv)
    g, seen = buffers(inside_out, camera)
    bent = bumps() * np.array([-1, -1, 1])  # the slopes of a bump, seen from its other side
    back = np.asarray(se.apply_normal_map(g, inside_out, camera, seen, bent, check=False).normal)
    held = np.minimum(front, back)[..., 2] < 0.0101
    np.testing.assert_allclose(back[~held], front[~held], atol=1e-9)


def test_tangent_space_agrees_with_the_twin(x64):
    """T, B, N of MikkTSpace, interpolated by barycentrics, pixel by pixel; with a mirrored half."""
    for mirrored in (False, True):
        mesh, camera = scene(np.float64, mirrored=mirrored)
        g, seen = buffers(mesh, camera)
        texture = bumps()
        got = np.asarray(se.apply_normal_map(g, mesh, camera, seen, texture, strength=0.8).normal)
        corners = plain.tangents(*(np.asarray(a) for a in (mesh.vertices, mesh.faces, mesh.normals, mesh.uv)))
        weights, rotation = np.asarray(se.barycentrics(mesh, camera, seen)), np.asarray(camera.view)[:3, :3]
        normals, uv, faces = (np.asarray(a) for a in (mesh.normals, mesh.uv, mesh.faces))
        triangle = np.asarray(seen.triangle)
        for r, c in zip(*np.nonzero(triangle >= 0), strict=True):
            f, w = triangle[r, c], weights[r, c]
            n = w @ normals[faces[f]]
            t = w @ np.stack([corners[f][k][0] for k in range(3)])
            b = corners[f][0][1] * np.cross(n, t)
            m = plain.bilinear(texture, *(w @ uv[faces[f]]), "repeat")
            expected = plain.unit(rotation @ (0.8 * (m[0] * t + m[1] * b) + m[2] * n))
            np.testing.assert_allclose(got[r, c], expected, atol=1e-9)


def test_object_space(dtype):
    """A map that holds the mesh's own normals changes nothing; the y axis is that of the mesh."""
    mesh, camera = scene(dtype)
    g, seen = buffers(mesh, camera)
    constant = np.tile(np.array([0.36, 0.48, 0.8], dtype), (3, 3, 1))
    got = se.apply_normal_map(g, mesh, camera, seen, constant, space="object")
    mask = np.asarray(g.mask)
    expected = np.asarray(camera.view)[:3, :3] @ [0.36, 0.48, 0.8]
    np.testing.assert_allclose(np.asarray(got.normal)[mask], np.broadcast_to(expected, (mask.sum(), 3)), atol=1e-6)
    tilted = np.tile(np.array([0.0, 0.6, 0.8], dtype), (3, 3, 1))
    bent = se.Mesh(mesh.vertices, mesh.faces, jnp.broadcast_to(jnp.asarray([0, 0.6, 0.8], dtype), (49, 3)), uv=mesh.uv)
    with pytest.warns(UserWarning, match="agrees less.*try green='up'"):
        se.apply_normal_map(g, bent, camera, seen, tilted, space="object", green="down")
    se.apply_normal_map(g, bent, camera, seen, tilted, space="object")


def test_the_wrong_green_of_a_map_is_noticed():
    mesh, camera = scene()
    g, seen = buffers(mesh, camera)
    n = bumps(40, 40).astype(np.float32)
    se.apply_normal_map(g, mesh, camera, seen, n)
    with pytest.warns(UserWarning, match="normal_map fits no surface with green down.*try green='up'"):
        se.apply_normal_map(g, mesh, camera, seen, n, green="down")
    se.apply_normal_map(g, mesh, camera, seen, n, green="down", check=False)


def test_bad_texels_leave_the_normal_alone():
    mesh, camera = scene()
    g, seen = buffers(mesh, camera)
    for value in (np.nan, np.inf, 0.0):
        for space in ("tangent", "object"):
            bad = np.full((4, 4, 3), value, np.float32)
            got = se.apply_normal_map(g, mesh, camera, seen, bad, space=space, check=False)
            np.testing.assert_allclose(got.normal, g.normal, atol=1e-6)


def test_normal_map_errors():
    mesh, camera = scene()
    g, seen = buffers(mesh, camera)
    n = bumps().astype(np.float32)
    bare = se.Mesh(mesh.vertices, mesh.faces, mesh.normals)
    small = se.Visibility(seen.triangle[:5, :5])
    cases = [
        ((g, bare, camera, seen, n), {}, r"mesh\.uv is None"),
        ((g, mesh, camera, small, n), {}, r"visibility\.triangle has shape \(5, 5\)"),
        ((g, mesh, camera, seen, n[..., :2]), {}, "normal_map has shape"),
        ((g, mesh, camera, seen, n), {"space": "world"}, "space is 'world'"),
        ((g, mesh, camera, seen, n), {"green": "x"}, "green is 'x'"),
        ((g, mesh, camera, seen, n), {"strength": -1}, "strength is -1"),
        ((g, mesh, camera, seen, n), {"wrap": "x"}, "wrap is 'x'"),
        ((None, mesh, camera, seen, n), {}, "gbuffer is a NoneType"),
    ]
    for arrays, options, message in cases:
        with pytest.raises(ValueError, match=message):
            se.apply_normal_map(*arrays, **options)


# ------------------------------------------------------------------------------------------- sequences


def test_a_deforming_mesh_does_not_recompile(compilations):
    """Same topology, new vertices per frame: everything after the first frame runs from the compiled code."""
    mesh, camera = scene()

    @jax.jit
    def bend(vertices, time):
        return vertices.at[:, 2].add(0.2 * jnp.sin(3 * vertices[:, 0] + time))

    def frame(time):
        vertices = bend(mesh.vertices, time)
        moved = se.Mesh(vertices, mesh.faces, se.vertex_normals(vertices, mesh.faces), uv=mesh.uv)
        g, seen = buffers(moved, camera)
        g = se.apply_normal_map(g, moved, camera, seen, bumps().astype(np.float32))
        return np.asarray(g.normal)

    first = frame(0.0)
    compilations.clear()
    others = [frame(time) for time in (0.5, 1.0)]
    assert compilations == []
    assert all(np.abs(f - first).max() > 0.05 for f in others)
