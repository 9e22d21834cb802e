"""From face ids to values: perspective-correct interpolation and its reverse mode, written by hand (SPEC 11).

Visibility is a constant here; the weights are those of `weights`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.runs import (
    GROUP,
    LANES,
    add_rows,
    covered_runs,
    read_runs,
    run_start,
    table_rows,
    write_runs,
)
from shapeenh.buffers.weights import matrix_sums, pixel_rows, point_cotangents, weigh, weight_cotangents
from shapeenh.buffers.xla import take
from shapeenh.fusion import stored, unknown_truth

# ------------------------------------------------------------------------------------------- one group of runs


def corners(always, tables, faces, ids, start):
    """Covered [runs, LANES], corner indices [runs, 3, LANES], and of each table [runs, 3, columns, LANES]."""
    face = stored(always, read_runs, ids, start)
    corner = np.arange(3, dtype=np.int32)[None, :, None]
    index = stored(always, lambda faces, face: take(faces, (jnp.maximum(face, 0) * 3)[:, None] + corner), faces, face)
    rows = [stored(always, lambda flat, index, k=k: table_rows((flat, k), index), flat, index) for flat, k in tables]
    return face >= 0, index, rows


def blend(b, rows):
    """A table's values [runs, columns, LANES]; b [runs, 3 or more, LANES]."""
    return sum(b[:, j, None] * rows[:, j] for j in range(3))


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
    lane = jax.ShapeDtypeStruct((1, 4, LANES), dtype)
    shapes = [jax.ShapeDtypeStruct((1, 3, k, LANES), dtype) for _, k in packed]
    counts = [len(field) for field in jax.eval_shape(functools.partial(finished, finish), view, lane, shapes)]
    # run-time zeros, one each: equal constants would be one broadcast and a copy per field. Not of the ids: what those
    # were made of would be held until here, and could not lend its memory to the fields
    zeros = [jnp.where(total < -1 - k, dtype.type(1), dtype.type(0)) for k in range(len(counts))]
    fields = [jnp.broadcast_to(zero, (size * count,)) for zero, count in zip(zeros, counts, strict=True)]

    def step(state):
        i, fields = state
        start = run_start(lax.dynamic_slice(runs, (i * group,), (group,)), size)
        covered, _, rows = corners(always, packed, flat_faces, flat, start)
        _, _, w = weigh(stage, m, start, rows[0], height, width)

        def write(values, *args):
            # channel-last, as it will stay: interleaving whole images later would cost more than computing them
            return stage(
                lambda covered, *args: interleave([jnp.where(covered, t, 0) for t in values(*args)]), covered, *args
            )

        new = finish.values(stage, write, view, w, [stage(blend, w, t) for t in rows], rows)
        writes = zip(fields, new, counts, strict=True)
        return i + 1, [write_runs(t, start * count, u) for t, u, count in writes]

    fields = lax.while_loop(lambda state: state[0] * group < total, step, (jnp.int32(0), fields))[1]
    used = height * width
    return [t[: used * n].reshape((height, width, n)) for t, n in zip(fields, counts, strict=True)]


def finished(finish, view, w, rows):
    """What `finish` makes, without stages."""
    return finish.values(unstaged, unstaged, view, w, [blend(w, t) for t in rows], rows)


def unstaged(function, *args):
    return function(*args)


def interleave(planes):
    """[runs, LANES * planes] of planes [runs, LANES]."""
    return jnp.stack(planes, -1).reshape(planes[0].shape[0], -1)


# ------------------------------------------------------------------------------------------- reverse


def weight_sums(gw, gt, rows):
    """Cotangents [runs, 3, LANES] of the weights: their own and those that come through the tables."""
    through = [
        g[:, None, k] * t[:, :, k] for g, t in zip(gt, rows, strict=True) if g is not None for k in range(g.shape[1])
    ]
    return sum(through if gw is None else [gw, *through])


