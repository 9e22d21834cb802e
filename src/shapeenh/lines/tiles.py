"""Work only where something is: tiles that cover the flagged pixels of an image, each read with a margin around it.

Stencils follow one another within a tile while it is in the cache. The sizes of tiles are compiled in, their places and
their number are not: the cost follows the covered pixels, and nothing recompiles when they move. Imports `fusion` only.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.fusion import unknown_truth

_TILE = (96, 128)  # with a margin of 16 its planes take 80 KiB each
_MARGINS = (0, 8, 12, 16, 24, 32, 40, 64, 96, 144)
_WORTH = 1.25  # from this many times the image's pixels on, margins included, tiles cost more than the image


def margin_for(reach: int) -> int | None:
    """A margin of at least `reach` pixels, one of few, since it is compiled in; None: too wide for tiles."""
    return next((m for m in _MARGINS if m >= reach), None)


def _tile(margin: int) -> np.ndarray:
    """[2], the size of tiles; those with wide margins are larger."""
    return np.asarray(_TILE) * (1 if margin <= 40 else 2 if margin <= 64 else 4)


def list_tiles(flags, margin: int | None, *, around: int = 0):
    """(corners [n, 2] int32, how many [] int32) of tiles that hold every pixel within `around` of a flagged one.

    flags: [H, W] bool, concrete; or None for all. None where tiles would not pay: then the whole image is to be taken.
    """
    if flags is None or margin is None:
        return None
    flags = np.asarray(flags)
    size, tile = flags.shape, _tile(margin)
    if any(size < tile + 2 * margin):
        return None
    found = []
    for row in _starts(_wider(flags.any(axis=1), around), tile[0]):
        band = flags[max(row - around, 0) : row + tile[0] + around]
        found += [(row, col) for col in _starts(_wider(band.any(axis=0), around), tile[1])]
    if len(found) * np.prod(tile + 2 * margin) > _WORTH * flags.size:
        return None
    most = np.prod(-(-np.asarray(size) // tile))
    corners = np.zeros((most, 2), np.int32)  # one length per image: nothing recompiles
    corners[: len(found)] = np.reshape(found, (-1, 2))
    return corners, np.int32(len(found))


def _wider(line: np.ndarray, by: int) -> np.ndarray:
    """The flags of a line, and `by` places on either side of each."""
    total = np.cumsum(np.pad(line, (by + 1, by)))
    return total[2 * by + 1 :] > total[: -2 * by - 1]


def _starts(line: np.ndarray, length: int) -> list[int]:
    """Where pieces of this length begin that hold all flags of a line: each at the first flag that none holds yet."""
    found, places = [], np.flatnonzero(line)
    while places.size:
        start = min(int(places[0]), line.size - length)
        found.append(start)
        places = places[np.searchsorted(places, start + length) :]
    return found


def over_tiles(function, images, tiles, background, *, margin: int, rim=((0, 0), (0, 0))):
    """`function(images)` in the tiles, and `background`, numbers or images, elsewhere and in a rim around the image.

    function: a tree of images [h, w, ...] to a tuple of such, or of such with one more pixel all around, whose values
        depend on those up to `margin` px away and on whether the image ends there: windows keep within the image, so
        that its border stays a border.
    rim: pixels above and below, and left and right of the image.
    """
    (corners, count), tile = tiles, _tile(margin)
    shape = np.asarray(jax.tree.leaves(images)[0].shape[:2])
    size = tile + 2 * margin

    def begin(start, image):
        return *start, *(jnp.int32(0),) * (image.ndim - 2)

    def cut(image, start, size):
        return lax.dynamic_slice(image, begin(start, image), (*map(int, size), *image.shape[2:]))

    def one(k, out):
        corner = [corners[k, i] for i in (0, 1)]
        start = [jnp.clip(corner[i] - margin, 0, int(shape[i] - size[i])) for i in (0, 1)]
        inner = [corner[i] - start[i] for i in (0, 1)]
        place = [corner[i] + rim[i][0] for i in (0, 1)]
        found = function(jax.tree.map(lambda image: cut(image, start, size), images))
        return tuple(
            lax.dynamic_update_slice(whole, cut(part, inner, part.shape[:2] - size + tile), begin(place, part))
            for whole, part in zip(out, found, strict=True)
        )

    part = jax.tree.map(lambda image: jax.ShapeDtypeStruct((*size, *image.shape[2:]), image.dtype), images)
    shapes = jax.eval_shape(function, part)
    out = tuple(
        jnp.full((*(shape + np.sum(rim, axis=1) + s.shape[:2] - size), *s.shape[2:]), b, s.dtype)
        for s, b in zip(shapes, different(background, count), strict=True)
    )
    return lax.fori_loop(0, count, one, out)


def different(numbers, *arrays) -> list:
    """The same numbers, but the compiler takes them for different ones: of planes that are filled alike it makes one,
    and copies it, which takes three times as long as to fill another one.

    arrays: one of them at least is not a constant of the program.
    """
    always = unknown_truth(*arrays)
    return [b if isinstance(b, bool) or np.ndim(b) else jnp.where(always, b, b + 1 + k) for k, b in enumerate(numbers)]
