"""Padding: the same pictures, and few sizes."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from shapeenh import make_mesh, pad_mesh, render_gbuffer
from shapeenh.buffers.padding import rung
from shapeenh.types import replace
from tests.test_gbuffer import camera_of
from tests.test_visibility import FACES, VERTICES, H, W


def ball():
    solid = trimesh.creation.icosphere(subdivisions=2)
    return make_mesh(solid.vertices, solid.faces, normals=solid.vertices)


def test_the_ladder_holds_everything_with_little_to_spare():
    sizes = [rung(n) for n in range(1, 70_000, 7)]
    assert all(size >= n for size, n in zip(sizes, range(1, 70_000, 7), strict=True))
    assert all(size <= 1.25 * n + 1 for size, n in zip(sizes, range(1, 70_000, 7), strict=True) if n > 256)
    assert len(set(sizes)) < 36
    assert rung(256) == 256
    assert rung(257) == 320


def test_a_padded_mesh_gives_the_same_picture(rng):
    mesh, camera = ball(), camera_of("perspective")
    mesh = replace(mesh, colors=jnp.asarray(rng.uniform(size=mesh.vertices.shape), jnp.float32))
    small, padded = pad_mesh(mesh), pad_mesh(mesh, vertices=VERTICES, faces=FACES)
    assert small.vertices.shape == (256, 3)
    assert small.faces.shape == (320, 3)
    assert padded.faces.shape == (FACES, 3)
    a, b = (render_gbuffer(m, camera, height=H, width=W) for m in (mesh, padded))
    assert np.array_equal(a.mask, b.mask)
    assert np.allclose(a.normal, b.normal, atol=1e-6)
    assert np.allclose(a.albedo, b.albedo, atol=1e-6)


def test_sizes_that_do_not_fit():
    mesh = ball()
    assert pad_mesh(mesh, vertices=200, faces=321).faces.shape == (321, 3)
    with pytest.raises(ValueError, match="vertices is 100; accepted are integers from 162"):
        pad_mesh(mesh, vertices=100)
    with pytest.raises(ValueError, match="faces is 319"):
        pad_mesh(mesh, faces=319)
