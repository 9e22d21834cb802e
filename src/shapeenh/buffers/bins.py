"""Faces sorted into size classes without sorting.

One pass gives every face a class: 0 = nothing to draw (culled, off the image, without area, or between pixel centres),
k = its pixel centres fit the window WINDOWS[k - 1], len(WINDOWS) + 1 = large, or cut by the near plane. The faces of a
class are then *found*, in ascending order and as they are needed: bit words, prefix counts of their population, and a
bisection for the n-th bit. That is several times faster than a sort or a compaction, has no capacity, and cannot
overflow.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from shapeenh.buffers.project import BEHIND, double_area, faces_viewer, pixel_box, three
from shapeenh.buffers.xla import lower_bound, take

WINDOWS = ((2, 2), (4, 4), (8, 8))  # rows, columns
LANES = 64  # bit k of word (block, lane) is face block * 32 * LANES + k * LANES + lane: neighbours stay neighbours
LONG = 1 << 14  # beyond this extent (64 px) int32 areas could overflow: decided later, in 64 bits


def classify(x, y, height, width, cull):
    """Class [F] uint8 of faces with snapped corners x, y (three planes [F] each)."""
    x0, x1, y0, y1 = pixel_box(x, y, height, width)
    columns, rows = x1 - x0 + 1, y1 - y0 + 1
    large = len(WINDOWS) + 1
    kind = jnp.full(columns.shape, large, jnp.int32)
    for k in reversed(range(len(WINDOWS))):
        kind = jnp.where((rows <= WINDOWS[k][0]) & (columns <= WINDOWS[k][1]), k + 1, kind)
    low_x, high_x = three(jnp.minimum, x), three(jnp.maximum, x)
    extent = jnp.maximum(high_x - low_x, three(jnp.maximum, y) - three(jnp.minimum, y))
    drawn = jnp.where(faces_viewer(double_area(x, y), cull), kind, 0)
    kind = jnp.where(extent >= LONG, large, drawn)
    kind = jnp.where((columns > 0) & (rows > 0), kind, 0)
    cut = jnp.where(low_x == BEHIND, 0, large)
    return jnp.where(high_x == BEHIND, cut, kind).astype(jnp.uint8)


def class_words(kind, classes):
    """Bit words [classes, n] uint32 of the classes 1..classes, and the inclusive counts of their bits [classes, n]."""
    n = -(-kind.shape[0] // (32 * LANES)) * 32 * LANES
    blocks = jnp.pad(kind, (0, n - kind.shape[0])).reshape(-1, 32, LANES)
    words = []
    for c in range(1, classes + 1):
        word = jnp.zeros((blocks.shape[0], LANES), jnp.uint32)
        for k in range(32):
            word = word | jnp.where(blocks[:, k] == c, jnp.uint32(1 << k), jnp.uint32(0))
        words.append(word.reshape(-1))
    return jnp.stack(words)


def bit_counts(words):
    return jnp.cumsum(lax.population_count(words).astype(jnp.int32), axis=1)


def select(words, ends, rank):
    """Index of the face that is number `rank` of its class: the word by bisection over the counts, the bit by
    bisection over population counts."""
    at = lower_bound(ends, rank)
    word = take(words, at)
    k = rank - (take(ends, at) - lax.population_count(word).astype(jnp.int32))
    bit = jnp.zeros(rank.shape, jnp.int32)
    for half in (16, 8, 4, 2, 1):
        low = word & jnp.uint32((1 << half) - 1)
        count = lax.population_count(low).astype(jnp.int32)
        up = k >= count
        k = jnp.where(up, k - count, k)
        bit = jnp.where(up, bit + half, bit)
        word = jnp.where(up, word >> half, low)
    return (at // LANES) * (32 * LANES) + bit * LANES + at % LANES


def corner_indices(faces, face):
    """The three vertex indices of each face in ascending order.

    A canonical order makes everything computed from it independent of how the face lists its corners: two copies of a
    face, one of them turned over, get the same depth to the bit, and the lowest index wins.
    """
    a, b, c = (take(plane, face) for plane in faces)
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    return jnp.minimum(low, c), jnp.maximum(low, jnp.minimum(high, c)), jnp.maximum(high, c)


def is_even(faces, face):
    """Whether the ascending order is a rotation of the face's own, so that it keeps the sign of the area."""
    a, b, c = (take(plane, face) for plane in faces)
    return ((a < b) & (b < c)) | ((b < c) & (c < a)) | ((c < a) & (a < b))
