"""Meshes: making them from arrays, and vertex normals.

Normals are angle-weighted (Thürmer and Wüthrich 1998): they do not depend on how a flat face is cut into triangles.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.checks import check_finite, check_shape, float_dtype, is_concrete
from shapeenh.fusion import stored, unknown_truth
from shapeenh.numerics import norm, normalize, safe_divide, safe_sqrt
from shapeenh.types import Mesh


def make_mesh(vertices, faces, *, normals=None, colors=None, uv=None) -> Mesh:
    """A checked `Mesh` from arrays; vertex normals are made where none are given.

    Args:
        vertices: [V, 3], world units.
        faces: [F, 3] integers in [0, V), counter-clockwise from outside.
        normals: [V, 3], any length > 0, or None for angle-weighted ones.
        colors: [V, 3], linear RGB in [0, 1], or None.
        uv: [V, 2], or None.

    Gradient: with respect to vertices (through the normals too), normals, colors, uv.
    Errors: ValueError for wrong shapes, NaN or infinite vertices, indices out of range.

    >>> mesh = se.make_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    """
    dtype = float_dtype(vertices, normals)
    check_shape("vertices", vertices, (None, 3))
    check_shape("faces", faces, (None, 3))
    count = np.shape(vertices)[0]
    for name, value, width in (("normals", normals, 3), ("colors", colors, 3), ("uv", uv, 2)):
        if value is not None:
            check_shape(name, value, (count, width))
    check_finite("vertices", vertices)
    check_faces(faces, count)
    vertices, faces = jnp.asarray(vertices, dtype), jnp.asarray(faces, jnp.int32)
    cast = lambda a: None if a is None else jnp.asarray(a, dtype)  # noqa: E731
    n = vertex_normals(vertices, faces) if normals is None else normalize(jnp.asarray(normals, dtype))
    return Mesh(vertices, faces, n, cast(colors), cast(uv))


def check_faces(faces, vertex_count: int) -> None:
    """Integer indices in [0, V) (looked at where concrete)."""
    if not is_concrete(faces):
        return
    f = np.asarray(faces)
    if f.size == 0:
        return
    if not np.issubdtype(f.dtype, np.integer):
        raise ValueError(f"faces has dtype {f.dtype}; accepted are integers")
    if f.min() < 0 or f.max() >= vertex_count:
        raise ValueError(f"faces holds indices from {f.min()} to {f.max()}; accepted are 0 to {vertex_count - 1}")


def vertex_normals(vertices, faces) -> jax.Array:
    """Angle-weighted unit normals `[V, 3]`; (0, 0, 1) for a vertex that no proper face uses.

    Args:
        vertices: [V, 3].
        faces: [F, 3] int32, counter-clockwise from outside.

    Gradient: with respect to vertices; 0 through faces without area.
    """
    check_shape("vertices", vertices, (None, 3))
    check_shape("faces", faces, (None, 3))
    return _vertex_normals(jnp.asarray(vertices, float_dtype(vertices)), jnp.asarray(faces, jnp.int32))


@jax.custom_jvp
def _angle_weighted(vertices, faces):
    """Sums of the unit normals of the faces at each vertex, times their angles there, [V, 3].

    In planes, each stored once: left alone, XLA computes the angles again for every component of every sum.
    """
    always = unknown_truth(vertices, faces)

    def corners(vertices, faces):
        at = (faces.T * 3)[:, None] + np.arange(3, dtype=np.int32)[None, :, None]
        return vertices.reshape(-1)[at]

    corner = stored(always, corners, vertices, faces)
    angle, unit = stored(always, lambda c: [jnp.stack(t) for t in _angles(c)], corner)
    rows = stored(always, lambda a, n: jnp.moveaxis(a[:, None] * n[None], 1, 2), angle, unit)
    return jnp.zeros_like(vertices).at[faces.T.reshape(-1)].add(rows.reshape(-1, 3))


@_angle_weighted.defjvp
def _angle_weighted_jvp(primals, tangents):
    vertices, faces = primals

    def plain(vertices):  # borders would keep what is cheaper to compute again
        rows = [vertices[faces[:, k]] for k in range(3)]
        angle, unit = _angles([[row[:, c] for c in range(3)] for row in rows])
        total = jnp.zeros_like(vertices)
        for k in range(3):
            total = total.at[faces[:, k]].add(jnp.stack([angle[k] * n for n in unit], -1))
        return total

    return _angle_weighted(vertices, faces), jax.jvp(plain, (vertices,), (tangents[0],))[1]


def _angles(corner):
    """The angles at three corners (three planes each), and the planes of the unit normal; 0 without area."""
    edge = [[corner[(k + 1) % 3][c] - corner[k][c] for c in range(3)] for k in range(3)]
    angle = []
    for k in range(3):
        back = [-edge[k - 1][c] for c in range(3)]
        sine = _length(_cross(edge[k], back))
        cosine = sum(edge[k][c] * back[c] for c in range(3))
        degenerate = (sine == 0) & (cosine == 0)
        angle.append(jnp.where(degenerate, 0, jnp.arctan2(sine, jnp.where(degenerate, 1, cosine))))
    normal = _cross(edge[0], edge[1])
    length = _length(normal)
    return angle, [safe_divide(n, length) for n in normal]


def _length(v):
    """`norm` of three planes, without stacking them."""
    big = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(v[0]), jnp.abs(v[1])), jnp.abs(v[2])))
    big = jnp.where(big > 0, big, 1)
    return safe_sqrt(sum((t / big) ** 2 for t in v)) * big


def _cross(u, v):
    return [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]


@jax.jit
def _vertex_normals(vertices, faces):
    axis = jnp.zeros_like(vertices).at[:, 2].set(1)
    if faces.shape[0] == 0 or vertices.shape[0] == 0:
        return axis
    total = _angle_weighted(vertices, faces)
    length = norm(total, keepdims=True)
    return jnp.where(length > 0, safe_divide(total, length), axis)
