"""Small faces: a dense window of candidate pixels each, exact integer edges, merged by the largest key.

A key holds the bits of the nearness above the complement of the face index, so that one integer maximum is the whole
depth test: nearest wins, ties go to the lowest index, and the order of drawing does not matter.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.bins import corner_indices, select
from shapeenh.buffers.project import ONE, SUB, double_area, pixel_box, three, top_left
from shapeenh.buffers.xla import stored, take

EDGES = ((1, 2), (2, 0), (0, 1))


def pack(hit, r, low):
    """Keys [...] uint64; 0 where there is no hit. Masked before packing: a masked index would cost the scatter more."""
    bits = lax.bitcast_convert_type(jnp.abs(r), jnp.uint32)  # abs: -0.0 would sort above everything
    high = jnp.where(hit, bits, jnp.uint32(0))
    low = jnp.where(hit, low, jnp.uint32(0))
    wide = lax.convert_element_type(high, jnp.uint64) << np.uint64(32)
    return wide | lax.convert_element_type(low, jnp.uint64)


def edge_planes(x, y, r, origin_x, origin_y):
    """Edges and nearness as functions of the pixel (dx, dy) counted from the origin.

    Inside is a dx + b dy + c >= 0 for every edge, with c = floor((c' - bias)/256): exact integers, and exact in
    float32 too (below 2^24) as long as the face is shorter than LONG. The bias is the top-left rule.
    """
    x = [a - (origin_x << SUB) for a in x]
    y = [a - (origin_y << SUB) for a in y]
    area = double_area(x, y)
    sign = jnp.where(area < 0, -1, 1)
    edges = []
    for i, j in EDGES:
        a, b = (y[i] - y[j]) * sign, (x[j] - x[i]) * sign
        c = -(a * x[i] + b * y[i])
        edges.append((a, b, (c - jnp.where(top_left(a, b), 0, 1)) >> SUB))
    real = [lax.convert_element_type(t, jnp.float32) for t in (*x, *y)]
    x, y = real[:3], real[3:]
    inverse = 1 / lax.convert_element_type(jnp.where(area == 0, 1, area), jnp.float32)
    d1, d2 = r[1] - r[0], r[2] - r[0]
    gx = (d1 * (y[2] - y[0]) - d2 * (y[1] - y[0])) * inverse
    gy = (d2 * (x[1] - x[0]) - d1 * (x[2] - x[0])) * inverse
    base = r[0] - gx * x[0] - gy * y[0]
    return edges, (base, gx * ONE, gy * ONE, three(jnp.minimum, r), three(jnp.maximum, r))


def window_keys(edges, plane, low, rows, columns):
    """Keys [n, rows, columns] of n faces. The nearness stays in the face's range: a sliver's plane is steep."""
    dtype = edges[0][0].dtype
    column = np.arange(columns, dtype=dtype)[None, None]  # NumPy: jitted jnp helpers fail inside enable_x64
    row = np.arange(rows, dtype=dtype)[None, :, None]

    def wide(a):
        return a[:, None, None]

    inside = three(jnp.minimum, [wide(a) * column + wide(b) * row + wide(c) for a, b, c in edges]) >= 0
    base, gx, gy, lowest, highest = (wide(a) for a in plane[:5])
    r = base + gx * lax.convert_element_type(column, jnp.float32) + gy * lax.convert_element_type(row, jnp.float32)
    if len(plane) == 6:
        inside = inside & (r <= wide(plane[5]))
    return pack(inside, jnp.maximum(jnp.minimum(r, highest), lowest), wide(low))


def merge(keys, new, first, stride):
    """keys [n] with windows `new` [m, rows, columns] whose first pixel is `first` [m]: one scatter index per window
    row, because rows are contiguous in memory."""
    rows, columns = new.shape[1:]
    at = (first[:, None] + jnp.arange(rows, dtype=jnp.int32) * stride).reshape(-1, 1)
    numbers = lax.ScatterDimensionNumbers(
        update_window_dims=(1,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
    )
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return lax.scatter_max(keys, at, new.reshape(-1, columns), numbers, mode=mode)


def window_origin(x, y, height, width):
    x0, _, y0, _ = pixel_box(x, y, height, width)
    return jnp.clip(x0, 0, width - 1), jnp.clip(y0, 0, height - 1)


def tiny_keys(x, y, r, low, valid, height, width, rows, columns):
    """The first pixel and the keys of each candidate, for windows too narrow to be worth a SIMD lane per pixel: one
    lane per face instead."""
    origin_x, origin_y = window_origin(x, y, height, width)
    x = [a - (origin_x << SUB) for a in x]
    y = [a - (origin_y << SUB) for a in y]
    area = double_area(x, y)
    flipped = area < 0
    inverse = 1 / lax.convert_element_type(jnp.where(area == 0, 1, area), jnp.float32)
    keys = []
    for row in range(rows):
        for column in range(columns):
            px, py = [column * ONE - a for a in x], [row * ONE - a for a in y]
            hit, weights = valid, []
            for i, j in EDGES:
                e = px[i] * py[j] - px[j] * py[i]
                a, b = y[i] - y[j], x[j] - x[i]
                keeps = top_left(jnp.where(flipped, -a, a), jnp.where(flipped, -b, b))
                inwards = jnp.where(flipped, -e, e)
                hit = hit & jnp.where(keeps, inwards >= 0, inwards > 0)
                weights.append(lax.convert_element_type(e, jnp.float32))
            near = r[0] + (weights[1] * (r[1] - r[0]) + weights[2] * (r[2] - r[0])) * inverse
            keys.append(pack(hit, jnp.maximum(near, 0), low))
    return origin_x, origin_y, keys


def draw_small(keys, rank, total, words, ends, corners, shift, faces, *, height, width, window, stride):
    """The faces number `rank` [n] of a class, drawn into the keys."""
    x, y, r = corners
    rows, columns = window
    some = total > 0
    last = faces[0].shape[0] - 1

    def find(rank, words, ends):
        return jnp.minimum(select(words, ends, jnp.minimum(rank, total - 1)), last)

    def fetch(face):
        index = corner_indices(faces, face)
        tr = [take(r, i) - shift for i in index]
        return [take(x, i) for i in index], [take(y, i) for i in index], tr

    face = stored(some, find, rank, words, ends)
    tx, ty, tr = stored(some, fetch, face)

    if rows * columns <= 4:

        def tiny(tx, ty, tr, face, rank):
            ox, oy, new = tiny_keys(
                tx, ty, tr, ~lax.convert_element_type(face, jnp.uint32), rank < total, height, width, rows, columns
            )
            return oy * stride + ox, new

        first, new = stored(some, tiny, tx, ty, tr, face, rank)
        for k, key in enumerate(new):
            keys = keys.at[first + (k // columns * stride + k % columns)].max(key, mode="promise_in_bounds")
        return keys

    def setup(tx, ty, tr, face, rank):
        ox, oy = window_origin(tx, ty, height, width)
        edges, plane = edge_planes(tx, ty, tr, ox, oy)
        edges = [[lax.convert_element_type(a, jnp.float32) for a in e] for e in edges]
        edges[0][2] = jnp.where(rank < total, edges[0][2], -1e30)  # the tail of the last chunk draws nothing
        return edges, plane, ~lax.convert_element_type(face, jnp.uint32), oy * stride + ox

    edges, plane, low, first = stored(some, setup, tx, ty, tr, face, rank)
    return merge(keys, window_keys(edges, plane, low, rows, columns), first, stride)
