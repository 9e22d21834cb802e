"""Faces sorted into size classes without sorting.

Every face gets a class: 0 = nothing to draw (culled, off the image, without area, or, if small, without a pixel centre
in it), k = its pixel centres fit the window WINDOWS[k - 1], MEDIUM = larger, LARGE = too long for 32 bits, or cut by
the near plane.
Faces of a class are then *listed*, in ascending order, by bit words and counts of their bits: several times faster
than a sort, without a capacity that could overflow.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.project import BEHIND, SUB, double_area, faces_viewer, pixel_box, three
from shapeenh.buffers.windows import edge_functions
from shapeenh.buffers.xla import apart, take

WINDOWS = ((2, 2), (4, 4), (8, 8))  # rows, columns
MEDIUM = len(WINDOWS) + 1
LARGE = MEDIUM + 1
LANES = 64  # bit k of word LANES * j + lane is face 32 * LANES * j + LANES * k + lane: neighbours stay neighbours
BLOCK = 16 * 32 * LANES  # faces per step: what is computed on the way stays in cache
LONG = 1 << 14  # beyond this extent (64 px) int32 areas could overflow: decided later, in 64 bits


def touches(box, cells, side, height, width):
    """Whether pixel boxes x0, x1, y0, y1 [F] meet a cell, of side x side pixels, that is wanted. Cells are given as
    their summed-area table [rows + 1, columns + 1], so that four reads count those in a rectangle."""
    columns = cells.shape[1]

    def cell(at, size):
        return lax.div(jnp.clip(at, 0, size - 1), np.int32(side))

    left, right = cell(box[0], width), cell(box[1], width) + 1
    top, bottom = cell(box[2], height) * columns, (cell(box[3], height) + 1) * columns
    table = cells.reshape(-1)
    inside = take(table, bottom + right) - take(table, bottom + left) - take(table, top + right)
    return inside + take(table, top + left) > 0


def covers_pixel(x, y):
    """Whether a face with corners x, y, three [n] each, covers one of the first 2 x 2 pixel centres."""
    a, b, c = edge_functions(x, y)
    right, below, both = ([c[k] + step[k] for k in range(3)] for step in (a, b, [a[k] + b[k] for k in range(3)]))
    inside = [three(jnp.minimum, e) for e in (c, right, below, both)]
    return functools.reduce(jnp.maximum, inside) >= 0


def classify(x, y, height, width, cull, cells=None, side=1):
    """Class [F] uint8 of faces with snapped corners x, y [3, F]; with `cells`, only of those that touch one."""
    x0, x1, y0, y1 = box = pixel_box(x, y, height, width)
    columns, rows = x1 - x0 + 1, y1 - y0 + 1
    kind = jnp.full(columns.shape, MEDIUM, jnp.int32)
    for k in reversed(range(len(WINDOWS))):
        kind = jnp.where((rows <= WINDOWS[k][0]) & (columns <= WINDOWS[k][1]), k + 1, kind)
    low_x, high_x = three(jnp.minimum, x), three(jnp.maximum, x)
    extent = jnp.maximum(high_x - low_x, three(jnp.maximum, y) - three(jnp.minimum, y))
    drawn = jnp.where(faces_viewer(double_area(x, y), cull), kind, 0)
    kind = jnp.where(extent >= LONG, LARGE, drawn)
    kind = jnp.where((columns > 0) & (rows > 0), kind, 0)
    kind = jnp.where((kind == 1) & ~covers_pixel([t - (x0 << SUB) for t in x], [t - (y0 << SUB) for t in y]), 0, kind)
    if cells is not None:
        kind = jnp.where(touches(box, cells, side, height, width), kind, 0)
    cut = jnp.where(low_x == BEHIND, 0, LARGE)
    return jnp.where(high_x == BEHIND, cut, kind).astype(jnp.uint8)


def class_words(kind):
    """Bit words [LARGE, n] uint32 of the classes 1..LARGE, from kind [n * 32]."""
    blocks = kind.reshape(-1, 32, LANES)
    classes = np.arange(1, LARGE + 1, dtype=np.uint8)[:, None, None]
    words = jnp.zeros((LARGE, blocks.shape[0], LANES), jnp.uint32)
    for k in range(32):
        words = words | jnp.where(blocks[None, :, k] == classes, jnp.uint32(1 << k), jnp.uint32(0))
    return words.reshape(LARGE, -1)


def bin_faces(always, faces, corners, height, width, cull, cells=None, side=1):
    """Bit words [LARGE, n] and the inclusive counts of their bits, of faces [F, 3] and corners [3, V].

    The last block is moved back so that it ends with the last face; what it shares with the one before counts there.
    """
    count, vertices = faces.shape[0], corners.shape[1]
    size, blocks = block_size(count)
    flat = corners.reshape(-1)
    if blocks == 1:
        faces = jnp.pad(faces, ((0, size - count), (0, 0)))

    def step(i, words):
        start = block_start(i, count)

        def fetch(faces):
            index = lax.dynamic_slice(faces, (start, jnp.int32(0)), (size, 3)).T
            return take(flat, index[None] + (np.arange(2, dtype=np.int32) * vertices)[:, None, None])

        xy = apart(always, fetch, faces)

        def kinds(xy):
            face = start + lax.iota(jnp.int32, size)
            new = (face >= i * size) & (face < count)
            return jnp.where(new, classify(xy[0], xy[1], height, width, cull, cells, side), jnp.uint8(0))

        new = apart(always, class_words, apart(always, kinds, xy))
        return lax.dynamic_update_slice(words, new, (jnp.int32(0), i * (size // 32)))

    words = jnp.zeros((LARGE, blocks * size // 32), jnp.uint32)
    words = lax.fori_loop(jnp.int32(0), jnp.int32(blocks), step, words)
    return words, jnp.cumsum(lax.population_count(words).astype(jnp.int32), axis=1, dtype=jnp.int32)


def block_size(count):
    """Faces per block, and blocks."""
    blocks = -(-count // BLOCK)
    return (BLOCK if blocks > 1 else -(-count // (32 * LANES)) * 32 * LANES), blocks


def block_start(block, count):
    """The first face of a block."""
    size, blocks = block_size(count)
    return jnp.minimum(block * size, count - size) if blocks > 1 else block * 0


def list_faces(always, words, ends, count, room):
    """The faces of all classes but 0, [count + room]: class after class, ascending in each; and where each begins.

    Block by block: a face's place is the number of faces of its class up to it, its bits counted in the word.
    """
    size, blocks = block_size(count)
    totals = ends[:, -1]
    begins = jnp.cumsum(totals, dtype=jnp.int32) - totals
    bit = np.arange(32, dtype=np.uint32)[None, :, None]
    before = (np.uint32(1) << bit) - np.uint32(1)

    def places(words, ends):
        words, ends = (t.reshape(LARGE, -1, 1, LANES) for t in (words, ends))
        word, end = jnp.zeros_like(words[0]), jnp.zeros_like(ends[0])  # those of the face's class
        for k in range(LARGE):
            of_class = (words[k] >> bit) & 1 > 0
            word, end = jnp.where(of_class, words[k], word), jnp.where(of_class, ends[k], end)
        later = lax.population_count(word & ~before).astype(jnp.int32)  # this face and those after it
        return jnp.where(word > 0, end - later, count + room - 1)

    def step(i, faces):
        # sliced out here: LLVM does not vectorise what reads from a place that is known at run time only
        of_block = [lax.dynamic_slice(t, (jnp.int32(0), i * (size // 32)), (LARGE, size // 32)) for t in (words, ends)]
        place = apart(always, places, *of_block).reshape(-1)
        face = block_start(i, count) + lax.iota(jnp.int32, size)
        return faces.at[place].set(face, mode="promise_in_bounds", wrap_negative_indices=False)

    ends = ends + begins[:, None]
    faces = lax.fori_loop(jnp.int32(0), jnp.int32(blocks), step, jnp.zeros((count + room,), jnp.int32))
    return faces, begins


def corner_indices(faces, face):
    """The vertex indices [3, n] of faces [n]; `faces` is flat."""
    return take(faces, face[None] * 3 + np.arange(3, dtype=np.int32)[:, None])


def ascending(index):
    """The same corners [3, n] in ascending order.

    A canonical order makes everything computed from it independent of how the face lists its corners: two copies of a
    face, one of them turned over, get the same depth to the bit, and the lowest index wins.
    """
    a, b, c = index
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    return jnp.stack([jnp.minimum(low, c), jnp.maximum(low, jnp.minimum(high, c)), jnp.maximum(high, c)])


def ascends(index):
    """Whether the ascending order of corners [3, n] is a rotation of their own."""
    a, b, c = index
    return ((a < b) & (b < c)) | ((b < c) & (c < a)) | ((c < a) & (a < b))
