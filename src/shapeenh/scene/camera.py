"""Cameras: look-at views, perspective and orthographic projections, and framing of a mesh.

World and camera space are right-handed; the camera looks down its -z axis. Projections map to OpenGL clip space.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.checks import check_finite, check_range, check_shape, check_type, float_dtype, is_concrete
from shapeenh.numerics import norm, normalize
from shapeenh.types import Camera, Mesh

NEAR_FRACTION = 1e-3  # near plane as a fraction of the distance from eye to target
ORTHOGRAPHIC_RANGE = 20.0  # depth range of an orthographic camera, in (eye-target distance + view height)


def perspective_camera(
    eye,
    target,
    *,
    up=(0.0, 1.0, 0.0),
    fov_degrees: float | jax.Array = 30.0,
    aspect: float | jax.Array = 4 / 3,
    near: float | jax.Array | None = None,
) -> Camera:
    """A perspective camera at `eye` that looks at `target`, without a far plane (SPEC 1).

    Args:
        eye, target: [3], world space.
        up: [3], world direction that points up in the image.
        fov_degrees: vertical field of view, ]0, 180[.
        aspect: width / height of the image, > 0.
        near: distance of the near plane, > 0; by default 1/1000 of the distance from eye to target.

    Returns: `Camera`; the far plane lies at infinity, so nothing is lost behind it.
    Gradient: with respect to every argument.
    Errors: ValueError for eye = target, `up` along the view axis, or numbers out of range.

    >>> camera = se.perspective_camera((0, 0, 5), (0, 0, 0), fov_degrees=40, aspect=16 / 9)
    """
    check_range("fov_degrees", fov_degrees, 0, 180, open_ends=True)
    check_range("aspect", aspect, 0, np.inf, open_ends=True)
    view, distance = look_at(eye, target, up)
    dtype = view.dtype
    if near is not None:
        check_range("near", near, 0, np.inf, open_ends=True)
    n = jnp.asarray(NEAR_FRACTION * distance if near is None else near, dtype)
    f = 1 / jnp.tan(jnp.deg2rad(jnp.asarray(fov_degrees, dtype)) / 2)
    projection = jnp.zeros((4, 4), dtype)
    projection = projection.at[0, 0].set(f / jnp.asarray(aspect, dtype)).at[1, 1].set(f)
    projection = projection.at[2, 2].set(-1).at[2, 3].set(-2 * n).at[3, 2].set(-1)
    return Camera(view, projection)


def orthographic_camera(
    eye,
    target,
    *,
    up=(0.0, 1.0, 0.0),
    height: float | jax.Array,
    aspect: float | jax.Array = 4 / 3,
) -> Camera:
    """An orthographic camera at `eye` that looks along `target - eye` (SPEC 1).

    Args:
        eye, target: [3], world space; the near plane passes through the eye.
        up: [3], world direction that points up in the image.
        height: world units seen from the bottom to the top of the image, > 0.
        aspect: width / height of the image, > 0.

    Returns: `Camera`; depth 0 at the eye, the far plane 20 times (eye-target distance + height) away.
    Gradient: with respect to every argument.
    Errors: ValueError for eye = target, `up` along the view axis, or numbers out of range.

    >>> camera = se.orthographic_camera((0, 0, 5), (0, 0, 0), height=2.0, aspect=1.0)
    """
    check_range("height", height, 0, np.inf, open_ends=True)
    check_range("aspect", aspect, 0, np.inf, open_ends=True)
    view, distance = look_at(eye, target, up)
    dtype = view.dtype
    h = jnp.asarray(height, dtype)
    far = ORTHOGRAPHIC_RANGE * (distance + h)
    projection = jnp.zeros((4, 4), dtype)
    projection = projection.at[0, 0].set(2 / (h * jnp.asarray(aspect, dtype))).at[1, 1].set(2 / h)
    projection = projection.at[2, 2].set(-2 / far).at[2, 3].set(-1).at[3, 3].set(1)
    return Camera(view, projection)


def frame_mesh(
    mesh: Mesh,
    *,
    direction=(0.0, 0.0, 1.0),
    up=(0.0, 1.0, 0.0),
    fov_degrees: float | jax.Array = 30.0,
    aspect: float | jax.Array = 4 / 3,
    margin: float = 0.06,
) -> Camera:
    """The perspective camera nearest to a mesh that still sees all of it.

    Args:
        mesh: what to see; only vertices that a face uses count.
        direction: [3], from the object towards the camera, world space, any length; (0, 0, 1) sees the front.
        up: [3], world direction that points up in the image.
        fov_degrees: vertical field of view, ]0, 180[.
        aspect: width / height of the image, > 0.
        margin: free border as a fraction of the image, [0, 0.9].

    Returns: `Camera`, exact: two opposite sides of the image are touched up to the margin.
    Gradient: with respect to vertices, direction and field of view (through the vertices that touch the frame).
    Errors: ValueError for an empty mesh, a zero direction, `up` along it, or numbers out of range.

    >>> camera = se.frame_mesh(mesh, direction=(1, 0.5, 2), fov_degrees=30, aspect=4 / 3)
    """
    check_type("mesh", mesh, Mesh)
    check_range("fov_degrees", fov_degrees, 0, 180, open_ends=True)
    check_range("aspect", aspect, 0, np.inf, open_ends=True)
    check_range("margin", margin, 0, 0.9)
    if mesh.faces.shape[0] == 0 or mesh.vertices.shape[0] == 0:
        raise ValueError("mesh is empty; accepted is a mesh with at least one face")
    check_finite("mesh.vertices", mesh.vertices)
    dtype = float_dtype(mesh.vertices)
    rotation = _axes(jnp.asarray(direction, dtype), jnp.asarray(up, dtype), "direction")

    # In the camera's axes: |x - ex| <= tx (ez - z) and |y - ey| <= ty (ez - z) for all points, with the least ez.
    used = jnp.zeros(mesh.vertices.shape[0], bool).at[mesh.faces.reshape(-1)].set(True)
    centre = 0.5 * (_extreme(jnp.max, mesh.vertices, used) + _extreme(jnp.min, mesh.vertices, used))
    points = (mesh.vertices - centre[None]) @ rotation.T
    ty = jnp.tan(jnp.deg2rad(jnp.asarray(fov_degrees, dtype)) / 2) * (1 - margin)
    tx = ty * jnp.asarray(aspect, dtype)
    right, left = (jnp.max(jnp.where(used, s * points[:, 0] + tx * points[:, 2], -jnp.inf)) for s in (1, -1))
    top, bottom = (jnp.max(jnp.where(used, s * points[:, 1] + ty * points[:, 2], -jnp.inf)) for s in (1, -1))
    front, back = _extreme(jnp.max, points, used)[2], _extreme(jnp.min, points, used)[2]
    size = jnp.max(jnp.abs(points) * used[:, None])
    distance = jnp.maximum((right + left) / (2 * tx), (top + bottom) / (2 * ty))
    distance = jnp.maximum(distance, front + 0.05 * (front - back) + 1e-3 * jnp.where(size > 0, size, 1))
    offset = jnp.stack([(right - left) / 2, (top - bottom) / 2, distance]) @ rotation
    eye = centre + offset
    target = eye - rotation[2] * (distance - 0.5 * (front + back))
    return perspective_camera(eye, target, up=up, fov_degrees=fov_degrees, aspect=aspect)


def look_at(eye, target, up) -> tuple[jax.Array, jax.Array]:
    """(view [4, 4], distance from eye to target)."""
    for name, value in (("eye", eye), ("target", target), ("up", up)):
        check_shape(name, value, (3,))
        check_finite(name, value)
    dtype = float_dtype(eye, target, up)
    eye, target, up = (jnp.asarray(a, dtype) for a in (eye, target, up))
    backwards = eye - target
    if is_concrete(backwards) and not np.any(np.asarray(backwards)):
        raise ValueError(f"eye and target are both {np.asarray(eye).tolist()}; accepted are two different points")
    rotation = _axes(backwards, up, "eye - target")
    view = jnp.zeros((4, 4), dtype).at[:3, :3].set(rotation).at[:3, 3].set(-rotation @ eye).at[3, 3].set(1)
    return view, norm(backwards)


def _axes(backwards, up, name: str):
    """Rows x (right), y (up), z (towards the viewer) of the camera."""
    check_shape(name, backwards, (3,))
    check_shape("up", up, (3,))
    z = normalize(backwards)
    x = jnp.cross(normalize(up), z)
    if is_concrete(x):
        if not np.any(np.asarray(backwards)):
            raise ValueError(f"{name} is zero; accepted is a direction of any length > 0")
        if float(jnp.sum(x * x)) < 1e-10:
            raise ValueError(
                f"up {np.asarray(up).tolist()} is zero or along the view axis; accepted is any other direction"
            )
    x = normalize(x)
    return jnp.stack([x, jnp.cross(z, x), z])


def _extreme(reduce, points, used):
    """Largest or smallest coordinates over the vertices in use."""
    fill = -jnp.inf if reduce is jnp.max else jnp.inf
    return reduce(jnp.where(used[:, None], points, fill), axis=0)
