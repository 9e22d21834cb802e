"""Reverse mode where nearly all pixels have the derivative 0: for the others alone.

The weight of a silhouette saturates: a few hundred pixels of an image have a derivative, and which ones is known at run
time. Steps of a diffusion keep the jumps at a few links; stencils are pulled back in the tiles around a few pixels.
Imports nothing of ours.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero


def steep(weight):
    """Where a weight in [0, 1] that comes from a smoothstep has a derivative: at 0 and at 1 it has none."""
    return (weight > 0) & (weight < 1)


def dense(cotangent):
    """A cotangent as an array, also where JAX knows it to be 0."""
    return jnp.zeros(cotangent.shape, cotangent.dtype) if isinstance(cotangent, SymbolicZero) else cotangent


# ------------------------------------------------------------------------------------------- a few links


class FewLinks(NamedTuple):
    """Of a few links along x and along y: their values, and where they begin, [N] pixels counted row by row."""

    values: tuple
    places: tuple


def places_of(flags, most: int):
    """Where the first `most` flagged links along x and along y begin, filled up with the last pixel, where none does.

    flags: for either direction [H, W], where links begin; the last column of the ones and the last row of the others
        are not set.
    """
    return _listed(flags[0].reshape(-1), most), _listed(flags[1].reshape(-1), most)


_RUN = 8


def _listed(flags, most: int):
    """The first `most` true places of [n] flags, filled up with n - 1.

    Runs that hold one are listed first, then what is in them: several times as fast as one list.
    """
    n = flags.size
    runs = jnp.pad(flags, (0, -n % _RUN)).reshape(-1, _RUN)
    (hit,) = jnp.nonzero(jnp.any(runs, axis=1), size=most, fill_value=runs.shape[0])
    within = runs.at[hit].get(mode="fill", fill_value=False).reshape(-1)
    (place,) = jnp.nonzero(within, size=most, fill_value=within.size)
    found = place < within.size
    place = jnp.where(found, hit[jnp.minimum(place // _RUN, most - 1)] * _RUN + place % _RUN, n - 1)
    return place.astype(jnp.int32)


def at(planes, place):
    """Planes [..., H, W] at some pixels, [..., N]."""
    return planes.reshape(*planes.shape[:-2], -1).at[..., place].get(mode="promise_in_bounds")


def at_ends(planes, places):
    """Planes [..., H, W] where a few links begin and where they end, for either direction; the last pixel is both."""
    height, width = planes.shape[-2:]
    last, ends = height * width - 1, zip(places, (1, width), strict=True)
    return tuple((at(planes, begin), at(planes, jnp.minimum(begin + by, last))) for begin, by in ends)


def jumps_at(planes, places):
    """The differences of planes [C, H, W] across a few links, [C, N]; 0 at the last pixel."""
    return tuple(end - begin for begin, end in at_ends(planes, places))


def put_back(few, border_x, border_y):
    """The borders with the derivative that a few of them have."""
    if few is None:
        return border_x, border_y

    def put(border, value, place):
        return border.reshape(-1).at[place].add(value - lax.stop_gradient(value)).reshape(border.shape)

    return tuple(map(put, (border_x, border_y), *few))


# ------------------------------------------------------------------------------------------- tiles

_TILE = 16  # px; smaller ones hold fewer pixels without a derivative, larger ones have less margin
_BATCH = 16  # tiles at a time, enough for a kernel to be worth its call
_CELL = 4  # px, the grain in which the surroundings of a pixel are found


def pull_near(flags, reach: int, function, arrays, fixed, cotangents):
    """What `cotangents` of `function(*arrays, *fixed)` pull back to `arrays`, where it is wanted: near the flags.

    flags: [H, W] bool; arrays, fixed: tuples of images [H, W]; function: to a tuple of such, whose values depend on
        pixels up to `reach` away and on whether the image ends there; cotangents: a tuple of images.
    *Static*: reach, at most 4 px.
    Returns a tuple of [H, W], like `arrays`: right up to `reach` px from a flag, further away right or 0. The time
    follows the number of tiles near a flag.
    """

    def pull(arrays, fixed, cotangents):
        return jax.vjp(lambda *arrays: function(*arrays, *fixed), *arrays)[1](cotangents)

    shape, side = flags.shape, _TILE + 4 * reach
    if min(shape) < side:
        return pull(arrays, fixed, cotangents)
    corners, count = _tiles_near(flags)

    def batch(i, out):
        corner = lax.dynamic_slice_in_dim(corners, i * _BATCH, _BATCH)
        start = jnp.clip(corner - 2 * reach, 0, jnp.asarray([shape]) - side)
        cut = jax.vmap(lambda image, start: lax.dynamic_slice(image, start, (side, side)), (None, 0))
        parts = jax.tree.map(lambda image: cut(image, start), (arrays, fixed, cotangents))
        found = jax.vmap(pull)(*parts)

        def write(k, out):
            inner = corner[k] - start[k]
            tiles = (lax.dynamic_slice(part[k], inner, (_TILE, _TILE)) for part in found)
            return tuple(lax.dynamic_update_slice(a, tile, corner[k]) for a, tile in zip(out, tiles, strict=True))

        return lax.fori_loop(0, _BATCH, write, out)

    out = tuple(jnp.zeros_like(array) for array in arrays)
    return lax.fori_loop(0, (count + _BATCH - 1) // _BATCH, batch, out)


def _tiles_near(flags):
    """(the corners [n, 2] of the tiles with a flag in them or up to `_CELL` px away, then others, their number)."""
    height, width = flags.shape
    rows, columns = -(-height // _TILE), -(-width // _TILE)
    cells = jnp.pad(flags, ((0, rows * _TILE - height), (0, columns * _TILE - width)))
    cells = jnp.any(cells.reshape(-1, _CELL, cells.shape[1]), axis=1)
    cells = jnp.any(cells.reshape(cells.shape[0], -1, _CELL), axis=2)
    around = jnp.pad(cells, 1)
    around = around[:-2] | around[1:-1] | around[2:]
    around = around[:, :-2] | around[:, 1:-1] | around[:, 2:]
    per = _TILE // _CELL
    hit = jnp.any(around.reshape(rows, per, columns, per), axis=(1, 3)).reshape(-1)
    room = -(-hit.size // _BATCH) * _BATCH
    (index,) = jnp.nonzero(hit, size=room, fill_value=0)
    corners = jnp.stack([index // columns, index % columns], axis=1) * _TILE
    # the last tiles reach back over those before
    return jnp.minimum(corners, jnp.asarray([[height - _TILE, width - _TILE]])), jnp.sum(hit)
