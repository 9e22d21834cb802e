"""What the buffer stages check before anything is traced."""

from __future__ import annotations

import weakref

import jax
import numpy as np

from shapeenh import checks
from shapeenh.types import Camera, Mesh

# A jax.Array never changes, so what was found good stays good: looking through the arrays of a large mesh again at
# every frame would take as long as drawing it. NumPy arrays can change and are looked through every time.
_good: dict[tuple[int, str], weakref.ref] = {}


def _once(array, what: str, check) -> None:
    if not isinstance(array, jax.Array):
        check()
        return
    key = (id(array), what)
    known = _good.get(key)
    if known is not None and known() is array:
        return
    check()
    _good[key] = weakref.ref(array, lambda _: _good.pop(key, None))


def check_mesh(mesh: Mesh) -> None:
    """Shapes, finite vertices, face indices in range."""
    checks.check_shape("mesh.vertices", mesh.vertices, (None, 3))
    checks.check_shape("mesh.faces", mesh.faces, (None, 3))
    if not np.issubdtype(mesh.faces.dtype, np.integer):
        raise ValueError(f"mesh.faces has dtype {mesh.faces.dtype}; accepted are integers")
    if checks.is_concrete(mesh.vertices):
        _once(mesh.vertices, "finite", lambda: _check_vertices(np.asarray(mesh.vertices)))
    if checks.is_concrete(mesh.faces):
        count = mesh.vertices.shape[0]
        _once(mesh.faces, f"indices below {count}", lambda: _check_faces(np.asarray(mesh.faces), count))


def _check_vertices(vertices: np.ndarray) -> None:
    bad = int(vertices.shape[0] - np.count_nonzero(np.isfinite(vertices).all(axis=1)))
    if bad:
        raise ValueError(
            f"mesh.vertices holds {bad} NaN or infinite vertices of {len(vertices)}; accepted are finite ones"
        )


def _check_faces(faces: np.ndarray, count: int) -> None:
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        bad = int(np.count_nonzero(((faces < 0) | (faces >= count)).any(axis=1)))
        raise ValueError(f"mesh.faces has {bad} face(s) with an index out of range; accepted are 0 to {count - 1}")


def check_camera(camera: Camera) -> None:
    """Shapes and finite matrices."""
    checks.check_shape("camera.view", camera.view, (4, 4))
    checks.check_shape("camera.projection", camera.projection, (4, 4))
    checks.check_finite("camera.view", camera.view)
    checks.check_finite("camera.projection", camera.projection)


def check_table(name: str, table, mesh: Mesh, channels: int | None) -> None:
    """An attribute with one finite row per vertex."""
    checks.check_shape(name, table, (mesh.vertices.shape[0], channels))
    if checks.is_concrete(table):
        _once(table, "finite values", lambda: checks.check_finite(name, table))
