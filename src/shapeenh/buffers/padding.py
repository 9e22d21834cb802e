"""Meshes of varying size on a ladder of few sizes, so that few programs are ever compiled."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from shapeenh import checks
from shapeenh.types import Mesh, replace

STEPS = 4  # sizes per doubling: at most a quarter is spare
LEAST = 256


def rung(count: int) -> int:
    """The least size on the ladder that holds `count`: 256, then four steps per doubling."""
    size = LEAST
    while size < count:
        base = 1 << (size.bit_length() - 1)
        size += base // STEPS
    return size


def pad_mesh(mesh: Mesh, *, vertices: int | None = None, faces: int | None = None) -> Mesh:
    """The same mesh with spare vertices and faces, for callers whose meshes vary in size.

    Every function of a mesh compiles once per number of vertices and faces. On the ladder (256, then four sizes per
    doubling) meshes of nearly the same size share what is compiled, for at most a quarter of spare room. The spare
    faces have no area and are never seen; the others keep their indices.

    Args:
        mesh: any mesh with at least one vertex; without one it is returned as it is.
        vertices, faces: sizes to pad to, at least those of the mesh; by default the next ones on the ladder.

    Returns: a `Mesh` with `vertices` vertices and `faces` faces; spare rows repeat the last vertex.
    Static: vertices, faces.
    Gradient: through every row; nothing that is seen depends on the spare ones.
    Errors: ValueError for sizes smaller than the mesh's.

    >>> se.rasterize(se.pad_mesh(mesh), camera, height=600, width=800)
    """
    checks.check_type("mesh", mesh, Mesh)
    count, triangles = mesh.vertices.shape[0], mesh.faces.shape[0]
    wide = rung(count) if vertices is None else checks.check_size("vertices", vertices, low=count, high=2**31 - 1)
    many = rung(triangles) if faces is None else checks.check_size("faces", faces, low=triangles, high=2**31 - 1)
    if count == 0:
        return mesh
    tables = {name: getattr(mesh, name) for name in ("vertices", "normals", "colors", "uv")}
    spare: dict[str, jax.Array] = {
        name: jnp.pad(jnp.asarray(table), ((0, wide - count), (0, 0)), mode="edge")
        for name, table in tables.items()
        if table is not None
    }
    spare["faces"] = jnp.pad(jnp.asarray(mesh.faces, jnp.int32), ((0, many - triangles), (0, 0)))
    return replace(mesh, **spare)
