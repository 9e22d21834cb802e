"""Work only where an object is: the part of an image that holds its mask, of one of a few sizes, and back.

Positions are arguments of compiled code, sizes are compiled in: hence few of them. Imports nothing of ours.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

_LEAST_PIXELS = 1 << 17  # smaller images are not worth another compilation
_WORTH = 0.8  # nor are parts larger than this
_SIXTEENTHS = (4, 6, 8, 10, 11, 12, 14, 15, 16)  # 15 holds what `frame_mesh` frames, with its margin
_GRID = 4  # positions are multiples: the blocks of the fast diffusion stay where they are
_ROUNDING = 8  # of what is left out of a side, downwards; a multiple of the grid


def covering_part(mask) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """((first row, first column), (rows, columns)) that hold all of a concrete mask; None: the whole image."""
    mask = np.asarray(mask)
    if mask.size < _LEAST_PIXELS:
        return None
    rows, columns = _span(mask.any(axis=1)), _span(mask.any(axis=0))
    if rows is None or columns is None:
        return None
    size = rows[1], columns[1]
    return ((rows[0], columns[0]), size) if size[0] * size[1] <= _WORTH * mask.size else None


def _span(used) -> tuple[int, int] | None:
    """(first, length) along one axis."""
    places = np.flatnonzero(used)
    if not places.size:
        return None
    for part in _SIXTEENTHS:
        outside = len(used) * (16 - part) // 16 // _ROUNDING * _ROUNDING
        length = len(used) - outside
        first = min(places[0] // _GRID * _GRID, outside)
        if first + length > places[-1]:
            return int(first), length
    raise AssertionError("the whole always fits")


def crop(tree, corner, size):
    """That part of every `[H, W, ...]` array."""
    return jax.tree.map(lambda a: lax.dynamic_slice(a, (*corner, *(0,) * (a.ndim - 2)), (*size, *a.shape[2:])), tree)


def paste(tree, corner, shape):
    """Inverse of `crop`, 0 around it."""

    def one(part):
        whole = jnp.zeros((*shape, *part.shape[2:]), part.dtype)
        return lax.dynamic_update_slice(whole, part, (*corner, *(0,) * (part.ndim - 2)))

    return jax.tree.map(one, tree)
