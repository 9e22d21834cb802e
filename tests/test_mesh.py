"""Meshes and shapes: normals, laws, errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se


def signed_volume(mesh):
    v = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    return np.einsum("ij,ij->", v[:, 0], np.cross(v[:, 1], v[:, 2])) / 6


def test_normals_do_not_depend_on_the_tessellation(x64):
    """A cube corner: three square faces, each cut into triangles along either diagonal."""
    corner = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], float)
    quads = [(0, 3, 2, 1), (0, 1, 5, 4), (0, 4, 6, 3)]
    for cut in range(8):
        faces = []
        for k, (a, b, c, d) in enumerate(quads):
            faces += [(a, b, c), (a, c, d)] if cut >> k & 1 else [(a, b, d), (b, c, d)]
        n = se.vertex_normals(jnp.asarray(corner), jnp.asarray(faces))
        np.testing.assert_allclose(n[0], -np.ones(3) / np.sqrt(3), atol=1e-12)


def test_normals_of_a_sphere_converge(x64):
    errors = []
    for rings in (16, 32):
        mesh = se.sphere(rings=rings)
        n = se.vertex_normals(mesh.vertices, mesh.faces)
        errors.append(np.abs(n - mesh.normals).max())
    assert errors[1] < errors[0] / 3.5  # second order
    assert errors[1] < 5e-3


def test_normals_of_degenerate_faces_are_finite_and_have_finite_gradients(dtype):
    vertices = jnp.asarray([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 0], [5, 5, 5]], dtype)
    faces = jnp.asarray([[0, 1, 2], [0, 3, 1], [0, 0, 0]])
    n = se.vertex_normals(vertices, faces)
    assert n.dtype == dtype
    np.testing.assert_array_equal(n, np.tile([0, 0, 1], (5, 1)))
    g = jax.grad(lambda v: jnp.sum(se.vertex_normals(v, faces) * jnp.asarray([1, 2, 3], dtype)[None]))(vertices)
    assert np.all(np.isfinite(g))


@pytest.mark.parametrize("make", [se.sphere, se.torus, se.carved_knot])
def test_shapes_are_closed_outward_and_smooth(make):
    mesh = make()
    faces = np.asarray(mesh.faces)
    assert signed_volume(mesh) > 0
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    assert np.all(count == 2)
    v = np.asarray(mesh.vertices, np.float64)[faces]
    face_normal = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    assert np.all(np.sum(face_normal * np.asarray(mesh.normals)[faces].sum(axis=1), axis=-1) > 0)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)


def test_volumes():
    np.testing.assert_allclose(signed_volume(se.sphere(radius=2.0, rings=128)), 32 * np.pi / 3, rtol=1e-3)
    np.testing.assert_allclose(signed_volume(se.torus(major=2.0, minor=0.5)), 2 * np.pi**2 * 2 * 0.25, rtol=2e-3)


def test_plane_faces_the_viewer_and_carries_uv():
    mesh = se.plane(size=3.0, segments=4)
    assert np.all(np.asarray(mesh.normals) == [0, 0, 1])
    np.testing.assert_allclose(np.asarray(mesh.vertices)[:, :2], 3 * (np.asarray(mesh.uv) - 0.5), atol=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: se.make_mesh(np.zeros((3, 2)), [[0, 1, 2]]), r"vertices has shape \(3, 2\)"),
        (lambda: se.make_mesh(np.zeros((3, 3)), [[0, 1]]), r"faces has shape \(1, 2\)"),
        (lambda: se.make_mesh(np.full((3, 3), np.nan), [[0, 1, 2]]), "vertices holds 9 NaN"),
        (lambda: se.make_mesh(np.zeros((3, 3)), [[0, 1, 3]]), "indices from 0 to 3; accepted are 0 to 2"),
        (lambda: se.make_mesh(np.zeros((3, 3)), [[0.0, 1, 2]]), "faces has dtype float64"),
        (lambda: se.make_mesh(np.zeros((3, 3)), [[0, 1, 2]], uv=np.zeros((2, 2))), r"uv has shape \(2, 2\)"),
        (lambda: se.sphere(rings=1), "rings is 1"),
        (lambda: se.torus(minor=-1.0), "minor is -1"),
    ],
)
def test_errors(call, words):
    with pytest.raises(ValueError, match=words):
        call()
