"""Normal maps on meshes, in tangent and in object space (SPEC 2).

Tangent space is that of MikkTSpace (Mikkelsen 2008), which the usual bakers use: tangents per vertex, angle-weighted,
orthogonal to the vertex normal, interpolated without being made unit again; the bitangent follows per pixel.
"""

from __future__ import annotations

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.buffers.inputs import check_table
from shapeenh.buffers.interpolate import interpolate
from shapeenh.buffers.normals import decoded, facing, turn_green, warn_of_convention
from shapeenh.buffers.textures import WRAP, bilinear, check_texture
from shapeenh.checks import check_choice, check_range, check_shape, check_type, float_dtype, is_concrete
from shapeenh.numerics import norm, normalize, safe_divide
from shapeenh.types import Camera, GBuffer, Mesh, Visibility, replace

SPACES = ("tangent", "object")


def apply_normal_map(
    gbuffer: GBuffer,
    mesh: Mesh,
    camera: Camera,
    visibility: Visibility,
    normal_map,
    *,
    space: str = "tangent",
    green: str = "up",
    wrap: str = "repeat",
    strength: float | jax.Array = 1.0,
    check: bool = True,
) -> GBuffer:
    """The G-buffer of a mesh with a normal map: other normals, all else as it was.

    In tangent space a texel (x, y, z) stands for x T + y B + z N: T points along growing u, B along growing v, N is
    the interpolated vertex normal. In object space it is the normal itself, in the frame of the mesh. Faces seen from
    behind get their normals turned round, as in `render_gbuffer`. Where there is no tangent (degenerate uv) and
    where a texel is zero or not finite, the normal stays as it was.

    Args:
        gbuffer, visibility: of this mesh and camera, from `render_gbuffer` and `rasterize`.
        mesh: with uv [V, 2].
        normal_map: [h, w, 3], row 0 at the top (v = 1): unit vectors as floats, or uint8 or uint16 as in
            `decode_normals`.
        space: "tangent" or "object".
        green: "up" (OpenGL) or "down" (DirectX). In object space "down" turns the y axis of the mesh.
        wrap: "repeat" or "clamp", as in `sample_texture`.
        strength: [], factor on x and y in tangent space, in [0, 100]; 0 = no map.
        check: warn where the map contradicts `green`.

    Static: space, green, wrap, check.
    Returns: a GBuffer with new normals, n_z >= 0.01, 0 off the mask; and with uv.
    Gradient: with respect to normal_map (floats), strength, mesh (vertices, normals, uv) and camera; the choice of the
        mirrored tangent and the side that is seen are constants.
    Errors: ValueError for a mesh without uv, shapes that disagree, and options that are not accepted.

    >>> seen = se.rasterize(mesh, camera, height=600, width=800)
    >>> gbuffer = se.render_gbuffer(mesh, camera, height=600, width=800, uv=True)
    >>> gbuffer = se.apply_normal_map(gbuffer, mesh, camera, seen, se.load_image("bricks.png"), green="down")
    """
    for name, value, kind in (
        ("gbuffer", gbuffer, GBuffer),
        ("mesh", mesh, Mesh),
        ("camera", camera, Camera),
        ("visibility", visibility, Visibility),
    ):
        check_type(name, value, kind)
    check_choice("space", space, SPACES)
    check_choice("wrap", wrap, WRAP)
    check_range("strength", strength, 0, 100)
    if mesh.uv is None:
        raise ValueError("mesh.uv is None; accepted are meshes with texture coordinates [V, 2]")
    check_table("mesh.uv", mesh.uv, mesh, 2)
    check_table("mesh.normals", mesh.normals, mesh, 3)
    check_shape("visibility.triangle", visibility.triangle, tuple(gbuffer.mask.shape))
    texels = normal_map if isinstance(normal_map, jax.Array) else np.asarray(normal_map)
    if texels.dtype.kind == "u":
        texels = decoded(texels, green, stacklevel=3)
    else:
        check_texture("normal_map", texels)
        check_shape("normal_map", texels, (None, None, 3))
        texels = turn_green(jnp.asarray(texels, float_dtype(texels)), green)

    dtype = gbuffer.normal.dtype
    vertices, normals, uv = (jnp.asarray(a, dtype) for a in (mesh.vertices, mesh.normals, mesh.uv))
    tables = [normals, uv]
    if space == "tangent":
        tangents, mirrored = vertex_tangents(vertices, jnp.asarray(mesh.faces, jnp.int32), normals, uv)
        tables += [tangents]
    else:
        mirrored = jnp.zeros(mesh.faces.shape[0], bool)
    at = interpolate(jnp.concatenate(tables, axis=1), mesh, camera, visibility)
    texels = texels.astype(dtype)
    strength, view = jnp.asarray(strength, dtype), jnp.asarray(camera.view, dtype)
    result, agreement = _mapped(
        gbuffer, at, mirrored, visibility.triangle, texels, strength, view, space=space, wrap=wrap
    )
    if check and space == "tangent":
        warn_of_convention(texels, jnp.ones(texels.shape[:2], bool), green, "normal_map", stacklevel=3)
    elif check and is_concrete(agreement):
        _warn_of_object_space(np.asarray(agreement), green)
    return result


