"""Perspective-correct barycentric weights of a group of runs, and their reverse mode, written by hand (SPEC 11).

For a pixel with centre (p, q) in normalised device coordinates and the corners' clip coordinates (x_i, y_i, w_i), with
a_i = (x_i - p w_i, y_i - q w_i), the perspective-correct barycentrics are

    b = e / s,   e = (a_1 x a_2, a_2 x a_0, a_0 x a_1),   s = e_0 + e_1 + e_2

(Olano and Greer 1997). No division by w_i: corners behind the eye do no harm; coordinates are relative to the pixel, so
that float32 does not cancel. One formula for perspective and orthographic cameras.

Snapping lets a pixel centre lie up to 1/360 px outside of the face that covers it. That is extrapolated (a plane stays
the plane it is) unless a weight falls below -1/64, which only happens on faces thinner than a fifth of a pixel: there
the weights are those of the nearest part of the face, so that no sliver throws sparks.
"""

from __future__ import annotations

import math

import jax.numpy as jnp

from shapeenh.buffers.runs import pixel_ndc

OUTSIDE = 1 / 64  # how far outside a weight may be before it is held at the face's edge


def weigh(stage, m, start, position, height, width):
    """a, e and the weights. Each stage makes one array: of a list of results, every one would compute what they have
    in common, and what is as small as one plane is computed on one core."""
    a = stage(lambda m, start, x: relative(m, start, x, height, width), m, start, position)
    e = stage(edge_products, a)
    return a, e, stage(weights, e)


def pixel_rows(m, start, height, width, dtype):
    """clip x - p w and clip y - q w as functions of the world position: two rows of four, [runs, LANES] each."""
    p, q = pixel_ndc(start, height, width, dtype)
    return [[m[row, k] - t * m[3, k] for k in range(4)] for row, t in ((0, p), (1, q))]


def relative(m, start, position, height, width):
    """x of a_0, a_1, a_2, then y: [runs, 6, LANES], of positions [runs, 3, 3, LANES]."""
    rows = pixel_rows(m, start, height, width, position.dtype)
    return jnp.concatenate([sum(k[c][:, None] * position[:, :, c] for c in range(3)) + k[3][:, None] for k in rows], 1)


def edge_products(a):
    """e_0, e_1, e_2, and the size of what they are differences of: [runs, 4, LANES]."""
    x, y = a[:, :3], a[:, 3:]
    left, right = ([u[:, (i + 1) % 3] * v[:, (i + 2) % 3] for i in range(3)] for u, v in ((x, y), (y, x)))
    size = sum(jnp.abs(t) for t in (*left, *right))
    return jnp.stack([*(s - t for s, t in zip(left, right, strict=True)), size], 1)


def barycentrics(e):
    """Weights b, the unclamped ones, 1/s (0 where the face is degenerate to rounding) and 1/(sum of what was held)."""
    *e, size = planes(e)
    s = e[0] + e[1] + e[2]
    flat = jnp.abs(s) <= 4 * jnp.finfo(s.dtype).eps * size
    inverse = jnp.where(flat, 0, 1 / jnp.where(flat, 1, s))
    raw = [jnp.where(flat, s.dtype.type(1 / 3), t * inverse) for t in e]
    thin = jnp.minimum(jnp.minimum(raw[0], raw[1]), raw[2]) < -OUTSIDE
    held = [jnp.where(thin, jnp.maximum(t, 0), t) for t in raw]
    total = jnp.where(thin, 1 / (held[0] + held[1] + held[2]), 1)
    return [t * total for t in held], raw, inverse, total


def weights(e):
    """The weights and 1/s, [runs, 4, LANES]."""
    b, _, inverse, _ = barycentrics(e)
    return jnp.stack([*b, inverse], 1)


def planes(table):
    """The columns [runs, LANES] of [runs, columns, LANES]."""
    return [table[:, k] for k in range(table.shape[1])]


# ------------------------------------------------------------------------------------------- reverse


def weight_cotangents(gb, e):
    """Cotangents [runs, 3, LANES] of e, from those of the weights: back through the hold at the edge, then e / s."""
    b, raw, inverse, total = barycentrics(e)
    gb = planes(gb)
    mean = sum(b[j] * gb[j] for j in range(3))
    held = total != 1
    g = [jnp.where(held & (raw[j] <= 0), 0, (gb[j] - mean) * total) for j in range(3)]
    mean = sum(raw[j] * g[j] for j in range(3))
    return jnp.stack([(g[j] - mean) * inverse for j in range(3)], 1)


def point_cotangents(ge, a):
    """Cotangents [runs, 6, LANES] of a."""
    g, a = planes(ge), planes(a)
    u, v = (1, 2, 0), (2, 0, 1)
    gx = [g[v[j]] * a[3 + u[j]] - g[u[j]] * a[3 + v[j]] for j in range(3)]
    gy = [g[u[j]] * a[v[j]] - g[v[j]] * a[u[j]] for j in range(3)]
    return jnp.stack(gx + gy, 1)


def matrix_sums(ga, position, start, *, height, width):
    """Cotangents [3, 4] of the rows x, y and w of the matrix."""
    p, q = pixel_ndc(start, height, width, ga.dtype)
    x, y = (
        [sum(ga[:, first + j] * position[:, j, c] for j in range(3)) for c in range(3)]
        + [sum(ga[:, first + j] for j in range(3))]
        for first in (0, 3)
    )
    w = [-p * s - q * t for s, t in zip(x, y, strict=True)]
    return total_sums([*x, *y, *w]).reshape(3, 4)


def total_sums(values):
    """The sums [n] of n planes [runs, LANES]. First of eight runs each, by the kernel that makes the planes: a
    reduction would read them from memory."""
    pieces = math.gcd(values[0].shape[0], 8)
    return jnp.sum(jnp.stack([sum(jnp.split(t, pieces)) for t in values]), axis=(1, 2))
