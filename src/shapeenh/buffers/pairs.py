"""Lists of (disc, tile) pairs, made as they are needed: every loop takes as many steps as there are pairs.

Tiles are TILE_H x TILE_W pixels; buffers that discs are drawn into are `[tiles, channels, LANES]`, so that a disc meets
a tile in one row of memory.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.xla import take

TILE_H, TILE_W = 4, 4
LANES = TILE_H * TILE_W
STEP = 2048  # pairs at a time


def tile_boxes(x0, x1, y0, y1):
    """First tile (column, row) and numbers of tiles of pixel boxes [n]; none where a box is empty."""
    empty = (x1 < x0) | (y1 < y0)
    column, row = x0 // TILE_W, y0 // TILE_H
    columns = jnp.where(empty, 0, x1 // TILE_W - column + 1)
    rows = jnp.where(empty, 0, y1 // TILE_H - row + 1)
    return jnp.stack([column, row, columns, rows], axis=1)


def walk(boxes, work, state):
    """`state = work(state, disc [STEP], tile column, tile row, valid)` over all pairs, in the order of the discs.

    Each step looks at the next STEP discs and takes the next STEP pairs; counts are clipped to what a step can take,
    so that no sum can overflow, however large the discs are.
    """
    count = boxes.shape[0]
    padded = jnp.pad(boxes, ((0, STEP), (0, 0)))
    lane = np.arange(STEP, dtype=np.int32)

    def step(carry):
        first, done, state = carry  # the first disc that is not finished, and how many of its tiles are
        box = lax.dynamic_slice(padded, (first, jnp.int32(0)), (STEP, 4))
        tiles = box[:, 2] * box[:, 3] - jnp.where(lane == 0, done, 0)
        tiles = jnp.minimum(tiles, STEP + 1)
        ends = jnp.cumsum(tiles, dtype=jnp.int32)
        # The disc of a lane: how many discs end at or before it.
        marks = jnp.zeros(STEP + 2, jnp.int32).at[jnp.minimum(ends, STEP + 1)].add(1)
        local = jnp.cumsum(marks, dtype=jnp.int32)
        finished = local[STEP]
        local = jnp.minimum(local[:STEP], STEP - 1)
        number = lane - (take(ends, local) - take(tiles, local)) + jnp.where(local == 0, done, 0)
        valid = lane < ends[-1]
        box = take(box, local)
        columns = jnp.maximum(box[:, 2], 1)
        column = jnp.where(valid, box[:, 0] + number % columns, 0)
        row = jnp.where(valid, box[:, 1] + number // columns, 0)
        disc = jnp.minimum(first + local, count - 1)
        state = work(state, disc, column, row, valid)
        # Of the disc that comes next some tiles may be done already.
        follower = jnp.minimum(finished, STEP - 1)
        begun = STEP - (take(ends, follower) - take(tiles, follower)) + jnp.where(follower == 0, done, 0)
        begun = jnp.where((finished < STEP) & (ends[-1] > STEP), begun, 0)
        return first + finished, begun, state

    more = lambda carry: carry[0] < count  # noqa: E731
    return lax.while_loop(more, step, (jnp.int32(0), jnp.int32(0), state))[2]


def lanes(column, row, dtype):
    """Pixel centres (x, y) [n, lanes] of tiles."""
    dx, dy = np.arange(LANES) % TILE_W + 0.5, np.arange(LANES) // TILE_W + 0.5
    x = (column * TILE_W).astype(dtype)[:, None] + dx.astype(dtype)[None]
    y = (row * TILE_H).astype(dtype)[:, None] + dy.astype(dtype)[None]
    return x, y


def pixel_offsets(height: int, width: int, dtype):
    """(x, y) of the pixel centres from the middle of their tiles, [H, W, 1]."""
    x = np.arange(width) % TILE_W + 0.5 - 0.5 * TILE_W
    y = np.arange(height) % TILE_H + 0.5 - 0.5 * TILE_H
    shape = (height, width, 1)
    return tuple(jnp.asarray(np.broadcast_to(a, shape), dtype) for a in (x[None, :, None], y[:, None, None]))


def tiling(height: int, width: int) -> tuple[int, int]:
    return -(-height // TILE_H), -(-width // TILE_W)


def to_tiles(image):
    """[H, W, C] to [tiles, C, lanes], padded with 0."""
    height, width, channels = image.shape
    rows, columns = tiling(height, width)
    image = jnp.pad(image, ((0, rows * TILE_H - height), (0, columns * TILE_W - width), (0, 0)))
    image = image.reshape(rows, TILE_H, columns, TILE_W, channels).transpose(0, 2, 4, 1, 3)
    return image.reshape(rows * columns, channels, LANES)


def from_tiles(tiles, height: int, width: int):
    """[tiles, C, lanes] to [H, W, C]."""
    rows, columns = tiling(height, width)
    image = tiles.reshape(rows, columns, -1, TILE_H, TILE_W).transpose(0, 3, 1, 4, 2)
    return image.reshape(rows * TILE_H, columns * TILE_W, -1)[:height, :width]
