"""Smooth outlines at the cost of one shading per pixel: subpixel reconstruction antialiasing.

Chajdas, McGuire and Luebke 2011 (I3D): visibility is cheap, shading is dear, so visibility is sampled S x S times per
pixel and every sample borrows the shading of the pixel, among the 3 x 3 around it, that shows the same surface.
Where the centres of all 3 x 3 pixels show one surface, or all of them nothing, that is what the samples see as well.
The other pixels, the *mixed* ones, are few: only they are listed, and only faces near them are drawn again.

When are a sample and a pixel on the same surface? When each lies in the other's tangent plane and their normals agree:
the distance from a plane is measured in pixels' footprints at that depth, the difference of normals as the length of
their difference. Both count as equal below the first, as different above the second number of PLANE and NORMAL, and
in between the smaller one wins.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks
from shapeenh.buffers.gbuffer import surface
from shapeenh.buffers.inputs import check_camera, check_mesh, check_table
from shapeenh.buffers.project import clip_matrix
from shapeenh.buffers.resolve import blend
from shapeenh.buffers.runs import listed, table_rows
from shapeenh.buffers.visibility import CULL, check_cull, visible_triangles
from shapeenh.buffers.weights import edge_products, weights
from shapeenh.buffers.xla import take
from shapeenh.fusion import stored, unknown_truth
from shapeenh.types import Camera, Coverage, GBuffer, Mesh

PLANE = (0.5, 2.0)  # pixels' footprints
NORMAL = (0.25, 1.0)  # lengths of a difference of unit vectors: 14 and 60 degrees
OWN = 4  # the pixel itself in its 3 x 3 neighbourhood, which is counted in reading order
ORDER = (4, 1, 3, 5, 7, 0, 2, 6, 8)  # from near to far, so that the nearer of two equally good ones is taken
NEARER = 1e-3  # weight of a squared distance on screen: decides between pixels of the same surface
CHUNK = 1024  # mixed pixels per step
CELL = 4  # pixels: faces are drawn for the samples where a cell of this side holds a mixed pixel

# ------------------------------------------------------------------------------------------- from samples to pixels


def sample_coverage(
    mesh: Mesh, camera: Camera, gbuffer: GBuffer, *, samples: int, cull: bool | str = False
) -> Coverage:
    """Whose shading each of S x S samples per pixel borrows: own pixel, one of its 8 neighbours, or none.

    Source: Chajdas, McGuire and Luebke 2011 (subpixel reconstruction antialiasing). A sample takes the nearest of the
    3 x 3 pixels that show its surface; where none does (a wire that no pixel centre meets) the best of those that show
    anything, its own for choice. What none of the nine pixels shows is not there: a wire or a hole thinner than a pixel
    is broken where it passes between the centres, as it is without samples.

    mesh, camera: what `gbuffer` was made from; the size is the G-buffer's.
    *Static*: samples: per pixel and axis, 1 to 8; 1 tells the mask. cull: as in `rasterize`.
    Returns a `Coverage` for `resolve_coverage`. Faces near outlines and creases are drawn at S times the resolution,
    which takes 12 bytes per sample for the while; all else costs by the number of mixed pixels.
    *Gradient*: none; coverage is a constant of the derivative, as visibility is.
    *Errors*: ValueError as in `rasterize` and `render_gbuffer`, and where S times the size exceeds 32768.

    >>> coverage = se.sample_coverage(mesh, camera, gbuffer, samples=2)
    >>> image = se.resolve_coverage(se.tone_map(se.shade(gbuffer, lights, material)), coverage)
    """
    checks.check_type("gbuffer", gbuffer, GBuffer)
    samples = checks.check_size("samples", samples, high=8)
    height, width = gbuffer.mask.shape
    if samples == 1:
        mask = jnp.asarray(gbuffer.mask)
        return Coverage(source=jnp.where(mask, OWN, -1)[..., None].astype(jnp.int8), fraction=mask.astype(jnp.float32))
    if max(height, width) * samples > 1 << 15:
        raise ValueError(f"samples is {samples} for {height} x {width} pixels; accepted are at most 32768 per axis")
    check_cull(cull)
    check_mesh(mesh)
    check_camera(camera)
    check_table("mesh.normals", mesh.normals, mesh, 3)
    dtype = checks.float_dtype(mesh.vertices, mesh.normals, camera.view, camera.projection)
    given = (mesh.vertices, mesh.normals, camera.view, camera.projection, gbuffer.position, gbuffer.normal)
    arrays = [lax.stop_gradient(jnp.asarray(a, dtype)) for a in given]
    source, fraction = sources(*arrays, jnp.asarray(mesh.faces, jnp.int32), gbuffer.mask, samples, CULL[cull])
    return Coverage(source=source, fraction=fraction)


@functools.partial(jax.jit, static_argnums=(8, 9))
def sources(vertices, normals, view, projection, position, normal, faces, mask, samples, cull):
    """The jitted body of `sample_coverage`, of checked arrays."""
    height, width = mask.shape
    if faces.shape[0] == 0 or vertices.shape[0] == 0:
        nothing = jnp.full((height, width, samples * samples), -1, jnp.int8)
        return nothing, jnp.zeros((height, width), jnp.float32)

    @jax.custom_batching.sequential_vmap
    def one_view(vertices, normals, view, projection, position, normal, faces, mask):
        always = unknown_truth(vertices, view, faces, mask)
        mixed = torn(always, position, normal, mask, pixel_size(projection, height, width))
        fine = {"height": height * samples, "width": width * samples, "side": CELL * samples}
        triangle = visible_triangles(vertices, faces, view, projection, wanted_cells(mixed), cull=cull, **fine)
        m, _ = clip_matrix(view, projection)
        return borrowed(always, vertices, normals, view, projection, m, position, normal, faces, mask, triangle, mixed)

    return one_view(vertices, normals, view, projection, position, normal, faces, mask)


def pixel_size(projection, height, width):
    """Footprint of a pixel per unit of clip w, and the (z, 1) coefficients of w in camera space."""
    size = 2 / jnp.minimum(height * jnp.abs(projection[1, 1]), width * jnp.abs(projection[0, 0]))
    return size, projection[3, 2], projection[3, 3]


def footprint(z, pixel):
    """World units per pixel at camera-space z."""
    size, along, constant = pixel
    return size * jnp.maximum(along * z + constant, jnp.finfo(z.dtype).tiny)


def ramp(x, ends):
    """0 below, 1 above, linear between."""
    return jnp.clip((x - ends[0]) * (1 / (ends[1] - ends[0])), 0, 1)


def plane_distance(p, q, n):
    """|n . (p - q)| of three planes each."""
    return jnp.abs(sum(n[k] * (p[k] - q[k]) for k in range(3)))


def normal_distance(n, m):
    return jnp.sqrt(sum((n[k] - m[k]) ** 2 for k in range(3)))


def mismatch(p, n, q, m, size):
    """0 = the same surface, 1 = another: points p and q with normals n and m, planes of 3 each."""
    off = jnp.maximum(plane_distance(p, q, n), plane_distance(p, q, m)) / size
    return jnp.maximum(ramp(off, PLANE), ramp(normal_distance(n, m), NORMAL))


# ------------------------------------------------------------------------------------------- which pixels are mixed


STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))  # rows down, columns right: every pair of neighbours once


def torn(always, position, normal, mask, pixel):
    """[H, W] bool: pixels of whose 3 x 3 not all show one surface, nor all nothing."""
    height, width = mask.shape

    def ends(dy, dx):
        here = slice(0, height - dy), slice(max(-dx, 0), width - max(dx, 0))
        there = slice(dy, height), slice(max(dx, 0), width + min(dx, 0))
        return here, there

    def pad(flags, at):
        return jnp.pad(flags, [(s.start, size - s.stop) for s, size in zip(at, mask.shape, strict=True)])

    def links(position, normal, mask):
        """Bit k: the step number k leads from this pixel to another surface."""
        word = jnp.zeros(mask.shape, jnp.uint8)
        for k, step in enumerate(STEPS):
            if step[0] < height and abs(step[1]) < width:
                here, there = ends(*step)
                p, q, n, m = ([t[(*at, c)] for c in range(3)] for t in (position, normal) for at in (here, there))
                off = jnp.maximum(plane_distance(p, q, n), plane_distance(p, q, m))
                near = off <= PLANE[0] * footprint(jnp.maximum(p[2], q[2]), pixel)
                alike = sum((n[c] - m[c]) ** 2 for c in range(3)) <= NORMAL[0] ** 2
                both, none = mask[here] & mask[there], ~(mask[here] | mask[there])
                broken = ~((near & alike & both) | none)
                word = word | pad(jnp.where(broken, jnp.uint8(1 << k), jnp.uint8(0)), here)
        return word

    word = stored(always, links, position, normal, mask)
    edge = np.ones((height, width), bool)
    edge[1:-1, 1:-1] = False
    out = (word > 0) | (mask & edge)  # nobody knows what is behind the edge of the image
    for k, step in enumerate(STEPS):
        if step[0] < height and abs(step[1]) < width:
            here, there = ends(*step)
            out = out | pad((word[here] & np.uint8(1 << k)) > 0, there)
    return out


def wanted_cells(mixed):
    """Summed-area table of the cells of CELL x CELL pixels that hold a mixed pixel."""
    height, width = mixed.shape
    padded = jnp.pad(mixed, ((0, -height % CELL), (0, -width % CELL)))
    rows, columns = padded.shape[0] // CELL, padded.shape[1] // CELL
    cells = jnp.any(padded.reshape(rows, CELL, columns, CELL), axis=(1, 3)).astype(jnp.int32)
    return jnp.pad(jnp.cumsum(jnp.cumsum(cells, axis=0), axis=1), ((1, 0), (1, 0)))


# ------------------------------------------------------------------------------------------- and what they see


def borrowed(always, vertices, normals, view, projection, m, position, normal, faces, mask, triangle, mixed):
    """source [H, W, S * S] int8 and fraction [H, W]."""
    height, width = mask.shape
    samples = triangle.shape[0] // height
    count = height * width
    chunk = min(CHUNK, -(-count // 64) * 64)
    pixels, total = listed(mixed.reshape(-1), chunk)
    pixel = pixel_size(projection, height, width)
    flat_ids, flat_faces = triangle.reshape(-1), faces.reshape(-1)
    flat_position, flat_normal, flat_mask = position.reshape(-1), normal.reshape(-1), mask.reshape(-1)
    square = samples * samples
    sy, sx = np.divmod(np.arange(square, dtype=np.int32)[:, None], np.int32(samples))

    def place(pixel):
        """Row and column, the samples' ids [S * S, n] and clip x/w, y/w."""
        pixel = jnp.minimum(pixel, count - 1)
        row = pixel // width
        column = pixel - row * width
        fine_y, fine_x = row[None] * samples + sy, column[None] * samples + sx
        return row, column, take(flat_ids, fine_y * (width * samples) + fine_x), fine_x, fine_y

    def corners(ids):
        corner = np.arange(3, dtype=np.int32)[None, :, None]
        index = take(flat_faces, (jnp.maximum(ids, 0) * 3)[:, None] + corner)
        return [table_rows((t.reshape(-1), 3), index) for t in (vertices, normals)]

    stage = functools.partial(stored, always)

    def values(rows, fine_x, fine_y):
        """Camera-space position and normal of the samples, [6, S * S, n]."""
        dtype = vertices.dtype

        def edges(m, position, fine_x, fine_y):
            p = (fine_x.astype(dtype) + 0.5) * (2 / (width * samples)) - 1
            q = 1 - (fine_y.astype(dtype) + 0.5) * (2 / (height * samples))
            relative = []
            for axis, t in ((0, p), (1, q)):
                k = [m[axis, c] - t * m[3, c] for c in range(4)]
                relative.append(sum(k[c][:, None] * position[:, :, c] for c in range(3)) + k[3][:, None])
            return edge_products(jnp.concatenate(relative, 1))

        def write(function, *args):
            return stage(lambda *args: jnp.stack(function(*args)), *args)

        w = stage(weights, stage(edges, m, rows[0], fine_x, fine_y))
        _, place, n = surface(stage, write, view, w, [stage(blend, w, t) for t in rows], rows)
        return jnp.concatenate([place, n])

    def around(row, column):
        """Position, normal and whether there is anything, of the 3 x 3 pixels: [9, 6, n] and [9, n]."""
        y = row[None] + np.repeat(np.arange(-1, 2, dtype=np.int32), 3)[:, None]
        x = column[None] + np.tile(np.arange(-1, 2, dtype=np.int32), 3)[:, None]
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        at = jnp.clip(y, 0, height - 1) * width + jnp.clip(x, 0, width - 1)
        three = np.arange(3, dtype=np.int32)[None, :, None]
        both = [take(t, (at * 3)[:, None] + three) for t in (flat_position, flat_normal)]
        return jnp.concatenate(both, 1), inside & take(flat_mask, at)

    def choose(value, near, there, ids):
        """source [S * S, n]: the neighbour of least mismatch."""
        best = jnp.full(ids.shape, 8.0, value.dtype)
        source = jnp.full(ids.shape, -1, jnp.int32)
        offset_y, offset_x = ((s.astype(value.dtype) + 0.5) / samples - 0.5 for s in (sy, sx))
        for k in ORDER:
            at = [near[k, c][None] for c in range(6)]
            size = footprint(jnp.maximum(value[2], at[2]), pixel)
            off = mismatch(value[:3], value[3:], at[:3], at[3:], size)
            screen = (k // 3 - 1 - offset_y) ** 2 + (k % 3 - 1 - offset_x) ** 2
            score = jnp.where(there[k][None], off + NEARER * screen.astype(value.dtype), 9)
            source = jnp.where(score < best, k, source)
            best = jnp.minimum(score, best)
        return jnp.where(ids >= 0, source, -1).astype(jnp.int8)

    def step(state):
        i, source, fraction = state
        pixel = lax.dynamic_slice(pixels, (i * chunk,), (chunk,))
        row, column, ids, fine_x, fine_y = stored(always, place, pixel)
        rows = stored(always, corners, ids)
        value = values(rows, fine_x, fine_y)
        near, there = stored(always, around, row, column)
        chosen = stored(always, choose, value, near, there, ids)
        share = jnp.sum((chosen >= 0).astype(jnp.float32), axis=0) * (1 / square)
        at = {"mode": "drop", "unique_indices": False}
        return i + 1, source.at[pixel].set(chosen.T, **at), fraction.at[pixel].set(share, **at)

    plain = jnp.where(mask, jnp.int8(OWN), jnp.int8(-1)).reshape(-1, 1)
    state = jnp.int32(0), jnp.broadcast_to(plain, (count, square)), flat_mask.astype(jnp.float32)
    _, source, fraction = lax.while_loop(lambda state: state[0] * chunk < total, step, state)
    return source.reshape(height, width, square), fraction.reshape(height, width)
