"""Object-centred curvature of meshes (Rusinkiewicz 2004, TH10 4.1, SPEC 4)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from shapeenh.checks import check_type
from shapeenh.numerics import norm, normalize, safe_divide
from shapeenh.types import Mesh


def vertex_curvature(mesh) -> jax.Array:
    """The curvature tensor at every vertex, by finite differences of normals per face (Rusinkiewicz 2004, SPEC 4).

    mesh: Mesh, its normals unit.
    Returns [V, 6], (xx, xy, xz, yy, yz, zz) of a symmetric 3x3 tensor in world space, 1/world unit, that maps the
    normal to 0: its other eigenvalues are the principal curvatures, negative on convexities, its eigenvectors their
    directions. It needs no tangent frame, so it can be interpolated. Degenerate faces count for nothing; 0 at vertices
    without faces.
    Gradient: with respect to vertices and normals.
    Errors: ValueError for what is not a Mesh.

        tensor = interpolate(vertex_curvature(mesh), mesh, camera, visibility)
        descriptor = describe_object(gbuffer, tensor, camera)
    """
    check_type("mesh", mesh, Mesh)
    return _vertex_curvature(mesh.vertices, mesh.normals, mesh.faces)


@jax.jit
def _vertex_curvature(vertices, normals, faces):
    corner, normal = vertices[faces], normals[faces]  # [F, 3, 3]: face, corner, xyz
    edge = jnp.roll(corner, -1, 1) - corner
    turn = jnp.roll(normal, -1, 1) - normal
    cross = jnp.cross(edge[:, 0], edge[:, 1])
    area = 0.5 * norm(cross)

    # the tensor (a, b, c) of each face in a frame of its plane: [p q 0; 0 p q] (a, b, c) = (dn.u, dn.v) for three edges
    size = jnp.max(norm(edge), axis=1)
    flat = normalize(cross)
    u = normalize(edge[:, 0])
    v = jnp.cross(flat, u)
    scaled = safe_divide(edge, size[:, None, None])
    along = lambda vectors, axis: jnp.sum(vectors * axis[:, None], axis=-1)  # noqa: E731
    p, q, r, s = along(scaled, u), along(scaled, v), along(turn, u), along(turn, v)
    total = lambda x: jnp.sum(x, axis=1)  # noqa: E731
    pp, pq, qq = total(p * p), total(p * q), total(q * q)
    r1, r2, r3 = total(p * r), total(q * r + p * s), total(q * s)
    det = (pp + qq) * (pp * qq - pq * pq) * size
    det = jnp.where(pp * qq - pq * pq > 1e-12, det, 0)  # slivers say nothing
    a = safe_divide(((pp + qq) * qq - pq * pq) * r1 - pq * qq * r2 + pq * pq * r3, det)
    b = safe_divide(-pq * qq * r1 + pp * qq * r2 - pp * pq * r3, det)
    c = safe_divide(pq * pq * r1 - pp * pq * r2 + (pp * (pp + qq) - pq * pq) * r3, det)

    # turned into each corner's tangent plane, by the smallest rotation, and averaged by area
    both = flat[:, None] + normal
    bend = 1 + jnp.sum(flat[:, None] * normal, axis=-1, keepdims=True)

    def turned(t):
        return t[:, None] - jnp.sum(t[:, None] * normal, axis=-1, keepdims=True) * safe_divide(both, bend)

    u, v = turned(u), turned(v)

    def component(i, j):
        a_, b_, c_ = a[:, None], b[:, None], c[:, None]
        return (
            a_ * u[..., i] * u[..., j]
            + b_ * (u[..., i] * v[..., j] + v[..., i] * u[..., j])
            + c_ * v[..., i] * v[..., j]
        )

    tensor = jnp.stack([component(i, j) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], axis=-1)
    weight = jnp.where((det > 0)[:, None] & (bend[..., 0] > 1e-6), area[:, None], 0)
    count = vertices.shape[0]
    index = faces.reshape(-1)
    summed = jax.ops.segment_sum((weight[..., None] * tensor).reshape(-1, 6), index, count)
    weights = jax.ops.segment_sum(weight.reshape(-1), index, count)
    return -safe_divide(summed, weights[:, None])
