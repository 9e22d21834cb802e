"""Large faces, cut into (face, 8 x 8 tile) pairs; faces that the near plane cuts take the same way, unclipped.

A corner that cannot be snapped (behind the near plane, or so far off the image that integers would overflow) stays a
homogeneous point, and an edge is a line through two points of either kind (Olano and Greer 1997: no polygon is ever
clipped). Lines are computed in float64 from the corner of lower index to that of higher index, then made integers,
through the snapped corner where there is one: neighbours agree on every shared line, so that large, cut and small faces
fit together without a hole or a double hit. The near plane itself is a bound on the nearness, tested per pixel.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.project import BEHIND, FAR_OFF, GUARD, ONE, SUB, faces_viewer, nearness, three, top_left
from shapeenh.buffers.windows import merge, window_keys
from shapeenh.buffers.xla import apart, take
from shapeenh.fusion import unknown_truth

TILE = 8
BITS = TILE.bit_length() - 1
FACES = 256  # faces per step
PAIRS = 1024  # (face, tile) pairs per step
SLOPE = float(1 << 26)  # size of the integer direction of a line through a homogeneous point: 1/1024 px over 65,536 px
FROM, TO, PARITY = np.array([1, 0, 0]), np.array([2, 2, 1]), np.array([1, -1, 1])  # the line opposite to corner 0, 1, 2
LIMIT = 1 << 30  # within a tile |a dx + b dy| is less: an edge function further from zero than that keeps its sign

F64, I64, I32, F32 = jnp.float64, jnp.int64, jnp.int32, jnp.float32


def tile_count(height, width):
    return -(-height // TILE) * -(-width // TILE)


def cast(value, dtype):
    return lax.convert_element_type(value, dtype)


def clip(position, m):
    """Float64 [4, 3, n], x, y, nearness and w, of world positions [3, 3, n]."""
    return sum(m[:, k, None, None] * position[k][None] for k in range(3)) + m[:, 3, None, None]


def homogeneous(clipped, xyr, near, shift, height, width):
    """Float64 [8, 3, n] of `clip`'s: homogeneous window coordinates x, y, w; the same with corners that can be snapped
    in their place, w = 1; nearness times the latter w; depth beyond the near plane."""
    cx, cy, c, w = clipped
    half_x, half_y = width * ONE / 2, height * ONE / 2
    free = [(cx + w) * half_x - w * (ONE // 2), (w - cy) * half_y - w * (ONE // 2), w]
    at = snapped(xyr)
    exact = [cast(xyr[0], F64), cast(xyr[1], F64), jnp.ones_like(w)]
    mixed = [jnp.where(at, e, f) for e, f in zip(exact, free, strict=True)]
    weight = jnp.where(at, cast(nearness(xyr[2]), F64), c) - shift * mixed[2]
    return jnp.stack([*free, *mixed, weight, near * w - c])


def snapped(xyr):
    return (xyr[0] != BEHIND) & (jnp.abs(xyr[0]) <= GUARD) & (jnp.abs(xyr[1]) <= GUARD)


def lines(mixed):
    """Float64 (a, b, c) [3, 3, n] of the lines opposite to each corner, exact integers where both ends are snapped."""
    x, y, w = mixed
    a = y[FROM] * w[TO] - w[FROM] * y[TO]
    b = w[FROM] * x[TO] - x[FROM] * w[TO]
    c = x[FROM] * y[TO] - y[FROM] * x[TO]
    return jnp.stack([a, b, c])


def signed_area(abc, mixed):
    return sum(abc[k, 2] * mixed[k, 2] for k in range(3))


def integer_edges(abc, mixed, xyr):
    """Integers [3, 3, n]: a, b, c of edge functions in pixels, as in `windows.edge_functions`, |a| and |b| <= SLOPE."""
    at = snapped(xyr)
    both = at[FROM] & at[TO]
    a, b, c = abc
    scale = jnp.where(both, 1.0, SLOPE / jnp.maximum(jnp.maximum(jnp.abs(a), jnp.abs(b)), 1e-300))
    a, b = cast(jnp.rint(a * scale), I64), cast(jnp.rint(b * scale), I64)
    anchor_x, anchor_y = (cast(jnp.where(at[FROM], t[FROM], t[TO]), I64) for t in (xyr[0], xyr[1]))
    free = cast(jnp.clip(jnp.rint(c * scale), -(2.0**58), 2.0**58), I64)
    c = jnp.where(at[FROM] | at[TO], -(a * anchor_x + b * anchor_y), free)
    sign = jnp.where(signed_area(abc, mixed) < 0, -1, 1)[None] * PARITY[:, None]
    a, b, c = a * sign, b * sign, c * sign
    return jnp.stack([a, b, (c - jnp.where(top_left(a, b), 0, 1)) >> SUB])


def visible_box(free, depth, xyr, height, width):
    """[4, n] int32: first and last pixel column and row that the part in front of the near plane can touch: front
    corners, and the points where edges cross the plane (those with a pixel's margin)."""
    front = xyr[0] != BEHIND
    gap = depth[FROM] - depth[TO]
    t = jnp.clip(depth[FROM] / jnp.where(gap == 0, 1.0, gap), 0.0, 1.0)
    cut = free[:, FROM] + t[None] * (free[:, TO] - free[:, FROM])
    crossing = front[FROM] != front[TO]
    box = []
    for k, size in ((0, width), (1, height)):
        crossed = jnp.clip(cut[k] / jnp.maximum(cut[2], 1e-300), -float(FAR_OFF), float(FAR_OFF))
        low, high = jnp.full(front.shape[1:], np.inf), jnp.full(front.shape[1:], -np.inf)
        for corner in range(3):
            for valid, point, margin in ((front, cast(xyr[k], F64), 0.0), (crossing, crossed, float(ONE))):
                low = jnp.where(valid[corner], jnp.minimum(low, point[corner] - margin), low)
                high = jnp.where(valid[corner], jnp.maximum(high, point[corner] + margin), high)
        box.append(cast(jnp.ceil(jnp.clip(low, 0.0, float(LIMIT)) / ONE), I32))
        box.append(cast(jnp.floor(jnp.clip(high, -float(ONE), (size - 1.0) * ONE) / ONE), I32))
    return jnp.stack(box)


def tile_box(box, points, abc, even, valid, cull):
    """[4, n] int32: first tile column and row, number of columns, number of tiles; none where nothing is drawn."""
    x0, x1, y0, y1 = box
    area = signed_area(abc, points[3:6])
    finite = jnp.isfinite(jnp.sum(points, axis=(0, 1)))
    drawn = valid & finite & faces_viewer(jnp.where(even, area, -area), cull) & (x1 >= x0) & (y1 >= y0)
    tx, ty = x0 >> BITS, y0 >> BITS
    columns, rows = (x1 >> BITS) - tx + 1, (y1 >> BITS) - ty + 1
    return jnp.stack([tx, ty, columns, jnp.where(drawn, columns * rows, 0)])


def nearness_lines(points, abc):
    """Float64 [3, n]: the nearness as a function a x + b y + c of window coordinates."""
    area = signed_area(abc, points[3:6])
    weight = points[6] * PARITY[:, None] / jnp.where(area == 0, 1.0, area)[None]
    return sum(abc[:, k] * weight[k][None] for k in range(3))


def nearness_range(xyr, near, shift):
    """Float32 [3, n]: least and greatest nearness of the visible part, and the bound where the near plane cuts."""
    front = xyr[0] != BEHIND
    r = cast(nearness(xyr[2]) - shift, F32)
    whole = front[0] & front[1] & front[2]
    limit = cast(near - shift, F32)
    lowest = three(jnp.minimum, jnp.where(front, r, np.float32(np.inf)))
    highest = jnp.where(whole, three(jnp.maximum, r), limit)
    return jnp.stack([lowest, highest, jnp.where(whole, np.float32(np.inf), limit)])


def draw_tiles(keys, vertices, face, index, xyr, even, valid, m, near, shift, *, height, width, cull, stride):
    """Faces [n] with corner indices [3, n] (ascending) and corners xyr, three [3, n], drawn into the keys."""
    always = unknown_truth(vertices, m, face)
    m, wide_near, wide_shift = cast(m, F64), cast(near, F64), cast(shift, F64)

    def clipped(index, m):
        position = take(vertices.reshape(-1), index[None] * 3 + np.arange(3, dtype=np.int32)[:, None, None])
        return clip(cast(position, F64), m)

    def points(clipped, xyr, near, shift):
        return homogeneous(clipped, xyr, near, shift, height, width)

    point = apart(always, points, apart(always, clipped, index, m), xyr, wide_near, wide_shift)
    abc = apart(always, lines, point[3:6])
    edges = apart(always, integer_edges, abc, point[3:6], xyr)

    def boxes(point, xyr):
        return visible_box(point[:3], point[7], xyr, height, width)

    box = apart(always, boxes, point, xyr)
    box = apart(always, functools.partial(tile_box, cull=cull), box, point, abc, even, valid)
    plane = apart(always, nearness_lines, point, abc)
    limits = apart(always, nearness_range, xyr, near, shift)
    ends = jnp.cumsum(box[3], dtype=jnp.int32)
    tiles = ends[-1]

    def locate(pair):
        """The pair's face, and its tile's first pixel."""
        pair = jnp.minimum(pair, tiles - 1)
        t = jnp.sum(ends[:, None] <= pair[None], axis=0, dtype=jnp.int32)
        tx, ty, columns, count = (take(b, t) for b in box)
        k = pair - (take(ends, t) - count)
        row = k // jnp.maximum(columns, 1)
        ox, oy = (tx + (k - row * columns)) << BITS, (ty + row) << BITS
        return jnp.stack([t, jnp.clip(ox, 0, width - 1), jnp.clip(oy, 0, height - 1)])

    def local_edges(at, pair):
        a, b, c = (take(e.T, at[0]).T for e in edges)
        c = jnp.clip(a * cast(at[1], I64)[None] + b * cast(at[2], I64)[None] + c, -LIMIT, LIMIT)
        c = jnp.where((pair < tiles)[None], c, -LIMIT)
        return cast(jnp.stack([a, b, c]), I32)

    def local_plane(at):
        gx, gy, base = (take(p, at[0]) for p in plane)
        start = base + gx * cast(at[1] << SUB, F64) + gy * cast(at[2] << SUB, F64)
        slope = cast(jnp.stack([start, gx * ONE, gy * ONE]), F32)
        return jnp.concatenate([slope, jnp.stack([take(t, at[0]) for t in limits])])

    def step(state):
        j, keys = state
        pair = j * PAIRS + lax.iota(jnp.int32, PAIRS)
        at = apart(always, locate, pair)
        local = apart(always, local_edges, at, pair)
        slope = apart(always, local_plane, at)
        low = ~cast(take(face, at[0]), jnp.uint32)
        return j + 1, merge(keys, window_keys(local, slope, low, TILE, TILE), at[2] * stride + at[1], stride)

    return lax.while_loop(lambda state: state[0] * PAIRS < tiles, step, (jnp.int32(0), keys))[1]
