"""Runs: the image as pieces of 64 pixels, and the list of those that hold a covered pixel.

Whatever is computed per covered pixel walks that list in groups, so that background costs nothing, the temporaries of
a group stay in cache, and the number of steps depends on the picture alone. A group is laid out (run, channel, lane):
XLA splits the first axis over the cores, LLVM vectorises the last one, and one kernel makes all channels.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.xla import take

LANES = 64
GROUP = 512  # runs per step


def prefix_count(flags):
    """Inclusive count of a bool vector; one triangular product per 64, several times faster than a long cumsum."""
    n = flags.shape[0]
    table = jnp.pad(flags.astype(jnp.float32), (0, -n % 64)).reshape(-1, 64)
    within = jnp.dot(table, np.triu(np.ones((64, 64), np.float32)), precision=lax.Precision.HIGHEST)
    whole = within[:, -1].astype(jnp.int32)
    return (within.astype(jnp.int32) + (jnp.cumsum(whole) - whole)[:, None]).reshape(-1)[:n]


def listed(flags, chunk):
    """Indices of the true flags [n], padded with n, and their number."""
    n = flags.shape[0]
    count = prefix_count(flags)
    room = jnp.full((n + chunk + 1,), n, jnp.int32)
    at = jnp.where(flags, count - 1, n + chunk)
    return room.at[at].set(lax.iota(jnp.int32, n), mode="promise_in_bounds").at[n + chunk].set(n), count[-1]


def covered_runs(flat, group):
    """The runs of flat [n] (int32, -1 = background) with a covered pixel, padded by repeating one, and their number."""
    whole = flat.size // LANES
    hit = jnp.max(flat[: whole * LANES].reshape(whole, LANES), axis=1) >= 0
    if flat.size % LANES:
        hit = jnp.append(hit, jnp.max(flat[whole * LANES :]) >= 0)
    n = hit.shape[0]
    count = prefix_count(hit)
    index = lax.iota(jnp.int32, n)
    last = jnp.max(jnp.where(hit, index, 0))
    runs = jnp.full((n + 1 + group,), last, jnp.int32)
    runs = runs.at[jnp.where(hit, count - 1, n + group)].set(index, mode="promise_in_bounds")
    return runs.at[n + group].set(last), count[-1]


def run_start(run, size):
    """First pixel of a run. The last, partial run of an image is moved back into it, over the end of the one before."""
    return jnp.minimum(run * LANES, size - LANES)


def read_runs(flat, start, width=LANES):
    """[runs, width] windows of flat [n]."""
    numbers = lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(), start_index_map=(0,))
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return lax.gather(flat, start[:, None], numbers, (width,), mode=mode)


def write_runs(flat, start, new):
    """flat [n] with the windows `new` [runs, width] written at `start`."""
    numbers = lax.ScatterDimensionNumbers(
        update_window_dims=(1,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
    )
    return lax.scatter(flat, start[:, None], new, numbers, mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def pixel_ndc(start, height, width, dtype):
    """Normalised device coordinates [runs, LANES] of the pixel centres, x right, y up."""
    lane = lax.iota(jnp.int32, LANES)[None]
    if width >= LANES:  # a run wraps at most once: divide per run, not per pixel
        row = start // width
        x = (start - row * width)[:, None] + lane
        wraps = x >= width
        x, y = jnp.where(wraps, x - width, x), jnp.where(wraps, row[:, None] + 1, row[:, None])
    else:
        pixel = start[:, None] + lane
        y = pixel // width
        x = pixel - y * width
    half = dtype.type(0.5)
    return (x.astype(dtype) + half) * dtype.type(2 / width) - 1, 1 - (y.astype(dtype) + half) * dtype.type(2 / height)


def table_rows(table, index):
    """[runs, 3, columns, LANES] of a flat table, for corner indices [runs, 3, LANES]."""
    flat, columns = table
    at = (index * columns)[:, :, None] + np.arange(columns, dtype=np.int32)[None, None, :, None]
    return take(flat, at)


def add_rows(sums, index, rows):
    """sums [V, R] plus rows [..., R] at index [...]; always in the same order, so the result is reproducible on CPU."""
    numbers = lax.ScatterDimensionNumbers(
        update_window_dims=(1,), inserted_window_dims=(0,), scatter_dims_to_operand_dims=(0,)
    )
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return lax.scatter_add(sums, index.reshape(-1, 1), rows.reshape(-1, rows.shape[-1]), numbers, mode=mode)
