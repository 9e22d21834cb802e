"""Curvature of rendered meshes: it does not depend on the roll of the camera, and on zoom and resolution only by its
unit, 1/px."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

import shapeenh as se

MESH = {"major": 1.0, "minor": 0.45, "segments": 128}
EYE = np.array([1.5, 4.0, 6.0])
SIGMA = 1.5  # at a height of 96


def torus():
    return se.torus(**MESH)


def described(height, *, up=(0.0, 1.0, 0.0), fov=30.0, distance=1.0, sigma=SIGMA):
    """(Hessian, G-buffer) of a square picture."""
    eye = EYE * distance
    camera = se.perspective_camera(tuple(eye), (0.0, 0.0, 0.0), up=up, fov_degrees=fov, aspect=1.0)
    g = se.render_gbuffer(torus(), camera, height=height, width=height)
    return np.asarray(se.describe(g, sigma=sigma).hessian), g


def interior(g, margin):
    """Off the outline and the silhouettes, and not so steep that a pixel sees a long stretch of surface."""
    near = np.asarray(g.mask) & (np.asarray(g.normal)[..., 2] > 0.6)
    return distance_transform_edt(np.pad(near, 1))[1:-1, 1:-1] > margin


def relative(a, b, on):
    """Median over pixels of |a - b| / |b|."""
    return np.median(np.linalg.norm((a - b)[on], axis=-1) / np.linalg.norm(b[on], axis=-1))


@pytest.fixture(scope="module")
def upright():
    return described(96)


@pytest.mark.parametrize("degrees", [90.0, 30.0])
def test_rolling_the_camera_turns_the_tensor(upright, degrees):
    """Mean and Gaussian curvature at the same place of the surface are the same; the tensor is turned."""
    hessian, g = upright
    # the camera's own up, turned about its view axis: the picture turns the other way
    forward = -EYE / np.linalg.norm(EYE)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    angle = np.deg2rad(degrees)
    up = np.cos(angle) * np.cross(right, forward) + np.sin(angle) * right
    rolled, r = described(96, up=tuple(up))
    # where a pixel of the rolled picture lies in the upright one; sampled at the nearest pixel
    rows, columns = np.mgrid[:96, :96] + 0.5 - 48
    x, y = columns, -rows
    x0, y0 = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    row, column = np.rint(48 - y0 - 0.5).astype(int), np.rint(x0 + 48 - 0.5).astype(int)
    there = (row >= 0) & (row < 96) & (column >= 0) & (column < 96)
    row, column = np.clip(row, 0, 95), np.clip(column, 0, 95)
    on = interior(r, 4) & there & interior(g, 4)[row, column]
    assert on.sum() > 300
    c, s = np.cos(angle), np.sin(angle)
    xx, xy, yy = np.moveaxis(hessian[row, column], -1, 0)
    # v = R v0 with R a turn by +angle: H = R H0 R^T
    turned = np.stack(
        [
            c * c * xx - 2 * c * s * xy + s * s * yy,
            c * s * (xx - yy) + (c * c - s * s) * xy,
            s * s * xx + 2 * c * s * xy + c * c * yy,
        ],
        -1,
    )
    # at 90 degrees pixel centres fall on pixel centres; else up to half a pixel of shift remains
    assert relative(rolled, turned, on) < (1e-3 if degrees == 90 else 0.05)


def test_resolution_enters_by_the_unit(upright):
    """Twice the pixels, half the curvature per pixel, at a sigma of twice the pixels."""
    hessian, g = upright
    fine, f = described(192, sigma=2 * SIGMA)
    blocks = fine.reshape(96, 2, 96, 2, 3).mean((1, 3)) * 2
    on = interior(g, 4) & interior(f, 8).reshape(96, 2, 96, 2).all((1, 3))
    assert relative(blocks, hessian, on) < 0.03


def test_zoom_enters_by_the_unit():
    """The middle half of a picture taken with half the field of view shows half the curvature per pixel."""
    wide, w = described(96, fov=50.0)
    half = 2 * np.rad2deg(np.arctan(np.tan(np.deg2rad(25.0)) / 2))
    near, n = described(96, fov=half, sigma=2 * SIGMA)
    middle = wide[24:72, 24:72]
    blocks = near.reshape(48, 2, 48, 2, 3).mean((1, 3)) * 2
    on = interior(w, 4)[24:72, 24:72] & interior(n, 8).reshape(48, 2, 48, 2).all((1, 3))
    assert on.sum() > 50
    assert relative(blocks, middle, on) < 0.03


def test_size_of_the_object_does_not_matter(upright):
    """A scene in other world units, seen from as many of them, is the same picture."""
    hessian, _ = upright
    ring = torus()
    mesh = se.make_mesh(np.asarray(ring.vertices) * 1000, ring.faces, normals=ring.normals)
    camera = se.perspective_camera(tuple(EYE * 1000), (0.0, 0.0, 0.0), fov_degrees=30.0, aspect=1.0)
    g = se.render_gbuffer(mesh, camera, height=96, width=96)
    got = np.asarray(se.describe(g, sigma=jnp.float32(SIGMA)).hessian)
    assert relative(got, hessian, interior(g, 2)) < 1e-3