def corner_rows(ga, w, gt, m, start, *, height, width, columns):
    """Rows [runs, 3, columns, LANES] of what the corners' positions and attributes get, and zeros."""
    k = pixel_rows(m, start, height, width, ga.dtype)
    through = [[w[:, :3] * g[:, None, c] for c in range(g.shape[1])] if g is not None else None for g in gt]
    made = [ga[:, :3] * k[0][c][:, None] + ga[:, 3:] * k[1][c][:, None] for c in range(3)]
    if through[0] is not None:
        made = [s + t for s, t in zip(made, through[0], strict=True)]
    made += [t for table in through[1:] if table is not None for t in table]
    return jnp.stack(made + [jnp.zeros_like(made[0])] * (columns - len(made)), 2)


def backward(finish, position, tables, view, m, faces, ids, cotangents):
    """Recompute each group, and add one row of [position, attributes] per corner and pixel into the sums."""
    height, width = ids.shape
    dtype = position.dtype
    always = unknown_truth(position, view, m, faces, ids)
    stage = functools.partial(stored, always)
    flat, group, runs, total, packed, flat_faces = prepare(position, tables, faces, ids)
    size = flat.size
    flat_ct = [jnp.pad(t.reshape(-1), (0, size * t.shape[-1] - t.size)) for t in cotangents]
    columns = [k for _, k in packed]
    row_size = -(-sum(columns) // 8) * 8
    image = {"height": height, "width": width}

    def step(state):
        i, sums, g_view, g_m = state
        run = lax.dynamic_slice(runs, (i * group,), (group,))
        start = run_start(run, size)
        covered, index, rows = corners(always, packed, flat_faces, flat, start)
        lane = lax.iota(jnp.int32, LANES)[None]
        # every pixel once: the list repeats a run at its end, and the last run may overlap the one before
        covered = covered & (start[:, None] + lane >= (run * LANES)[:, None])
        covered = covered & (lax.iota(jnp.int32, group) + i * group < total)[:, None]
        a, e, w = weigh(stage, m, start, rows[0], height, width)

        def read(flat, start, covered):
            n = flat.size // size
            new = read_runs(flat, start * n, LANES * n).reshape(group, LANES, n)
            return jnp.stack([jnp.where(covered, new[..., k], 0) for k in range(n)], 1)

        ct = [stage(read, t, start, covered) for t in flat_ct]
        dv, gw, gt = finish.reverse(stage, view, w, [stage(blend, w, t) for t in rows], rows, ct)
        ge = stage(weight_cotangents, stage(weight_sums, gw, gt, rows), e)
        ga = stage(point_cotangents, ge, a)
        made = stage(functools.partial(corner_rows, **image, columns=row_size), ga, w, gt, m, start)
        sums = add_rows(sums, index, stage(lambda made: jnp.moveaxis(made, 2, 3), made))
        dm = stage(functools.partial(matrix_sums, **image), ga, rows[0], start)
        return i + 1, sums, g_view + dv, g_m + dm

    zeros = [(position.shape[0], row_size), (4, 4), (3, 4)]
    state = (jnp.int32(0), *(jnp.zeros(shape, dtype) for shape in zeros))
    _, sums, g_view, g_m = lax.while_loop(lambda state: state[0] * group < total, step, state)
    g_matrix = jnp.insert(g_m, 2, 0, axis=0)
    ends = np.cumsum([0, *columns])
    split = [sums[:, ends[k] : ends[k + 1]] for k in range(len(columns))]
    return split[0], split[1:], g_view, g_matrix


# ----------------------------------------------------------------------------------------- the differentiable function


class Finish(NamedTuple):
    """What fields are made of interpolated values, and its reverse mode.

    values(stage, write, view, w, blended, rows) -> per field what `write` returned. w [runs, 4, LANES] are the weights
    and 1/s, whose sign is positive for a front face, blended [runs, columns, LANES] the position and each table, rows
    [runs, 3, columns, LANES] their corners. stage(function, *args) calls the function and stores the array that it
    returns; write(function, *args) does so for the last function of a field, which returns a list of planes
    [runs, LANES]. Slices are taken inside of these functions: an argument that is a slice would be copied.

    reverse(stage, view, w, blended, rows, cotangents [runs, columns, LANES]) -> cotangents of view, [runs, 3, LANES]
    of the weights, or None, and of each blended, or None. 1/s and rows are constants.
    """

    values: Callable
    reverse: Callable


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def resolve(finish: Finish, position, tables, view, m, faces, ids):
    """Fields [H, W, C] that `finish` makes of interpolated positions and tables; 0 off the mask."""
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
