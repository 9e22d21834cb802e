"""SPEC 3.2: no false silhouettes on steep smooth surfaces, none missed, whatever the scale, slope and field of view."""

import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from tests.reference import silhouettes as scenes

SIZE = (60, 80)


def found(fields):
    floats = {k: jnp.asarray(v) for k, v in fields.items() if k != "mask"}
    return np.asarray(se.describe(se.GBuffer(mask=jnp.asarray(fields["mask"]), **floats)).silhouette)


@pytest.mark.parametrize("fov", [0, 10, 45, 100])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_steps_and_slopes(x64, fov, scale):
    """A step of k pixels on a plane of slope s: on its far side, and nowhere else, as soon as k >= 0.8 (1 + s^2) (then
    it is longer than 0.8 of the distance between samples); and never for k = 0."""
    for slope in (0.0, 0.6, -0.6, 3.0) if fov < 45 else (0.0, 0.6, -0.6):
        flat, _ = scenes.scaled(scenes.planes(*SIZE, slope, 0.0, fov), scale)
        assert not found(flat).any()
        for step in (0.85, 2.0, 10.0, 300.0):
            fields, far = scenes.scaled(scenes.planes(*SIZE, slope, step * (1 + slope**2), fov), scale)
            w = found(fields)
            assert (w[far] > 0.9).all(), (slope, step, w[far].min())
            assert not w[~far].any()


@pytest.mark.parametrize("fov", [0, 10, 45, 100])
def test_spheres_have_no_silhouette_inside(x64, fov):
    assert not found(scenes.ball(*SIZE, fov)[0]).any()


@pytest.mark.parametrize("fov", [10, 45, 100])
def test_a_sphere_before_another(x64, fov):
    """Every pixel on the far side is found, but for those where the step itself runs out; no other is."""
    fields, far = scenes.balls(*SIZE, fov)
    w = found(fields)
    assert far.sum() > 10
    assert (w[far] > 0.5).mean() > 0.95
    assert not (w[~far] > 0.5).any()


@pytest.mark.parametrize("steepness", [1.0, 3.0, 6.0])
def test_steep_waves_have_none(x64, steepness):
    assert not (found(scenes.wavy(*SIZE, steepness)[0]) > 0.5).any()
