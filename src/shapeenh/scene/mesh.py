"""Meshes: making them from arrays, and vertex normals.

Normals are angle-weighted (Thürmer and Wüthrich 1998): they do not depend on how a flat face is cut into triangles.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.checks import check_finite, check_shape, float_dtype, is_concrete
from shapeenh.numerics import norm, normalize, safe_divide
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


@jax.jit
def _vertex_normals(vertices, faces):
    corner = vertices[faces]
    edge = jnp.roll(corner, -1, axis=1) - corner  # from corner k to corner k + 1
    face = normalize(jnp.cross(edge[:, 0], edge[:, 1]))
    back = -jnp.roll(edge, 1, axis=1)  # from corner k to corner k - 1
    sine = norm(jnp.cross(edge, back))
    cosine = jnp.sum(edge * back, axis=-1)
    degenerate = (sine == 0) & (cosine == 0)
    angle = jnp.where(degenerate, 0, jnp.arctan2(sine, jnp.where(degenerate, 1, cosine)))
    total = jnp.zeros_like(vertices).at[faces.reshape(-1)].add((angle[..., None] * face[:, None]).reshape(-1, 3))
    length = norm(total, keepdims=True)
    axis = jnp.zeros_like(vertices).at[:, 2].set(1)
    return jnp.where(length > 0, safe_divide(total, length), axis)
