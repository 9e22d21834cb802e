"""Large faces, cut into (face, 8 x 8 tile) pairs; faces that the near plane cuts take the same way, unclipped.

A corner that cannot be snapped (behind the near plane, or so far off the image that integers would overflow) stays a
homogeneous point, and an edge is a line through two points of either kind (Olano and Greer 1997: no polygon is ever
clipped). Lines are computed in float64 from the corner of lower index to that of higher index, then made integers,
through the snapped corner where there is one: neighbours agree on every shared line, so that large, cut and small faces
fit together without a hole or a double hit. The near plane itself is a bound on the nearness, tested per pixel.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.bins import corner_indices, is_even, select
from shapeenh.buffers.project import BEHIND, FAR_OFF, GUARD, ONE, SUB, faces_viewer, three, top_left, transform
from shapeenh.buffers.windows import merge, window_keys
from shapeenh.buffers.xla import lower_bound, stored, take

TILE = 8
FACES = 256  # faces per step
PAIRS = 1024  # (face, tile) pairs per step
SLOPE = float(1 << 26)  # size of the integer direction of a line through a homogeneous point: 1/1024 px over 65,536 px
LINES = ((1, 2, 0, 1), (0, 2, 1, -1), (0, 1, 2, 1))  # from, to (ascending), opposite corner, parity

F64, I64, I32 = jnp.float64, jnp.int64, jnp.int32


def cast(value, dtype):
    return lax.convert_element_type(value, dtype)


def line(p, snapped, x, y, i, j):
    """The line through corners i and j: float64 (a, b, c), and integers with the same sign everywhere."""
    a = p[i][1] * p[j][2] - p[i][2] * p[j][1]
    b = p[i][2] * p[j][0] - p[i][0] * p[j][2]
    c = p[i][0] * p[j][1] - p[i][1] * p[j][0]
    both = snapped[i] & snapped[j]  # then a, b, c are exact integers already
    size = jnp.maximum(jnp.abs(a), jnp.abs(b))
    scale = jnp.where(both, 1.0, SLOPE / jnp.maximum(size, 1e-300))
    ia, ib = cast(jnp.rint(a * scale), I64), cast(jnp.rint(b * scale), I64)
    anchor_x, anchor_y = (cast(jnp.where(snapped[i], t[i], t[j]), I64) for t in (x, y))
    through = -(ia * anchor_x + ib * anchor_y)
    free = cast(jnp.clip(jnp.rint(c * scale), -(2.0**58), 2.0**58), I64)
    return (a, b, c), (ia, ib, jnp.where(snapped[i] | snapped[j], through, free))


def visible_box(p, x, y, front, depth, height, width):
    """First and last pixel that the part in front of the near plane can touch: front corners, and the points where
    edges cross the plane (those with a pixel's margin)."""
    low = [jnp.full(x[0].shape, np.inf, F64) for _ in range(2)]
    high = [-a for a in low]

    def add(valid, point, margin):
        for k in range(2):
            low[k] = jnp.where(valid, jnp.minimum(low[k], point[k] - margin), low[k])
            high[k] = jnp.where(valid, jnp.maximum(high[k], point[k] + margin), high[k])

    for k in range(3):
        add(front[k], (cast(x[k], F64), cast(y[k], F64)), 0.0)
    for i, j, _, _ in LINES:
        gap = depth[i] - depth[j]
        t = jnp.clip(depth[i] / jnp.where(gap == 0, 1.0, gap), 0.0, 1.0)
        cut = [p[i][k] + t * (p[j][k] - p[i][k]) for k in range(3)]
        w = jnp.maximum(cut[2], 1e-300)
        point = [jnp.clip(cut[k] / w, -float(FAR_OFF), float(FAR_OFF)) for k in range(2)]
        add(front[i] != front[j], point, float(ONE))

    def first(value):
        return cast(jnp.ceil(jnp.clip(value, 0.0, 2.0**30) / ONE), I32)

    def last(value, limit):
        return cast(jnp.floor(jnp.clip(value, -float(ONE), (limit - 1.0) * ONE) / ONE), I32)

    return first(low[0]), last(high[0], width), first(low[1]), last(high[1], height)


def large_setup(position, x, y, r, even, valid, m, near, shift, *, height, width, cull):
    """Integer lines, the nearness plane, and the tiles of n faces, from world positions [n, 3] and snapped x, y, r."""
    clip = [transform(cast(t, F64), cast(m, F64)) for t in position]
    near, shift = cast(near, F64), cast(shift, F64)
    front = [x[k] != BEHIND for k in range(3)]
    snapped = [front[k] & (jnp.abs(x[k]) <= GUARD) & (jnp.abs(y[k]) <= GUARD) for k in range(3)]
    half_x, half_y = width * ONE / 2, height * ONE / 2
    free, mixed, weight, depth = [], [], [], []
    for k in range(3):
        cx, cy, c, w = clip[k]
        point = ((cx + w) * half_x - w * (ONE // 2), (w - cy) * half_y - w * (ONE // 2), w)
        exact = (cast(x[k], F64), cast(y[k], F64), jnp.ones_like(w))
        free.append(point)
        mixed.append([jnp.where(snapped[k], e, h) for e, h in zip(exact, point, strict=True)])
        weight.append(jnp.where(snapped[k], cast(r[k], F64), c) - shift * mixed[k][2])
        depth.append(near * w - c)
    finite = jnp.isfinite(sum(t for corner in clip for t in corner))

    lines = {opposite: line(mixed, snapped, x, y, i, j) for i, j, opposite, _ in LINES}
    a, b, c = lines[2][0]
    area = a * mixed[2][0] + b * mixed[2][1] + c * mixed[2][2]
    inverse = 1 / jnp.where(area == 0, 1.0, area)
    sign = jnp.where(area < 0, -1, 1).astype(jnp.int64)
    edges, plane = [], [jnp.zeros_like(area)] * 3
    for _, _, k, parity in LINES:
        ia, ib, ic = (t * (sign * parity) for t in lines[k][1])
        edges.append((ia, ib, (ic - jnp.where(top_left(ia, ib), 0, 1)) >> SUB))
        plane = [s + t * (weight[k] * inverse * parity) for s, t in zip(plane, lines[k][0], strict=True)]

    whole = front[0] & front[1] & front[2]
    shifted = [cast(cast(r[k], F64) - shift, jnp.float32) for k in range(3)]
    limit = cast(near - shift, jnp.float32)
    lowest = three(jnp.minimum, [jnp.where(front[k], shifted[k], np.float32(np.inf)) for k in range(3)])
    highest = jnp.where(whole, three(jnp.maximum, shifted), limit)
    bound = jnp.where(whole, np.float32(np.inf), limit)

    x0, x1, y0, y1 = visible_box(free, x, y, front, depth, height, width)
    bits = TILE.bit_length() - 1
    tx, ty = x0 >> bits, y0 >> bits
    columns, rows = (x1 >> bits) - tx + 1, (y1 >> bits) - ty + 1
    drawn = valid & finite & faces_viewer(jnp.where(even, area, -area), cull) & (x1 >= x0) & (y1 >= y0)
    return edges, (plane, lowest, highest, bound), tx, ty, columns, jnp.where(drawn, columns * rows, 0)


def draw_large(
    keys, rank, total, words, ends, corners, faces, vertices, m, near, shift, *, height, width, cull, stride
):
    """The faces number `rank` [n] of the large class, drawn into the keys, PAIRS tiles at a time."""
    x, y, r = corners
    some = total > 0
    last = faces[0].shape[0] - 1

    def find(rank, words, ends):
        return jnp.minimum(select(words, ends, jnp.minimum(rank, total - 1)), last)

    def setup(face, rank, vertices, m, near, shift):
        index = corner_indices(faces, face)
        tx, ty, tr = ([take(plane, i) for i in index] for plane in (x, y, r))
        position = [take(vertices, i) for i in index]
        return large_setup(
            position,
            tx,
            ty,
            tr,
            is_even(faces, face),
            rank < total,
            m,
            near,
            shift,
            height=height,
            width=width,
            cull=cull,
        )

    face = stored(some, find, rank, words, ends)
    edges, (plane, lowest, highest, bound), tx, ty, columns, count = stored(
        some, setup, face, rank, vertices, m, near, shift
    )
    tile_ends = jnp.cumsum(count)
    tiles = tile_ends[-1]
    bits = TILE.bit_length() - 1

    def locate(pair):
        pair = jnp.minimum(pair, tiles - 1)
        t = lower_bound(tile_ends, pair)
        k = pair - (take(tile_ends, t) - take(count, t))
        across = jnp.maximum(take(columns, t), 1)
        row = k // across
        ox, oy = (take(tx, t) + (k - row * across)) << bits, (take(ty, t) + row) << bits
        return t, jnp.clip(ox, 0, width - 1), jnp.clip(oy, 0, height - 1)

    def tile(t, ox, oy, pair):
        wide_x, wide_y = cast(ox, I64), cast(oy, I64)
        local = []
        for k in range(3):
            a, b, c = (take(e, t) for e in edges[k])
            # within the tile |a dx + b dy| < 2^30: what is further from zero than that keeps its sign
            at = jnp.clip(a * wide_x + b * wide_y + c, -(1 << 30), 1 << 30)
            local.append([cast(v, I32) for v in (a, b, at)])
        local[0][2] = jnp.where(pair < tiles, local[0][2], -(1 << 30))
        gx, gy, base = (take(v, t) for v in plane)
        start = base + gx * cast(wide_x << SUB, F64) + gy * cast(wide_y << SUB, F64)
        slope = [cast(v, jnp.float32) for v in (start, gx * ONE, gy * ONE)]
        clamp = [take(v, t) for v in (lowest, highest, bound)]
        return local, slope + clamp, ~cast(take(face, t), jnp.uint32), oy * stride + ox

    def step(state):
        j, keys = state
        pair = j * PAIRS + lax.iota(jnp.int32, PAIRS)
        t, ox, oy = stored(tiles > 0, locate, pair)
        local, slope, low, first = stored(tiles > 0, tile, t, ox, oy, pair)
        return j + 1, merge(keys, window_keys(local, slope, low, TILE, TILE), first, stride)

    return lax.while_loop(lambda state: state[0] * PAIRS < tiles, step, (jnp.int32(0), keys))[1]
