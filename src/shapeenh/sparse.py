"""Reverse mode where nearly all pixels have the derivative 0: for the others alone.

The weight of a silhouette saturates: a few hundred pixels of an image have a derivative, and which ones is known at run
time. Steps of a diffusion keep the jumps at a few links; stencils are pulled back in the tiles around a few pixels.
Imports `fusion` only.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero

from shapeenh.fusion import stored


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


def _add_at(plane, place, values):
    return plane.reshape(-1).at[place].add(values, mode="promise_in_bounds").reshape(plane.shape)


def jumps_at(planes, places):
    """The differences of planes [C, H, W] across a few links, [C, N]; 0 at the last pixel."""
    return tuple(end - begin for begin, end in at_ends(planes, places))


def put_back(few, border_x, border_y):
    """The borders with the derivative that a few of them have."""
    if few is None:
        return border_x, border_y

    def put(border, value, place):
        return _add_at(border, place, value - lax.stop_gradient(value))

    return tuple(map(put, (border_x, border_y), *few))


# ------------------------------------------------------------------------------------------- tiles
#
# Small tiles are cut out with a margin, `_BATCH` at a time, and laid side by side as one image: kernels run along its
# rows. What a tile's neighbour in that image changes are margins, which are not used.

_TILE = 4  # px; smaller ones are more work to list, larger ones hold more pixels without a derivative
_BATCH = 64  # tiles at a time, enough for a kernel to be worth its call


def pull_from(flags, reach: int, function, arrays, fixed, cotangents, always):
    """What `cotangents` of `function(always, *arrays, *fixed)` at flagged pixels, and some more, pull back to `arrays`.

    flags: [H, W] bool; arrays, fixed: tuples of images [H, W]; function: to a tuple of such, whose values depend on
        pixels up to `reach` away, and on what is outside of the image as if it were 0; it closes over no arrays;
        cotangents: a tuple of images; always: a true predicate unknown at compile time, for `stored`.
    *Static*: reach.
    Returns a tuple of [H, W], like `arrays`. The time follows the number of tiles with a flag.
    """
    return _pull_tiles(flags, reach, False, function, arrays, fixed, cotangents, always)


def pull_to(flags, reach: int, function, arrays, fixed, cotangents, always):
    """As `pull_from`: what all `cotangents` pull back to `arrays` at flagged pixels, and some more; 0 elsewhere."""
    return _pull_tiles(flags, 2 * reach, True, function, arrays, fixed, cotangents, always)


def _pull_tiles(flags, margin: int, to: bool, function, arrays, fixed, cotangents, always):
    def pull(arrays, fixed, cotangents, always):
        return jax.vjp(lambda *arrays: function(always, *arrays, *fixed), *arrays)[1](tuple(cotangents))

    if min(flags.shape) < _TILE + 2 * margin:
        return pull(arrays, fixed, cotangents, always)

    @jax.custom_batching.sequential_vmap  # each of a batch has its own number of tiles
    def run(flags, arrays, fixed, cotangents, always):
        corners, count = _tiles_with(flags)

        def batch(i, out):
            corner = lax.dynamic_slice_in_dim(corners, i * _BATCH, _BATCH)
            there = i * _BATCH + lax.iota(jnp.int32, _BATCH) < count
            place, inside, own = stored(always, partial(_strip, flags.shape, margin), corner, there)
            seen, wanted = (inside, own) if to else (own, inside)
            cut = lambda images, where: tuple(jnp.where(where, at(image, place), 0) for image in images)  # noqa: E731
            bars = pull(cut(arrays, inside), cut(fixed, inside), cut(cotangents, seen), always)
            bars = (jnp.where(wanted, bar, 0) for bar in bars)
            return tuple(_add_at(total, place, bar) for total, bar in zip(out, bars, strict=True))

        out = tuple(jnp.zeros_like(array) for array in arrays)
        return lax.fori_loop(0, (count + _BATCH - 1) // _BATCH, batch, out)

    return run(flags, arrays, fixed, cotangents, always)


def _strip(shape, margin: int, corner, there):
    """Of tiles side by side with their margins, `[side, _BATCH * side]`: the places in the image, counted row by row;
    whether they are within the image; whether they are a tile's own.
    """
    side = _TILE + 2 * margin
    down, right = (lax.broadcasted_iota(jnp.int32, (side, _BATCH, side), axis) - margin for axis in (0, 2))
    row, column = down + corner[None, :, :1], right + corner[None, :, 1:]
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    own = inside & (down >= 0) & (down < _TILE) & (right >= 0) & (right < _TILE) & there[None, :, None]
    place = jnp.where(inside, row * shape[1] + column, 0)
    return tuple(a.reshape(side, -1) for a in (place, inside, own))


def _tiles_with(flags):
    """(the corners [n, 2] of the tiles with a flag in them, then others, their number)."""
    rows, columns = (-(-size // _TILE) for size in flags.shape)
    padded = jnp.pad(flags, [(0, n * _TILE - size) for n, size in zip((rows, columns), flags.shape, strict=True)])
    hit = jnp.any(jnp.any(padded.reshape(rows, _TILE, -1), axis=1).reshape(rows, columns, _TILE), axis=2).reshape(-1)
    room = -(-hit.size // _BATCH) * _BATCH
    (index,) = jnp.nonzero(hit, size=room, fill_value=0)
    return jnp.stack([index // columns, index % columns], axis=1) * _TILE, jnp.sum(hit)
