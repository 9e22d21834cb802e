"""Reverse mode where nearly all pixels have the derivative 0: for the others alone.

The weight of a silhouette saturates: a few hundred pixels of an image have a derivative, and which ones is known at run
time. Steps of a diffusion keep the jumps at a few links; stencils are pulled back in the tiles around a few pixels.
Imports nothing of ours.
"""

from __future__ import annotations

from functools import reduce
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
#
# Tiles are cut out with a margin, `_BATCH` at a time, and laid side by side as one image: kernels run along its rows.

_TILE = 16  # px; smaller ones hold fewer pixels without a derivative, larger ones have less margin
_BATCH = 32  # tiles at a time, enough for a kernel to be worth its call


def spread(flags, reach: int):
    """[H, W] flags set in the square of pixels up to `reach` px away, too."""
    for axis in (0, 1):
        padded = jnp.pad(flags, [(reach, reach) if i == axis else (0, 0) for i in (0, 1)])
        parts = [lax.slice_in_dim(padded, i, i + flags.shape[axis], axis=axis) for i in range(2 * reach + 1)]
        flags = reduce(jnp.logical_or, parts)
    return flags


def pull_near(flags, reach: int, function, arrays, fixed, cotangents):
    """What `cotangents` of `function(*arrays, *fixed)` pull back to `arrays`, those of flagged pixels and some more.

    flags: [H, W] bool; arrays, fixed: tuples of images [H, W]; function: to a tuple of such, whose values depend on
        pixels up to `reach` away, and on what is outside of the image as if it were 0; cotangents: a tuple of images.
    *Static*: reach.
    Returns a tuple of [H, W], like `arrays`. The time follows the number of tiles with a flag.
    """

    def pull(arrays, fixed, cotangents):
        return jax.vjp(lambda *arrays: function(*arrays, *fixed), *arrays)[1](cotangents)

    shape, side = flags.shape, _TILE + 2 * reach
    if min(shape) < side:
        return pull(arrays, fixed, cotangents)
    corners, count = _tiles_with(flags)

    def strip(parts):
        """[_BATCH, side, side] to [side, _BATCH * (side + reach)]: zeros between tiles, as outside of the image."""
        return jnp.moveaxis(jnp.pad(parts, ((0, 0), (0, 0), (0, reach))), 0, 1).reshape(side, -1)

    def batch(i, out):
        corner = lax.dynamic_slice_in_dim(corners, i * _BATCH, _BATCH)
        start = jnp.clip(corner - reach, 0, jnp.asarray([shape]) - side)
        cut = jax.vmap(lambda image, start: lax.dynamic_slice(image, start, (side, side)), (None, 0))
        own = lax.broadcasted_iota(jnp.int32, (_BATCH, 2, side), 2) - (corner - start)[:, :, None]
        own = (own >= 0) & (own < _TILE)
        there = i * _BATCH + lax.iota(jnp.int32, _BATCH) < count
        own = own[:, 0, :, None] & own[:, 1, None, :] & there[:, None, None]
        parts = jax.tree.map(lambda image: cut(image, start), (arrays, fixed, cotangents))
        bars = tuple(jnp.where(own, bar, 0) for bar in parts[2])
        found = pull(*jax.tree.map(strip, (*parts[:2], bars)))
        found = [bar.reshape(side, _BATCH, side + reach) for bar in found]

        def add(k, out):
            def one(image, bar):
                before = lax.dynamic_slice(image, start[k], (side, side))
                return lax.dynamic_update_slice(image, before + bar[:, k, :side], start[k])

            return tuple(map(one, out, found))

        return lax.fori_loop(0, _BATCH, add, out)

    out = tuple(jnp.zeros_like(array) for array in arrays)
    return lax.fori_loop(0, (count + _BATCH - 1) // _BATCH, batch, out)


def _tiles_with(flags):
    """(the corners [n, 2] of the tiles with a flag in them, then others, their number)."""
    rows, columns = (-(-size // _TILE) for size in flags.shape)
    padded = jnp.pad(flags, [(0, n * _TILE - size) for n, size in zip((rows, columns), flags.shape, strict=True)])
    hit = jnp.any(jnp.any(padded.reshape(rows, _TILE, -1), axis=1).reshape(rows, columns, _TILE), axis=2).reshape(-1)
    room = -(-hit.size // _BATCH) * _BATCH
    (index,) = jnp.nonzero(hit, size=room, fill_value=0)
    return jnp.stack([index // columns, index % columns], axis=1) * _TILE, jnp.sum(hit)
