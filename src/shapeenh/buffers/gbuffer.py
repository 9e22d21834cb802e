"""The G-buffer of a mesh: visibility, then everything that was asked for, resolved in one pass (SPEC 2, 11)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from shapeenh import checks
from shapeenh.buffers.inputs import check_table
from shapeenh.buffers.project import clip_matrix
from shapeenh.buffers.resolve import Finish, resolve
from shapeenh.buffers.visibility import rasterize
from shapeenh.buffers.weights import planes, total_sums
from shapeenh.types import Camera, GBuffer, Mesh

GRAZING = 0.01  # the least n_z


def render_gbuffer(
    mesh: Mesh,
    camera: Camera,
    *,
    height: int,
    width: int,
    cull: bool | str = False,
    albedo: bool = True,
    uv: bool = False,
) -> GBuffer:
    """What the camera sees of a mesh: `rasterize`, then mask, depth, normal, position and what else was asked for.

    Source: SPEC 1, 2, 11. `mesh.normals` are interpolated, turned into camera space and made unit again.

    - Two-sided: where the normals of a face look away from the viewer, compared with the side of the face that is
      seen, they are turned round. Scans with inconsistent orientation and open meshes are lit from both sides.
    - n_z > 0 everywhere (SPEC 1). Near an outline the interpolated normal can look past the view axis by a few
      degrees; its n_z is then held at 0.01, the bound that the descriptor uses as well, and the rest rescaled.

    mesh: V vertices with normals [V, 3], optional colors and uv. camera: any OpenGL projection.
    *Static*: height, width: pixels, 1 to 32768. cull: as in `rasterize`. albedo: whether to interpolate `mesh.colors`,
    where there are any. uv: whether to interpolate `mesh.uv`, which must be there.
    Returns a GBuffer; everything 0 off the mask.
    *Gradient*: exact with respect to vertices, normals, colors, uv and both camera matrices; the mask and the
    visibility are constants. A held n_z has no derivative.
    *Errors*: ValueError as in `rasterize`, and for normals, colors or uv of a wrong shape or not finite.
    """
    seen = rasterize(mesh, camera, height=height, width=width, cull=cull)
    check_table("mesh.normals", mesh.normals, mesh, 3)
    tables = {"normal": mesh.normals}
    if albedo and mesh.colors is not None:
        check_table("mesh.colors", mesh.colors, mesh, 3)
        tables["albedo"] = mesh.colors
    if uv:
        if mesh.uv is None:
            raise ValueError("uv is True, but mesh.uv is None; accepted are meshes with uv [V, 2]")
        check_table("mesh.uv", mesh.uv, mesh, 2)
        tables["uv"] = mesh.uv
    dtype = checks.float_dtype(mesh.vertices, mesh.normals, camera.view, camera.projection)
    vertices, view, projection = (jnp.asarray(a, dtype) for a in (mesh.vertices, camera.view, camera.projection))
    tables = {name: jnp.asarray(table, dtype) for name, table in tables.items()}
    mask = seen.triangle >= 0  # on its own, so that who only waits for the mask has it before the fields
    faces = jnp.asarray(mesh.faces, jnp.int32)
    return GBuffer(mask=mask, **resolve_gbuffer(vertices, faces, tables, view, projection, seen.triangle))


@jax.jit
def resolve_gbuffer(vertices, faces, tables, view, projection, triangle) -> dict:
    """The fields of `render_gbuffer` but the mask: its jitted body behind the visibility, of checked arrays."""
    names = sorted(tables, key=("normal", "albedo", "uv").index)
    channels = {"depth": 1, "position": 3, **{name: tables[name].shape[1] for name in names}}
    if faces.shape[0] == 0 or vertices.shape[0] == 0:
        made = [jnp.zeros((*triangle.shape, count), vertices.dtype) for count in channels.values()]
    else:
        m, _ = clip_matrix(view, projection)
        made = resolve(SURFACE, vertices, [tables[name] for name in names], view, m, faces, triangle)
    fields = dict(zip(channels, made, strict=True))
    return {**fields, "depth": fields["depth"][..., 0]}


# ------------------------------------------------------------------------------------------- what the fields are


def surface(stage, write, view, w, blended, rows):
    """Depth, camera-space position and normal, then the other attributes as they are (`resolve.Finish`)."""
    point, normal, *others = blended
    made = stage(turned, view, point, normal, stage(viewer_side, rows[0], rows[1], w))
    t = stage(lambda made: jnp.stack(scales(planes(made)[3:]), 1), made)
    return [
        write(lambda made: [-made[:, 2]], made),
        write(lambda made: planes(made)[:3], made),
        write(lambda made, t: scaled(planes(made)[3:], planes(t)), made, t),
        *(write(planes, other) for other in others),
    ]


def surface_reverse(stage, view, w, blended, rows, cotangents):
    point, normal, *_ = blended
    side = stage(viewer_side, rows[0], rows[1], w)
    made = stage(turned, view, point, normal, side)

    def before(made, depth, position, facing):
        x, y, z = planes(position)
        _, pull = jax.vjp(lambda *n: scaled(n, scales(n)), *planes(made)[3:])
        return jnp.stack([x, y, z - depth[:, 0], *pull(planes(facing))], 1)

    def turned_back(view, g, first):
        return jnp.stack([sum(view[k, c] * g[:, first + k] for k in range(3)) for c in range(3)], 1)

    def view_sums(g, point, normal, side):
        position, facing = planes(g)[:3], [t * side for t in planes(g)[3:]]
        turn = [position[k] * point[:, c] + facing[k] * normal[:, c] for k in range(3) for c in range(3)]
        sums = total_sums(turn + position)
        return jnp.pad(jnp.concatenate([sums[:9].reshape(3, 3), sums[9:, None]], 1), ((0, 1), (0, 0)))

    g = stage(before, made, *cotangents[:3])
    g_point = stage(lambda view, g: turned_back(view, g, 0), view, g)
    g_normal = stage(lambda view, g, side: turned_back(view, g, 3) * side[:, None], view, g, side)
    return stage(view_sums, g, point, normal, side), None, [g_point, g_normal, *cotangents[3:]]


def turned(view, point, normal, side):
    """Position and normal in camera space, the latter turned to the viewer, [runs, 6, LANES]."""
    position = [sum(view[k, c] * point[:, c] for c in range(3)) + view[k, 3] for k in range(3)]
    return jnp.stack(position + [sum(view[k, c] * normal[:, c] for c in range(3)) * side for k in range(3)], 1)


def viewer_side(position, normal, w):
    """-1 where the corner normals of a face look away from the side that is seen, else 1. One sign per face, so that
    nothing flips inside of one; 1/s is positive where the corners run counter-clockwise on screen."""
    u = [position[:, 1, k] - position[:, 0, k] for k in range(3)]
    v = [position[:, 2, k] - position[:, 0, k] for k in range(3)]
    n = [normal[:, 0, k] + normal[:, 1, k] + normal[:, 2, k] for k in range(3)]
    out = sum(n[k] * (u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3]) for k in range(3))
    return jnp.where((out * jnp.sign(w[:, 3])) < 0, -1, 1).astype(position.dtype)


def scales(n):
    """What x and y of the normal are to be multiplied with, and its z: unit, held at GRAZING, and unit again."""
    x, y, z = n
    first = inverse_length([x, y, z])
    z = jnp.maximum(z * first, GRAZING)
    second = inverse_length([x * first, y * first, z])
    return first * second, z * second


def scaled(n, scale):
    return [n[0] * scale[0], n[1] * scale[0], scale[1]]


def inverse_length(n):
    """1 / |n|; 0 with gradient 0 for the zero vector (rsqrt has the slope inf there, and inf * 0 is NaN in reverse)."""
    square = n[0] * n[0] + n[1] * n[1] + n[2] * n[2]
    there = square > jnp.finfo(square.dtype).tiny ** 0.5
    return jnp.where(there, lax.rsqrt(jnp.where(there, square, 1)), 0)


SURFACE = Finish(surface, surface_reverse)
