"""SPEC 3, 4 on sphere, torus, ellipsoid, saddle, cylinder: every kind of curvature, second order in resolution."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

import shapeenh as se
from tests.reference import surfaces

NAMES = ("sphere", "torus", "ellipsoid", "saddle", "cylinder")
EXACT = 1e-7  # relative: where the scheme has no error at all, an order means nothing


def buffer(fields):
    floats = {k: jnp.asarray(v) for k, v in fields.items() if k != "mask"}
    return se.GBuffer(mask=jnp.asarray(fields["mask"]), **floats)


def relative(error, wanted, on):
    return np.sqrt(np.mean(np.sum(error[on] ** 2, -1)) / np.mean(np.sum(wanted[on] ** 2, -1)))


@pytest.mark.parametrize("name", NAMES)
def test_view_centred_and_apparent(x64, name):
    errors = []
    for n in (1, 2):
        fields, hessian, apparent, gentle = surfaces.fields(name, n)
        inside = np.pad(fields["mask"], 1)
        on = gentle & (distance_transform_edt(inside)[1:-1, 1:-1] > 2 * n)
        g = buffer(fields)
        plain, shown = (np.asarray(kind(g).hessian) for kind in (se.describe, se.describe_apparent))
        errors.append([relative(plain - hessian, hessian, on), relative(shown - apparent, apparent, on)])
    coarse, fine = np.array(errors)
    assert (coarse < 0.05).all(), coarse
    assert ((coarse / np.maximum(fine, 1e-300) > 3.3) | (fine < EXACT)).all(), (coarse, fine)


@pytest.mark.parametrize("name", NAMES)
def test_object_centred(x64, name):
    """Principal curvatures of a triangulated patch with exact normals."""
    errors = []
    for count in (13, 25):
        vertices, faces, normals, wanted, inner = surfaces.patch(name, count)
        mesh = se.make_mesh(vertices, faces.astype(np.int32), normals=normals)
        t = np.asarray(se.vertex_curvature(mesh))[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        np.testing.assert_allclose(np.einsum("vij,vj->vi", t, normals), 0, atol=1e-9)
        values = np.linalg.eigvalsh(t)
        order = np.argsort(np.abs(values), axis=1)[:, 1:]  # without the normal's
        got = np.sort(np.take_along_axis(values, order, 1), 1)
        errors.append(relative(got - wanted, wanted, inner))
    assert errors[0] < 0.1
    assert errors[0] / max(errors[1], 1e-300) > 3.3 or errors[1] < EXACT, errors
