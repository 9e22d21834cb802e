"""SPEC 4: object-centred, apparent and relief descriptors against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.types import replace
from tests.reference import descriptor as reference


def buffer(fields):
    floats = {k: jnp.asarray(v) for k, v in fields.items() if k != "mask"}
    return se.GBuffer(mask=jnp.asarray(fields["mask"]), **floats)


def principal(tensor):
    """The two curvatures of `[V, 6]` tensors: the eigenvalues but the one closest to 0, ascending."""
    t = np.asarray(tensor)
    full = t[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    values = np.linalg.eigvalsh(full)
    order = np.argsort(np.abs(values), axis=1)[:, 1:]
    return np.sort(np.take_along_axis(values, order, 1), 1)


def precise(mesh):
    return se.make_mesh(np.asarray(mesh.vertices, np.float64), mesh.faces, normals=np.asarray(mesh.normals, np.float64))


def test_sphere_has_one_curvature(x64):
    ball = precise(se.sphere(radius=2.0, rings=12))
    ball = se.make_mesh(ball.vertices, ball.faces, normals=ball.vertices / 2)
    tensor = se.vertex_curvature(ball)
    np.testing.assert_allclose(principal(tensor), -0.5, atol=1e-9)
    full = np.asarray(tensor)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    np.testing.assert_allclose(np.einsum("vij,vj->vi", full, ball.normals), 0, atol=1e-9)


def test_torus_to_second_order(x64):
    errors = []
    for segments in (32, 64):
        ring = precise(se.torus(major=1.0, minor=0.4, segments=segments))
        v = np.asarray(ring.vertices)
        axis = int(np.argmin(v.std(0)))
        r = np.sqrt((v**2).sum(1) - v[:, axis] ** 2)
        wanted = np.sort(np.stack([np.full_like(r, -2.5), -(r - 1) / 0.4 / r], -1), 1)
        errors.append(np.sqrt(np.mean((principal(se.vertex_curvature(ring)) - wanted) ** 2)))
    assert 3.4 < errors[0] / errors[1] < 4.6


def test_degenerate_faces_count_for_nothing(x64):
    ball = precise(se.sphere(radius=1.0, rings=12))
    faces = np.concatenate([np.asarray(ball.faces), [[0, 0, 1], [2, 2, 2]]])
    same = se.vertex_curvature(replace(ball, faces=jnp.asarray(faces, jnp.int32)))
    np.testing.assert_allclose(same, se.vertex_curvature(ball), atol=1e-12)
    grad = jax.grad(lambda v: jnp.sum(se.vertex_curvature(replace(ball, vertices=v, faces=jnp.asarray(faces)))))
    assert np.isfinite(np.asarray(grad(ball.vertices))).all()


def test_object_centred_curvature_does_not_depend_on_the_view(x64):
    f, _ = reference.sphere(40, 50, 17.3)
    n = f["normal"]
    eye = np.eye(3)
    tensor = -(eye - n[..., :, None] * n[..., None, :]) / 17.3  # the exact one of the sphere
    packed = np.stack([tensor[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], -1)
    camera = se.orthographic_camera((0, 0, 5), (0, 0, 0), height=40.0, aspect=1.25)
    h = se.describe_object(buffer(f), jnp.asarray(packed), camera).hessian
    k1, k2 = se.principal_curvatures(h)
    on = f["mask"]
    np.testing.assert_allclose(np.asarray(k1)[on], -1 / 17.3, atol=1e-9)
    np.testing.assert_allclose(np.asarray(k2)[on], -1 / 17.3, atol=1e-9)
    assert not np.asarray(h)[~on].any()


def test_apparent_curvature_of_a_sphere(x64):
    """It grows towards the outline like 1 / (R n_z) (TH10 fig. 4.2)."""
    f, _ = reference.sphere(40, 50, 17.3)
    d = se.describe_apparent(buffer(f))
    k1, k2 = (np.asarray(k) for k in se.principal_curvatures(d.hessian))
    on = f["mask"]
    np.testing.assert_allclose(k2[on] * 17.3 * f["normal"][..., 2][on], -1, atol=1e-9)
    np.testing.assert_allclose(k1, 0, atol=1e-9)
    grad = jax.grad(lambda n: jnp.sum(se.describe_apparent(replace(buffer(f), normal=n)).hessian))
    assert np.isfinite(np.asarray(grad(jnp.asarray(f["normal"])))).all()


def test_apparent_relief(x64):
    """On a sphere n_xy = p / R: L = tanh(1 / R) away from the outline, signed by the convexity of the base."""
    f, _ = reference.sphere(40, 50, 17.3)
    g = buffer(f)
    middle = np.s_[18:22, 23:27]
    mean = np.asarray(se.mean_curvature(se.describe_relief(g, sigma=1.0).hessian))[middle]
    np.testing.assert_allclose(mean, -np.tanh(1 / 17.3), rtol=1e-3)
    strong = np.asarray(se.mean_curvature(se.describe_relief(g, sigma=1.0, beta=-2.0).hessian))[middle]
    x = np.tanh(1 / 17.3)
    np.testing.assert_allclose(strong, -x / (np.exp(-2) * (1 - x) + x), rtol=1e-3)
    varying = se.describe_relief(g, sigma=jnp.broadcast_to(jnp.linspace(0.8, 2.0, 50)[None], (40, 50)), scales=2)
    np.testing.assert_allclose(np.asarray(se.mean_curvature(varying.hessian))[middle], mean, rtol=1e-2)
    intensity = np.asarray(se.mean_curvature(varying.hessian))
    assert np.isfinite(intensity).all()
    assert np.abs(intensity).max() <= 1 + 1e-6


def test_intensity_control():
    x = jnp.linspace(0, 1, 11)
    np.testing.assert_allclose(se.curvature_intensity(x, beta=0.0), x, atol=1e-7)
    inverse = se.curvature_intensity(se.curvature_intensity(x, beta=1.5), beta=-1.5)
    np.testing.assert_allclose(inverse, x, atol=1e-6)


def test_wrong_arguments_are_named():
    f, _ = reference.waves(8, 9)
    g = buffer({k: np.asarray(v, np.float32) if k != "mask" else v for k, v in f.items()})
    camera = se.orthographic_camera((0, 0, 5), (0, 0, 0), height=8.0, aspect=1.0)
    with pytest.raises(ValueError, match="tensor"):
        se.describe_object(g, jnp.zeros((8, 9, 3)), camera)
    with pytest.raises(ValueError, match="sigma"):
        se.describe_relief(g, sigma=0.0)
    with pytest.raises(ValueError, match="beta"):
        se.describe_relief(g, beta=99.0)
    with pytest.raises(ValueError, match="mesh"):
        se.vertex_curvature(g)
