"""From face ids to values: perspective-correct interpolation and its reverse mode, written by hand (SPEC 11).

Visibility is a constant here. For a pixel with centre (p, q) in normalised device coordinates and the corners' clip
coordinates (x_i, y_i, w_i), with a_i = (x_i - p w_i, y_i - q w_i), the perspective-correct barycentrics are

    b = e / s,   e = (a_1 x a_2, a_2 x a_0, a_0 x a_1),   s = e_0 + e_1 + e_2

(Olano and Greer 1997). No division by w_i: corners behind the eye do no harm; coordinates are relative to the pixel, so
that float32 does not cancel. One formula for perspective and orthographic cameras.

Snapping lets a pixel centre lie up to 1/360 px outside of the face that covers it. That is extrapolated (a plane stays
the plane it is) unless a weight falls below -1/64, which only happens on faces thinner than a fifth of a pixel: there
the weights are those of the nearest part of the face, so that no sliver throws sparks.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.runs import (
    GROUP,
    LANES,
    add_rows,
    covered_runs,
    pixel_ndc,
    read_runs,
    run_start,
    table_rows,
    write_runs,
)
from shapeenh.buffers.xla import take
from shapeenh.fusion import stored, unknown_truth

OUTSIDE = 1 / 64  # how far outside a weight may be before it is held at the face's edge

# ------------------------------------------------------------------------------------------- one group of runs


def corners(always, tables, faces, ids, start):
    """Covered [runs, LANES], corner indices [runs, 3, LANES], and of each table [runs, 3, columns, LANES]."""
    face = stored(always, read_runs, ids, start)
    corner = np.arange(3, dtype=np.int32)[None, :, None]
    index = stored(always, lambda faces, face: take(faces, (jnp.maximum(face, 0) * 3)[:, None] + corner), faces, face)
    rows = [stored(always, lambda flat, index, k=k: table_rows((flat, k), index), flat, index) for flat, k in tables]
    return face >= 0, index, rows


def pixel_rows(m, start, height, width, dtype):
    """clip x - p w and clip y - q w as functions of the world position: two rows of four, [runs, LANES] each."""
    p, q = pixel_ndc(start, height, width, dtype)
    return [[m[row, k] - t * m[3, k] for k in range(4)] for row, t in ((0, p), (1, q))]


def relative(m, start, position, height, width):
    """a_i [2][runs, 3, LANES] of positions [runs, 3, 3, LANES]."""
    rows = pixel_rows(m, start, height, width, position.dtype)
    return [sum(k[c][:, None] * position[:, :, c] for c in range(3)) + k[3][:, None] for k in rows]


def barycentrics(ax, ay):
    """Weights b, the unclamped ones, 1/s (0 where the face is degenerate to rounding) and 1/(sum of what was held)."""
    eps = jnp.finfo(ax.dtype).eps
    e = []
    noise = jnp.zeros((), ax.dtype)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        left, right = ax[:, j] * ay[:, k], ay[:, j] * ax[:, k]
        e.append(left - right)
        noise = noise + jnp.abs(left) + jnp.abs(right)
    s = e[0] + e[1] + e[2]
    flat = jnp.abs(s) <= 4 * eps * noise
    inverse = jnp.where(flat, 0, 1 / jnp.where(flat, 1, s))
    raw = [jnp.where(flat, ax.dtype.type(1 / 3), t * inverse) for t in e]
    thin = jnp.minimum(jnp.minimum(raw[0], raw[1]), raw[2]) < -OUTSIDE
    held = [jnp.where(thin, jnp.maximum(t, 0), t) for t in raw]
    total = jnp.where(thin, 1 / (held[0] + held[1] + held[2]), 1)
    return [t * total for t in held], raw, inverse, total


def blend(b, rows):
    """Interpolated [columns] planes [runs, LANES] of a table."""
    return sum(b[j][:, None] * rows[:, j] for j in range(3))


# ------------------------------------------------------------------------------------------- forward


def prepare(position, tables, faces, ids):
    flat = ids.reshape(-1)
    if flat.size < LANES:
        flat = jnp.pad(flat, (0, LANES - flat.size), constant_values=-1)
    group = min(GROUP, -(-flat.size // LANES))
    packed = [(t.reshape(-1), t.shape[1]) for t in (position, *tables)]
    return flat, group, *covered_runs(flat, group), packed, faces.reshape(-1)


def forward(finish, position, tables, view, m, faces, ids):
    height, width = ids.shape
    dtype = position.dtype
    always = unknown_truth(position, view, m, faces, ids)
    flat, group, runs, total, packed, flat_faces = prepare(position, tables, faces, ids)
    size = flat.size

    stage = functools.partial(stored, always)

    def values(view, b, rows, inverse):
        return finish(stage, view, b, [stage(blend, b, t) for t in rows], rows, inverse)

    lane = jax.ShapeDtypeStruct((1, LANES), dtype)
    shapes = jax.eval_shape(
        values, view, [lane] * 3, [jax.ShapeDtypeStruct((1, 3, k, LANES), dtype) for _, k in packed], lane
    )
    counts = [len(field) for field in shapes]
    # run-time zeros, one each: equal constants would be one broadcast and a copy per field
    zeros = [jnp.where(flat[0] < -2 - k, dtype.type(1), dtype.type(0)) for k in range(len(counts))]
    fields = [jnp.broadcast_to(zero, (size * count,)) for zero, count in zip(zeros, counts, strict=True)]

    def step(state):
        i, fields = state
        start = run_start(lax.dynamic_slice(runs, (i * group,), (group,)), size)
        covered, _, rows = corners(always, packed, flat_faces, flat, start)
        # each stage makes one array: of a list of results, every one would compute what they have in common
        a = stage(lambda m, start, x: jnp.concatenate(relative(m, start, x, height, width), 1), m, start, rows[0])

        def weights(a):
            b, _, inverse, _ = barycentrics(a[:, :3], a[:, 3:])
            return jnp.stack([*b, inverse], 1)

        packed_b = stage(weights, a)
        made = values(view, [packed_b[:, k] for k in range(3)], rows, packed_b[:, 3])

        def last(field, covered):
            # channel-last, as it will stay: interleaving whole images later would cost more than computing them
            return interleave([jnp.where(covered, t, 0) for t in field])

        new = [stage(last, field, covered) for field in made]
        writes = zip(fields, new, counts, strict=True)
        return i + 1, [write_runs(t, start * count, u) for t, u, count in writes]

    fields = lax.while_loop(lambda state: state[0] * group < total, step, (jnp.int32(0), fields))[1]
    used = height * width
    return [t[: used * n].reshape((height, width, n)) for t, n in zip(fields, counts, strict=True)]


def unstaged(function, *args):
    return function(*args)


def interleave(planes):
    """[runs, LANES * planes] of planes [runs, LANES]."""
    return jnp.stack(planes, -1).reshape(planes[0].shape[0], -1)


# ------------------------------------------------------------------------------------------- reverse


def weight_cotangents(gb, b, raw, inverse, total):
    """Cotangents of e, from those of the weights: back through the hold at the edge, then through e / s."""
    mean = sum(b[j] * gb[j] for j in range(3))
    held = total != 1
    g = [jnp.where(held & (raw[j] <= 0), 0, (gb[j] - mean) * total) for j in range(3)]
    mean = sum(raw[j] * g[j] for j in range(3))
    return [(g[j] - mean) * inverse for j in range(3)]


def backward(finish, position, tables, view, m, faces, ids, cotangents):
    """Recompute each group, and add one row of [position, attributes] per corner and pixel into the sums."""
    height, width = ids.shape
    dtype = position.dtype
    always = unknown_truth(position, view, m, faces, ids)
    flat, group, runs, total, packed, flat_faces = prepare(position, tables, faces, ids)
    size = flat.size
    counts = [t.shape[-1] for t in cotangents]
    flat_ct = [jnp.pad(t.reshape(-1), (0, size * n - t.size)) for t, n in zip(cotangents, counts, strict=True)]
    columns = [k for _, k in packed]
    used = sum(columns)
    row_size = -(-used // 8) * 8

    def step(state):
        i, sums, g_view, g_m = state
        run = lax.dynamic_slice(runs, (i * group,), (group,))
        start = run_start(run, size)
        covered, index, rows = corners(always, packed, flat_faces, flat, start)
        lane = lax.iota(jnp.int32, LANES)[None]
        # every pixel once: the list repeats a run at its end, and the last run may overlap the one before
        covered = covered & (start[:, None] + lane >= (run * LANES)[:, None])
        covered = covered & (lax.iota(jnp.int32, group) + i * group < total)[:, None]
        ax, ay = stored(always, lambda m, start, x: relative(m, start, x, height, width), m, start, rows[0])
        b, raw, inverse, held = stored(always, barycentrics, ax, ay)

        def finished(view, b, rows, inverse, covered, ct, start):
            g = []
            for t, n in zip(ct, counts, strict=True):
                new = read_runs(t, start * n, LANES * n).reshape(group, LANES, n)
                g.append([jnp.where(covered, new[..., k], 0) for k in range(n)])
            blended = [blend(b, t) for t in rows]
            _, pull = jax.vjp(
                lambda view, b, blended: finish(unstaged, view, b, blended, rows, inverse), view, b, blended
            )
            g_view, g_b, g_blended = pull(g)
            return g_view, g_b, g_blended

        dv, gb, gt = stored(always, finished, view, b, rows, inverse, covered, flat_ct, start)

        def edges(gb, gt, rows, b, raw, inverse, held):
            gb = [gb[j] + sum(jnp.sum(g * t[:, j], axis=1) for g, t in zip(gt, rows, strict=True)) for j in range(3)]
            return weight_cotangents(gb, b, raw, inverse, held)

        ge = stored(always, edges, gb, gt, rows, b, raw, inverse, held)

        def points(ge, ax, ay):
            u, v = (1, 2, 0), (2, 0, 1)
            gx = [ge[v[j]] * ay[:, u[j]] - ge[u[j]] * ay[:, v[j]] for j in range(3)]
            gy = [ge[u[j]] * ax[:, v[j]] - ge[v[j]] * ax[:, u[j]] for j in range(3)]
            return gx, gy

        gx, gy = stored(always, points, ge, ax, ay)

        def corner_rows(gx, gy, b, gt, m, start):
            kx, ky = pixel_rows(m, start, height, width, dtype)
            zero = jnp.zeros((group, LANES), dtype)
            out = []
            for j in range(3):
                moved = [b[j] * gt[0][:, k] + gx[j] * kx[k] + gy[j] * ky[k] for k in range(3)]
                other = [b[j] * g[:, k] for g in gt[1:] for k in range(g.shape[1])]
                out.append(jnp.stack(moved + other + [zero] * (row_size - used), 1))
            return out

        made = stored(always, corner_rows, gx, gy, b, gt, m, start)
        turned = stored(always, lambda made: [jnp.moveaxis(t, 1, 2) for t in made], made)
        for j in range(3):
            sums = add_rows(sums, index[:, j], turned[j])

        def camera(gx, gy, x, start):
            p, q = pixel_ndc(start, height, width, dtype)
            rows_x, rows_y = ([sum(g[j] * x[:, j, k] for j in range(3)) for k in range(3)] + [sum(g)] for g in (gx, gy))
            rows_w = [-p * s - q * t for s, t in zip(rows_x, rows_y, strict=True)]
            return [[jnp.sum(t, axis=0) for t in k] for k in (rows_x, rows_y, rows_w)]

        dm = stored(always, camera, gx, gy, rows[0], start)
        return i + 1, sums, g_view + dv, jax.tree.map(jnp.add, g_m, dm)

    zero = [[jnp.zeros((LANES,), dtype) for _ in range(4)] for _ in range(3)]
    state = (jnp.int32(0), jnp.zeros((position.shape[0], row_size), dtype), jnp.zeros_like(view), zero)
    _, sums, g_view, g_m = lax.while_loop(lambda state: state[0] * group < total, step, state)
    x_row, y_row, w_row = (jnp.stack([jnp.sum(t) for t in k]) for k in g_m)
    g_matrix = jnp.stack([x_row, y_row, jnp.zeros_like(x_row), w_row])
    ends = np.cumsum([0, *columns])
    split = [sums[:, ends[k] : ends[k + 1]] for k in range(len(columns))]
    return split[0], split[1:], g_view, g_matrix


# ----------------------------------------------------------------------------------------- the differentiable function


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def resolve(finish: Callable, position, tables, view, m, faces, ids):
    """Fields [H, W, C] that `finish` makes of interpolated positions and tables; 0 off the mask.

    finish(stage, view, b, blended, rows, inverse) -> per field a list of C planes [runs, LANES]: b the three weights,
    blended [runs, columns, LANES] of the position and each table, rows [runs, 3, columns, LANES] their corners
    (constants of the derivative), inverse 1/s, whose sign is positive for a front face. stage(function, *args) calls
    the function, and on the way forward stores what it returns.
    """
    return one_view(finish, position, tables, view, m, faces, ids)


def one_view(finish, *args):
    return jax.custom_batching.sequential_vmap(functools.partial(forward, finish))(*args)


def _resolve_fwd(finish, position, tables, view, m, faces, ids):
    return one_view(finish, position, tables, view, m, faces, ids), (position, tables, view, m, faces, ids)


def _resolve_bwd(finish, kept, cotangents):
    *_, faces, ids = kept
    run = jax.custom_batching.sequential_vmap(lambda *args: backward(finish, *args))
    none = [np.zeros(a.shape, jax.dtypes.float0) for a in (faces, ids)]
    return (*run(*kept, list(cotangents)), *none)


resolve.defvjp(_resolve_fwd, _resolve_bwd)
