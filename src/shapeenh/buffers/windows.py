"""Small faces: a dense window of candidate pixels each, exact integer edges, merged by the largest key.

A key holds the bits of the nearness above the complement of the face index, so that one integer maximum is the whole
depth test: nearest wins, ties go to the lowest index, and the order of drawing does not matter.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.project import ONE, SUB, double_area, pixel_box, three, top_left

OPPOSITE = ((1, 2), (2, 0), (0, 1))  # the edge opposite to corner 0, 1, 2
WINDOW = 8  # pixels each way, of faces that need more than one window
NEVER = np.int32(-(1 << 30))  # an edge function that no pixel of a window makes positive


def pack(hit, r, low):
    """Keys uint64; 0 where there is no hit. Masked before packing: a masked index would cost the scatter more."""
    bits = lax.bitcast_convert_type(jnp.abs(r), jnp.uint32)  # abs: -0.0 would sort above everything
    high = jnp.where(hit, bits, jnp.uint32(0))
    low = jnp.where(hit, low, jnp.uint32(0))
    wide = lax.convert_element_type(high, jnp.uint64) << np.uint64(32)
    return wide | lax.convert_element_type(low, jnp.uint64)


def window_box(x, y, height, width):
    """First pixel column and row of faces, held in the image, and how many windows of WINDOW x WINDOW cover the box."""
    x0, x1, y0, y1 = pixel_box(x, y, height, width)
    columns, rows = (x1 - x0) // WINDOW + 1, (y1 - y0) // WINDOW + 1
    return jnp.clip(x0, 0, width - 1), jnp.clip(y0, 0, height - 1), columns, rows


def move_window(edges, plane, dx, dy, there):
    """Edge functions [3, 3, n] and nearness plane [5, n] of `edges` [9, n] and `plane`, seen from a window that begins
    dx columns and dy rows further on; nothing is inside where not `there`. Still exact in float32."""
    dx, dy = lax.convert_element_type(dx, jnp.float32), lax.convert_element_type(dy, jnp.float32)
    a, b, c = edges[:3], edges[3:6], edges[6:]
    c = jnp.where(there[None], a * dx[None] + b * dy[None] + c, np.float32(NEVER))
    base = plane[0] + plane[1] * dx + plane[2] * dy
    return jnp.stack([a, b, c]), jnp.concatenate([base[None], plane[1:]])


def edge_functions(x, y):
    """Integers a, b, c of three edges each, for corners x, y, three [n] each, relative to the window's first pixel.

    Inside is a dx + b dy + c >= 0 for every edge, dx and dy counted in pixels: c = floor((c' - bias)/256) with the
    top-left rule as bias. Exact, and exact in float32 too (below 2^24), as long as the face is shorter than LONG.
    """
    sign = jnp.where(double_area(x, y) < 0, -1, 1)
    a = [(y[j] - y[k]) * sign for j, k in OPPOSITE]
    b = [(x[k] - x[j]) * sign for j, k in OPPOSITE]
    c = [-(a[i] * x[j] + b[i] * y[j]) for i, (j, _) in enumerate(OPPOSITE)]
    return a, b, [(c[i] - jnp.where(top_left(a[i], b[i]), 0, 1)) >> SUB for i in range(3)]


def nearness_plane(x, y, r):
    """Float32, five [n]: nearness at the first pixel, its steps in x and y, and its least and greatest value."""
    area = double_area(x, y)
    x, y = ([lax.convert_element_type(t, jnp.float32) for t in xs] for xs in (x, y))
    inverse = 1 / lax.convert_element_type(jnp.where(area == 0, 1, area), jnp.float32)
    d1, d2 = r[1] - r[0], r[2] - r[0]
    gx = (d1 * (y[2] - y[0]) - d2 * (y[1] - y[0])) * inverse
    gy = (d2 * (x[1] - x[0]) - d1 * (x[2] - x[0])) * inverse
    base = r[0] - gx * x[0] - gy * y[0]
    return base, gx * ONE, gy * ONE, three(jnp.minimum, r), three(jnp.maximum, r)


def window_keys(edges, plane, low, rows, columns):
    """Keys [n, rows, columns]; edges [3, 3, n] integer or float, plane [5 or 6, n], low [n].

    The nearness is held in the face's range: a sliver's plane is steep. A sixth entry is a bound that it may not pass.
    """
    column = np.arange(columns, dtype=edges.dtype)[None, None]  # NumPy: jitted jnp helpers fail inside enable_x64
    row = np.arange(rows, dtype=edges.dtype)[None, :, None]

    def wide(a):
        return a[:, None, None]

    a, b, c = edges
    inside = three(jnp.minimum, [wide(a[k]) * column + wide(b[k]) * row + wide(c[k]) for k in range(3)]) >= 0
    base, gx, gy, lowest, highest, *bound = (wide(p) for p in plane)
    r = base + gx * lax.convert_element_type(column, jnp.float32) + gy * lax.convert_element_type(row, jnp.float32)
    if bound:
        inside = inside & (r <= bound[0])
    return pack(inside, jnp.maximum(jnp.minimum(r, highest), lowest), wide(low))


def merge(keys, new, first, stride):
    """keys [n] with windows `new` [m, rows, columns] whose first pixel is `first` [m]: one scatter index per window
    row, because rows are contiguous in memory."""
    rows, columns = new.shape[1:]
    at = (first[:, None] + np.arange(rows, dtype=np.int32)[None] * stride).reshape(-1, 1)
    numbers = lax.ScatterDimensionNumbers(
        update_window_dims=(1,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
    )
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return lax.scatter_max(keys, at, new.reshape(-1, columns), numbers, mode=mode)


def pixel_keys(x, y, r, low, valid, rows, columns):
    """Keys [rows * columns, n] of faces with corners x, y, r, three [n] each, for a window too narrow to be worth a
    SIMD lane per pixel: a lane per face instead, and one kernel from corners to keys."""
    pixel = np.arange(rows * columns, dtype=np.int32)[:, None]
    dx, dy = pixel % columns, pixel // columns
    x, y, r = ([t[None] for t in corner] for corner in (x, y, r))
    a, b, c = edge_functions(x, y)
    inside = valid[None] & (three(jnp.minimum, [a[k] * dx + b[k] * dy + c[k] for k in range(3)]) >= 0)
    base, gx, gy, lowest, highest = nearness_plane(x, y, r)
    r = base + gx * dx.astype(np.float32) + gy * dy.astype(np.float32)
    return pack(inside, jnp.maximum(jnp.minimum(r, highest), lowest), low[None])
