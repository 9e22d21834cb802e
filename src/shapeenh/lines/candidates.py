"""What profiles read of a field, and the pixels that can lie near a line: only those are looked at (SPEC 9).

Heights are made finite, and extrapolated where they mean nothing; then a pixel counts if heights around it vary and a
cubic through them can rise above the threshold.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.fusion import stored, unknown_truth
from shapeenh.lines.tiles import list_tiles, margin_for, over_tiles
from shapeenh.numerics import normalize, smoothstep

GAMMA_MAX = 1.0  # the accumulated singularity that ends a trajectory (TH10 7.2.2)
CHUNK = 1 << 12  # pixels that are fitted at a time
RUN = 8  # pixels that are listed together where the list is made at run time
FREE, HELD = 1, 2  # candidates without and with a singularity near
_OVERSHOOT = 1.3  # a maximum of a cubic fitted to heights within [0, 1] is below 1.28, for 5 to 65 samples

# ------------------------------------------------------------------------------------------- what is read


def planes_of(field):
    """(height [H+2, W+2], singularity [H+2, W+2], theta_x [H, W], theta_y [H, W]), finite.

    Where the field is fully singular (off the mask, on the far side of a depth step, beyond the border of the image) a
    height means nothing, but a bilinear read next to it would mix it in: it is extrapolated from its regular
    neighbours, linearly, so that no maximum comes from there.
    """

    def clean(height, direction, singularity):
        finite = jnp.isfinite(height) & jnp.all(jnp.isfinite(direction), axis=-1)
        most = 1e-3 * jnp.finfo(height.dtype).max
        height = jnp.where(finite, jnp.clip(height, -most, most), 0)
        theta = normalize(jnp.where(finite[..., None], direction, 0))
        known = finite & ~jnp.isnan(singularity)
        singular = jnp.where(known, jnp.clip(jnp.where(known, singularity, 0), 0, 1), 1)
        height, singular = jnp.pad(height, 1), jnp.pad(singular, 1, constant_values=1)
        regular = 1 - smoothstep(0.5, 1.0, singular)
        return height, singular, theta[..., 0], theta[..., 1], regular, jnp.pad(height, 2), jnp.pad(regular, 2)

    arrays = field.height, field.direction, field.singularity
    height, singular, theta_x, theta_y, regular, *around = stored(unknown_truth(*arrays), clean, *arrays)
    height = regular * height + (1 - regular) * _extrapolated(*around)
    return height, singular, theta_x, theta_y


_stored_planes = jax.jit(planes_of)


def _extrapolated(height, regular):
    """2 h(p + d) - h(p + 2d), averaged over those of eight directions d in which both are regular; else h(p + d).

    height, regular: with two more pixels of 0 around them.
    """
    h, w = height.shape[0] - 4, height.shape[1] - 4
    totals = [jnp.zeros((h, w), height.dtype)] * 4
    for dr, dc in ((r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)):
        near, far = (np.s_[2 + k * dr : 2 + k * dr + h, 2 + k * dc : 2 + k * dc + w] for k in (1, 2))
        one = regular[near]
        both = one * regular[far]
        values = (one, one * height[near], both, both * (2 * height[near] - height[far]))
        totals = [total + value for total, value in zip(totals, values, strict=True)]
    one, first, both, second = totals
    first = jnp.where(one > 0, first / jnp.where(one > 0, one, 1), 0)
    return jnp.where(both > 0, second / jnp.where(both > 0, both, 1), first)


def read(plane, row, col):
    """Bilinear interpolation of a padded plane at positions counted in pixels of the image; clamped to the padding."""
    h, w = plane.shape
    r, c = jnp.clip(row + 1, 0, h - 1), jnp.clip(col + 1, 0, w - 1)
    r0, c0 = jnp.minimum(jnp.floor(r), h - 2), jnp.minimum(jnp.floor(c), w - 2)
    fr, fc = r - r0, c - c0
    # stored: every read of a corner, and every write in reverse mode, would work it out again
    number = lambda r, c: r.astype(jnp.int32) * w + c.astype(jnp.int32)  # noqa: E731
    index = stored(unknown_truth(plane), number, *lax.stop_gradient((r0, c0)))
    a, b, d, e = _corners(plane, index)
    top, bottom = a + fc * (b - a), d + fc * (e - d)
    return top + fr * (bottom - top)


def _places(plane, index):
    return [index + step for step in (0, 1, plane.shape[1], plane.shape[1] + 1)]


@jax.custom_vjp
def _corners(plane, index):
    """The values at a place and to the right of it, and below both. Gradient: all four into one plane, reverse mode."""
    return tuple(
        plane.ravel().at[place].get(mode="promise_in_bounds", wrap_negative_indices=False)
        for place in _places(plane, index)
    )


def _corners_backward(saved, cotangents):
    plane, index = saved
    bar = jnp.zeros_like(plane).ravel()
    for place, cotangent in zip(_places(plane, index), cotangents, strict=True):
        bar = bar.at[place].add(cotangent, mode="promise_in_bounds", wrap_negative_indices=False)
    return bar.reshape(plane.shape), None


_corners.defvjp(lambda plane, index: (_corners(plane, index), (plane, index)), _corners_backward)


# ------------------------------------------------------------------------------------------- which pixels


def looked_at(field, least, radius):
    """(heights and singularities as `planes_of` returns them, what `candidates_of` returns), worked out only near
    heights that a line can come from."""
    reach = int(np.ceil(radius)) + 1  # px, how far a fit reads
    margin = margin_for(reach + 3)
    tiles = None if margin is None else list_tiles(_high(field, least), margin, around=2 * reach + 3)
    if tiles is None:
        planes = _stored_planes(field)
        return planes[:2], candidates_of(planes, least, radius=radius)
    *planes, candidates = _tiled(field, least, tiles, margin=margin, radius=radius)
    return tuple(planes), candidates


@jax.jit
def _high(field, least):
    """Where a height may make a profile higher than `least`, [H, W] bool.

    Where all are within ±m, those that are extrapolated from them are within ±3 m, and a cubic over both below 5 m.
    Where all are 0, nothing varies, and no profile is higher than any `least`.
    """
    return (field.singularity < 1) & (jnp.abs(field.height) > 0.2 * jnp.maximum(least, 0))


@partial(jax.jit, static_argnames=("margin", "radius"))
def _tiled(field, least, tiles, *, margin, radius):
    always = unknown_truth(field.height, least)

    def look(field):
        planes = stored(always, planes_of, field)
        return *planes[:2], stored(always, partial(candidates_of, radius=radius), planes, least)

    return over_tiles(look, field, tiles, (0, 1, 0), margin=margin)


def list_pixels(candidates):
    """(pixels [n] int32, chunks [2] int32): first those that no singularity is near, then the others."""
    found = np.flatnonzero(candidates != 0)
    held = candidates.ravel()[found] == HELD
    free, near = found[~held], found[held]
    # one of two lengths per image: little recompiles, and few pixels make a short list
    lengths = (CHUNK * (size // CHUNK + 3) for size in (candidates.size // 8, candidates.size))
    start, chunks = -(-free.size // CHUNK), -(-near.size // CHUNK)
    listed = np.full(next(n for n in lengths if n >= (start + chunks) * CHUNK), candidates.size, np.int32)
    listed[: free.size] = free
    listed[start * CHUNK : start * CHUNK + near.size] = near
    return listed, np.asarray([start, chunks], np.int32)


def list_flagged(flags):
    """(numbers [n] int32 of the runs of [H, W] that hold a flag, how many chunks of them), under a transformation."""
    hit = jnp.any(jnp.pad(flags.ravel(), (0, -flags.size % RUN)).reshape(-1, RUN), axis=1)
    step = CHUNK // RUN
    (runs,) = jnp.nonzero(hit, size=hit.size + step, fill_value=hit.size)
    return runs.astype(jnp.int32), -(-jnp.sum(hit, dtype=jnp.int32) // step)


def pixels_of(runs, k):
    """[CHUNK] pixels of chunk k of the runs; what fills the list up lies beyond the image."""
    step = CHUNK // RUN
    return (
        lax.dynamic_slice_in_dim(runs, k * step, step)[:, None] * RUN + np.arange(RUN, dtype=np.int32)[None]
    ).ravel()


@partial(jax.jit, static_argnames=("radius",))
def candidates_of(planes, least, *, radius):
    """[H, W] uint8: where a profile higher than `least` is possible, FREE or, where a singularity may end the
    neighbourhood, HELD; else 0."""
    h, w = planes[2].shape
    # A sample lies within ceil(radius) pixels of its pixel, and is read from the four pixels around it.
    highest = _box(jnp.maximum, planes[0], int(np.ceil(radius)), h, w)
    lowest = _box(jnp.minimum, planes[0], int(np.ceil(radius)), h, w)
    # Its cubic stays below lowest + _OVERSHOOT (highest - lowest).
    possible = (highest > lowest) & (lowest + _OVERSHOOT * (highest - lowest) > least)
    defined = (planes[2] != 0) | (planes[3] != 0)
    steps = int(np.ceil(radius))
    faint = min(0.1, 0.9 * GAMMA_MAX / (steps + 1))  # `_barrier` adds these as they are, and they never add up to 1
    held = _box(jnp.maximum, planes[1], steps, h, w) > faint
    possible &= defined & (planes[1][1:-1, 1:-1] < GAMMA_MAX)
    return jnp.where(possible, jnp.where(held, HELD, FREE), 0).astype(jnp.uint8)


def _box(pick, padded, reach: int, h: int, w: int):
    """The largest (or smallest) value within `reach` pixels, of an image padded by one pixel of its edge."""
    out = jnp.pad(padded, reach - 1, mode="edge")
    for axis, size in ((0, h), (1, w)):
        width = 1
        while width < 2 * reach + 1:  # windows of 1, 2, 4, ... pixels; the last two overlap
            step = min(width, 2 * reach + 1 - width)
            n = out.shape[axis] - step
            out = pick(lax.slice_in_dim(out, 0, n, axis=axis), lax.slice_in_dim(out, step, step + n, axis=axis))
            width += step
        assert out.shape[axis] == size
    return out
