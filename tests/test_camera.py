"""Cameras: conventions, framing, errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from tests.reference.differences import assert_gradient


def clip(camera, points):
    p = np.concatenate([np.asarray(points, np.float64), np.ones((len(points), 1))], axis=1)
    return p @ (np.asarray(camera.projection, np.float64) @ np.asarray(camera.view, np.float64)).T


def test_perspective_conventions(dtype):
    eye, target = jnp.array([0.0, 0.0, 5.0], dtype), jnp.zeros(3, dtype)
    camera = se.perspective_camera(eye, target, fov_degrees=90.0, aspect=2.0)
    assert camera.view.dtype == camera.projection.dtype == dtype
    c = clip(camera, [[0, 0, 0], [0, 5, 0], [10, 0, 0], [0, 0, 4.995], [0, 0, -1e9]])
    np.testing.assert_allclose(c[0], [0, 0, 5 - 0.01, 5], atol=1e-6)  # the target is in the middle, w is the depth
    np.testing.assert_allclose(c[1, 1] / c[1, 3], 1, rtol=1e-6)  # fov is vertical, y up
    np.testing.assert_allclose(c[2, 0] / c[2, 3], 1, rtol=1e-6)  # x right, scaled by the aspect
    np.testing.assert_allclose(c[3, 2] / c[3, 3], -1, rtol=1e-3)  # near plane at a thousandth of the distance
    assert c[4, 2] < c[4, 3]  # no far plane


def test_view_is_a_rigid_motion_with_z_towards_the_viewer(x64):
    camera = se.perspective_camera((1.0, 2.0, 3.0), (0.5, -1.0, 0.0), up=(0.2, 1.0, 0.1))
    r = np.asarray(camera.view)[:3, :3]
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(r) > 0
    towards = np.array([0.5, 3.0, 3.0])
    np.testing.assert_allclose(r @ towards / np.linalg.norm(towards), [0, 0, 1], atol=1e-12)


def test_orthographic_conventions(dtype):
    eye, target = jnp.array([0.0, 0.0, 2.0], dtype), jnp.zeros(3, dtype)
    camera = se.orthographic_camera(eye, target, height=4.0, aspect=1.5)
    c = clip(camera, [[3, 2, 0], [0, 0, 2], [0, 0, -50]])
    np.testing.assert_allclose(c[0, [0, 1, 3]], [1, 1, 1], rtol=1e-6)
    np.testing.assert_allclose(c[1, 2], -1, rtol=1e-6)
    assert c[2, 2] < 1


@pytest.mark.parametrize("direction", [(0, 0, 1), (1, 0.5, 2), (-3, -1, 0.2)])
@pytest.mark.parametrize("aspect", [0.4, 4 / 3, 3.0])
def test_frame_mesh_touches_the_border_and_sees_all(direction, aspect, rng):
    vertices = rng.normal(size=(80, 3)) * [1, 3, 0.5] + [7, -2, 4]
    mesh = se.make_mesh(vertices, rng.integers(0, 80, (200, 3)))
    camera = se.frame_mesh(mesh, direction=direction, fov_degrees=35, aspect=aspect, margin=0.1)
    c = clip(camera, np.asarray(mesh.vertices))
    ndc = c[:, :2] / c[:, 3:]
    assert np.all(c[:, 3] > 0)
    np.testing.assert_allclose(np.abs(ndc).max(), 0.9, atol=1e-4)
    low, high = ndc.min(axis=0), ndc.max(axis=0)
    np.testing.assert_allclose((low + high)[np.argmax(high - low)], 0, atol=1e-4)


def test_framing_ignores_vertices_without_a_face():
    mesh = se.make_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1e5, 0, 0]], [[0, 1, 2]])
    camera = se.frame_mesh(mesh)
    assert abs(clip(camera, [[1, 0, 0]])[0, 3]) < 10


def test_frame_mesh_is_differentiable_in_vertices(x64, rng):
    mesh = se.make_mesh(rng.normal(size=(12, 3)), rng.integers(0, 12, (30, 3)))

    def eye(vertices):
        camera = se.frame_mesh(se.Mesh(vertices, mesh.faces, mesh.normals))
        return jnp.sum(camera.view[:3, 3] ** 2)

    assert_gradient(eye, mesh.vertices)
    assert np.all(np.isfinite(jax.grad(eye)(mesh.vertices)))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: se.perspective_camera((0, 0, 1), (0, 0, 1)), "two different points"),
        (lambda: se.perspective_camera((0, 1, 0), (0, 0, 0)), "up .* along the view axis"),
        (lambda: se.perspective_camera((0, 0, 1), (0, 0, 0), fov_degrees=180), r"fov_degrees is 180.*\]0, 180\["),
        (lambda: se.perspective_camera((0, 0, np.nan), (0, 0, 0)), "eye holds 1 NaN"),
        (lambda: se.perspective_camera((0, 0), (0, 0, 0)), r"eye has shape \(2,\)"),
        (lambda: se.orthographic_camera((0, 0, 1), (0, 0, 0), height=0), "height is 0"),
        (lambda: se.frame_mesh(se.make_mesh(np.zeros((0, 3)), np.zeros((0, 3), int))), "mesh is empty"),
        (lambda: se.frame_mesh(se.plane(), direction=(0, 0, 0)), "direction is zero"),
    ],
)
def test_errors(call, words):
    with pytest.raises(ValueError, match=words):
        call()