@jax.jit
def vertex_tangents(vertices, faces, normals, uv):
    """(tangents [V, 6], mirrored [F] bool): per vertex the unit tangent of its faces whose uv run counter-clockwise,
    then that of its mirrored faces; 0 where it has none.

    The two kinds are kept apart because their tangents point opposite ways along a seam of mirrored halves.
    Gradient: with respect to vertices, normals, uv; 0 through faces without area in space or in the texture.
    """
    corner, st = vertices[faces], uv[faces]
    e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    d1, d2 = st[:, 1] - st[:, 0], st[:, 2] - st[:, 0]
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    sign = jax.lax.stop_gradient(jnp.sign(area))
    along = (d2[:, 1:] * e1 - d1[:, 1:] * e2) * sign[:, None]  # dP/du, up to its length

    n = normals[faces]
    flat = lambda v: v - jnp.sum(v * n, axis=-1, keepdims=True) * n  # noqa: E731, in the plane of the corner's normal
    tangent = normalize(flat(jnp.broadcast_to(along[:, None], corner.shape)))
    ahead = normalize(flat(jnp.roll(corner, -1, axis=1) - corner))
    behind = normalize(flat(jnp.roll(corner, 1, axis=1) - corner))
    cosine, sine = jnp.sum(ahead * behind, axis=-1), norm(jnp.cross(ahead, behind))
    flat_corner = (sine == 0) & (cosine == 0)
    angle = jnp.where(flat_corner, 0, jnp.arctan2(sine, jnp.where(flat_corner, 1, cosine)))

    mirrored = sign < 0
    total = jnp.zeros((2 * vertices.shape[0], 3), vertices.dtype)
    at = (2 * faces + mirrored[:, None]).reshape(-1)
    total = total.at[at].add((angle[..., None] * tangent).reshape(-1, 3))
    return normalize(total).reshape(-1, 6), mirrored


@partial(jax.jit, static_argnames=("space", "wrap"))
def _mapped(gbuffer, at, mirrored, triangle, texels, strength, view, *, space, wrap):
    """(the G-buffer with other normals, mean n . n' as it is and with y turned)."""
    mask = gbuffer.mask
    rotation = view[:3, :3]
    normal, uv = at[..., :3], at[..., 3:5]
    good = jnp.all(jnp.isfinite(texels), axis=-1, keepdims=True)
    empty = jnp.asarray([0, 0, 1 if space == "tangent" else 0], texels.dtype)[None, None]
    texels = jnp.where(good & jnp.any(texels != 0, axis=-1, keepdims=True), texels, empty)
    m = bilinear(texels, uv, wrap=wrap)
    agreement = jnp.zeros(2, m.dtype)
    if space == "object":
        out = m
        there = norm(m) > 0
        turned = jnp.sum(normal * m * jnp.asarray([1, -1, 1], m.dtype)[None, None], axis=-1)
        both = jnp.stack([jnp.sum(normal * m, axis=-1), turned], axis=-1)
        agreement = safe_divide(jnp.sum(both * mask[..., None], axis=(0, 1)), jnp.sum(mask).astype(m.dtype))
    else:
        other = (mirrored.at[jnp.maximum(triangle, 0)].get(mode="fill", fill_value=False) & mask)[..., None]
        tangent = jnp.where(other, at[..., 8:11], at[..., 5:8])
        bitangent = jnp.where(other, -1, 1) * jnp.cross(normal, tangent)
        out = strength * (m[..., :1] * tangent + m[..., 1:2] * bitangent) + m[..., 2:] * normal
        there = norm(tangent) > 0
    # The plain normal, possibly turned to the side that is seen: the mapped one turns with it.
    plain = jnp.einsum("hwc,kc->hwk", normal, rotation, precision=jax.lax.Precision.HIGHEST)
    mapped = jnp.einsum("hwc,kc->hwk", out, rotation, precision=jax.lax.Precision.HIGHEST)
    side = jnp.where(jnp.sum(plain * gbuffer.normal, axis=-1, keepdims=True) < 0, -1, 1)
    there = (there & mask & (norm(mapped) > 0))[..., None]
    mapped = facing(jnp.where(there, mapped * side, jnp.asarray([0, 0, 1], m.dtype)))
    new = jnp.where(there, mapped, gbuffer.normal)
    return replace(gbuffer, normal=new, uv=jnp.where(mask[..., None], uv, 0)), agreement


def _warn_of_object_space(agreement, green: str) -> None:
    """An object-space map varies about the normals of the mesh: the better of both readings is the right one."""
    if agreement[1] > agreement[0] + 0.05:
        other = "down" if green == "up" else "up"
        warnings.warn(
            f"normal_map agrees less with the mesh's normals (mean cosine {agreement[0]:.2f}) with green {green} than "
            f"with green {other} ({agreement[1]:.2f}); try green={other!r}",
            stacklevel=3,
        )
