"""Procedural meshes: the embedded default object and the simple solids that tests and examples use."""

from __future__ import annotations

import numpy as np

from shapeenh.checks import check_range, check_size
from shapeenh.scene.mesh import make_mesh
from shapeenh.types import Mesh

TWIST = 6  # turns of the rope over the length of the knot; the mesh is twisted along, so that edges follow the strands


def carved_knot(*, detail: int = 2) -> Mesh:
    """The embedded default object: a trefoil knot of carved rope, with bumps, hollows, creases, at several scales.

    Along the knot three ways of carving blend into one another: twisted strands of fine fibres (sharp valleys between
    round ridges), rows of knobs, and a smooth band with engraved rings and dimples.

    Args:
        detail: 2 gives 368,640 triangles; every step up or down four times as many or few.

    Static: detail, 1 to 4.
    """
    detail = check_size("detail", detail, low=1, high=4)
    along, around = 640 << (detail - 1), 72 << (detail - 1)
    u = 2 * np.pi * np.arange(along) / along
    uu, vv = np.meshgrid(u, 2 * np.pi * np.arange(around) / around, indexing="ij")
    vv = vv - TWIST * uu
    centre, normal, binormal = _trefoil_frame(u)
    ring = normal[:, None] * np.cos(vv)[..., None] + binormal[:, None] * np.sin(vv)[..., None]
    vertices = (centre[:, None] + _carving(uu, vv)[..., None] * ring).reshape(-1, 3)
    return make_mesh(vertices, _torus_faces(along, around))


def _trefoil_frame(u):
    """Centre line and a frame across it that closes without a jump: normals start from the knot's axis."""
    curve = lambda t: np.stack(  # noqa: E731
        [(2 + np.cos(3 * t)) * np.cos(2 * t), (2 + np.cos(3 * t)) * np.sin(2 * t), 1.15 * np.sin(3 * t)], axis=-1
    )
    h = 1e-5
    tangent = (curve(u + h) - curve(u - h)) / (2 * h)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    # The outward direction of the torus that carries the knot is periodic and never along the tangent.
    core = np.stack([np.cos(2 * u), np.sin(2 * u), np.zeros_like(u)], axis=-1) * 2
    outward = curve(u) - core
    normal = outward - np.sum(outward * tangent, axis=-1, keepdims=True) * tangent
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return curve(u), normal, np.cross(tangent, normal)


def _carving(u, v):
    """Tube radius over (along, around): three reliefs with smooth transitions."""
    near = np.stack([(0.5 + 0.5 * np.cos(u - k * 2 * np.pi / 3)) ** 4 for k in range(3)])
    rope, knobs, band = near / near.sum(axis=0)
    strands = 0.15 * np.abs(np.cos(2.5 * (v + TWIST * u))) - 0.09 + 0.008 * np.cos(15 * v + 150 * u)
    bumps = 0.14 * (0.5 + 0.5 * np.cos(4 * v + 36 * u) * np.cos(4 * v - 36 * u)) ** 1.5 - 0.05
    rings = -0.05 * np.exp(-((np.sin(13.5 * u) / 0.12) ** 2))
    dimples = -0.09 * np.exp(-(np.sin(2 * v) ** 2 + 0.8 * np.cos(13.5 * u) ** 2) / 0.16)
    return 0.55 + rope * strands + knobs * bumps + band * (rings + dimples + 0.03 * np.cos(3 * v + 9 * u))


def _torus_faces(along: int, around: int):
    """Two triangles per cell of a doubly periodic grid, outward-facing for a right-handed (along, around) frame."""
    i, j = np.meshgrid(np.arange(along), np.arange(around), indexing="ij")
    index = lambda a, b: (a % along) * around + b % around  # noqa: E731
    a, b, c, d = index(i, j), index(i + 1, j), index(i + 1, j + 1), index(i, j + 1)
    return np.stack([np.stack([a, d, c], -1), np.stack([a, c, b], -1)], axis=2).reshape(-1, 3).astype(np.int32)


def sphere(*, radius: float = 1.0, rings: int = 64) -> Mesh:
    """A latitude-longitude sphere about the origin with exact normals; `rings` bands of `2 rings` quads.

    Static: rings, 2 to 4096.
    """
    check_range("radius", radius, 0, np.inf, open_ends=True)
    rings = check_size("rings", rings, low=2, high=4096)
    theta = np.pi * np.arange(1, rings) / rings
    phi = np.pi * np.arange(2 * rings) / rings
    t, p = np.meshgrid(theta, phi, indexing="ij")
    band = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], axis=-1).reshape(-1, 3)
    n = np.concatenate([band, [[0, 1, 0], [0, -1, 0]]])
    north, south = len(band), len(band) + 1

    i, j = np.meshgrid(np.arange(rings - 2), np.arange(2 * rings), indexing="ij")
    index = lambda a, b: a * 2 * rings + b % (2 * rings)  # noqa: E731
    a, b, c, d = index(i, j), index(i + 1, j), index(i + 1, j + 1), index(i, j + 1)
    quads = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    first, last = np.arange(2 * rings), index(rings - 2, np.arange(2 * rings))
    caps = [
        np.stack([np.full(2 * rings, north), first, np.roll(first, -1)], -1),
        np.stack([np.full(2 * rings, south), np.roll(last, -1), last], -1),
    ]
    faces = np.concatenate([quads, *caps]).astype(np.int32)
    return make_mesh(radius * n, faces, normals=n)


def torus(*, major: float = 1.0, minor: float = 0.4, segments: int = 96) -> Mesh:
    """A torus about the y axis with exact normals, `2 segments` by `segments` quads.

    Static: segments, 3 to 4096.
    """
    check_range("major", major, 0, np.inf, open_ends=True)
    check_range("minor", minor, 0, np.inf, open_ends=True)
    segments = check_size("segments", segments, low=3, high=4096)
    u = np.pi * np.arange(2 * segments) / segments
    v = 2 * np.pi * np.arange(segments) / segments
    uu, vv = np.meshgrid(u, v, indexing="ij")
    n = np.stack([np.cos(vv) * np.sin(uu), np.sin(vv), np.cos(vv) * np.cos(uu)], axis=-1)
    centre = np.stack([np.sin(uu), np.zeros_like(uu), np.cos(uu)], axis=-1)
    vertices = (major * centre + minor * n).reshape(-1, 3)
    faces = _torus_faces(2 * segments, segments)[:, ::-1]
    return make_mesh(vertices, faces, normals=n.reshape(-1, 3))


def plane(*, size: float = 2.0, segments: int = 1) -> Mesh:
    """A square in the xy plane about the origin that faces +z, with uv from (0, 0) at its lower left corner.

    Static: segments, 1 to 4096.
    """
    check_range("size", size, 0, np.inf, open_ends=True)
    segments = check_size("segments", segments, high=4096)
    t = np.linspace(0, 1, segments + 1)
    x, y = np.meshgrid(t, t, indexing="xy")
    uv = np.stack([x, y], axis=-1).reshape(-1, 2)
    vertices = np.concatenate([size * (uv - 0.5), np.zeros((len(uv), 1))], axis=1)
    i, j = np.meshgrid(np.arange(segments), np.arange(segments), indexing="ij")
    a = i * (segments + 1) + j
    b, c, d = a + 1, a + segments + 2, a + segments + 1
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, 1.0], (len(uv), 1))
    return make_mesh(vertices, faces.astype(np.int32), normals=normals, uv=uv)
