"""How strong the contrast of a picture is: three measures of luminance under a mask (SPEC 12).

All three are pure numbers, do not change when the picture is made brighter by a factor, and are 0 for a uniform, a
black or an absent picture. Pixels off the mask and pixels that are not finite do not count at all.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks
from shapeenh.numerics import luminance, safe_divide, safe_sqrt

MEASURES = ("rms", "michelson", "band")
TAIL = (0.005, 0.015)  # Michelson's extremes: the quantiles averaged from 0.5 % to 1.5 % of the pixels, at either end
STEP = 0.2  # of the heat flow of `band`: at 1/4 the checkerboard keeps its amplitude (SPEC 3.5)


def contrast(image, mask, *, measure: str = "rms", scale: float = 2.0):
    """Contrast of a picture's luminance under a mask.

    Source: SPEC 12. With Y the luminance (Rec. 709; an [H, W] image is taken as it is; negative values count as 0):

    - `rms`: standard deviation over mean.
    - `michelson`: (max - min)/(max + min); max and min are not the outermost pixels but the 99 % and 1 % quantiles,
      averaged over the 1 % of pixels round them: a stray highlight does not count, and the gradient rests on many
      pixels.
    - `band`: root mean square of the detail between `scale` and twice `scale`, over the mean. The detail is the
      difference of two blurs by heat flow that stops at the outline, so that the outline does not count.

    image: [H, W, 3] linear RGB radiance, or [H, W]. mask: [H, W], what counts.
    scale: px, > 0; for `band` alone. *Static*: measure, scale.
    Returns [], >= 0; `rms` and `band` have no upper end, `michelson` lies in [0, 1]; 0 where nothing counts.
    Gradient: with respect to image, finite for every image; exact, but for `michelson` where pixels tie (one
    subgradient, which shares equally) and for `rms` and `band` at uniform pictures (0 there: a cone's tip).
    Errors: ValueError for shapes, an unknown measure, a scale out of range.

    >>> se.contrast(image, gbuffer.mask, measure="michelson")
    """
    checks.check_choice("measure", measure, MEASURES)
    shape = np.shape(image)
    if len(shape) not in (2, 3):
        raise ValueError(f"image has shape {shape}; accepted is [H, W] or [H, W, 3]")
    checks.check_shape("image", image, (None, None, 3)[: len(shape)])
    checks.check_real("image", image)
    checks.check_shape("mask", mask, shape[:2])
    if not checks.is_concrete(scale):
        raise ValueError("scale is traced; accepted are plain numbers (it sets the number of blur steps)")
    checks.check_range("scale", scale, 0.5, 64)
    image = jnp.asarray(image, checks.float_dtype(image))
    return _contrast(image, jnp.asarray(mask), measure=measure, scale=float(scale))


@functools.partial(jax.jit, static_argnames=("measure", "scale"))
def _contrast(image, mask, *, measure, scale):
    counts, y = _relative_luminance(image, mask)
    mean = _mean(y, counts)
    if measure == "michelson":
        high, low = _extremes(y, counts)
        return safe_divide(jnp.where(high > low, high - low, 0), high + low)  # equal pixels may round below 0
    deviation = y - mean if measure == "rms" else _band(y, counts, scale)
    deviation = deviation - _mean(deviation, counts)  # what rounding left of the mean: a uniform picture has none
    return safe_divide(safe_sqrt(_mean(jnp.square(deviation), counts)), mean)


def _relative_luminance(image, mask):
    """(which pixels count, their luminance as a fraction of the brightest value; 0 elsewhere).

    The brightest value is a constant of the derivative: no measure depends on it, and with it nothing overflows. A
    picture so dark that its gradient would overflow (below 1e-31 in float32) is black.
    """
    rgb = image if image.ndim == 3 else image[..., None]
    counts = mask.astype(bool) & jnp.all(jnp.isfinite(rgb), axis=-1)
    rgb = jnp.where(counts[..., None], rgb, 0)
    top = lax.stop_gradient(jnp.max(rgb, initial=0))
    limits = jnp.finfo(rgb.dtype)
    black = top <= limits.tiny / limits.eps
    rgb = jnp.where(black, 0, rgb / jnp.where(black, 1, top))
    y = luminance(rgb) if image.ndim == 3 else rgb[..., 0]
    return counts, jnp.where(y < 0, 0, y)


def _mean(plane, counts):
    """Mean over the pixels that count (counted as integers: float32 stops at 2^24); 0 where there are none."""
    number = jnp.maximum(jnp.sum(counts, dtype=jnp.int32), 1).astype(plane.dtype)
    return jnp.sum(jnp.where(counts, plane, 0)) / number


# ------------------------------------------------------------------------------------------- Michelson


def _extremes(y, counts):
    """(high, low): the quantile function averaged over TAIL, from the brightest and from the darkest end.

    An average of order statistics is sum(w y)/sum(w): w is 1 for pixels within the tail, 0 outside, and a fraction,
    shared equally, for pixels that tie with its ends. The weights are constants of the derivative: they only change
    where pixels change places, and there they are equal.
    """
    y0 = lax.stop_gradient(y)
    number = jnp.sum(counts, dtype=jnp.int32).astype(y.dtype)
    inner, outer = (jnp.asarray(t, y.dtype) * number for t in TAIL)
    ranks = jnp.stack([inner, outer, number - inner, number - outer])

    def below(value, rank):
        """Weight of each pixel among the `rank` darkest ones."""
        less, ties = counts & (y0 < value), counts & (y0 == value)
        left = rank - jnp.sum(less, dtype=jnp.int32).astype(y.dtype)
        share = left / jnp.maximum(jnp.sum(ties, dtype=jnp.int32), 1).astype(y.dtype)
        return jnp.where(less, 1, jnp.where(ties, jnp.clip(share, 0, 1), 0))

    w = jax.vmap(below)(_order_statistics(y0, counts, ranks), ranks)
    low, high = w[1] - w[0], w[2] - w[3]
    return safe_divide(jnp.sum(high * y), jnp.sum(high)), safe_divide(jnp.sum(low * y), jnp.sum(low))


def _order_statistics(y, counts, ranks):
    """[R]: the smallest values that have at least `ranks` [R] counting pixels at or below them; y >= 0.

    Floats >= 0 are ordered as their bits are, so the bits are found eight at a time, from a histogram of those pixels
    that share the bits found before. Sorting takes sixty times as long on a CPU.
    """
    bits = 8 * y.dtype.itemsize
    integer = jnp.dtype(f"int{bits}")
    keys = jnp.where(counts, lax.bitcast_convert_type(jnp.abs(y), integer), jnp.iinfo(integer).max).ravel()
    number = len(ranks)

    def eight_more(k, state):
        found, below = state
        shift = (bits - 8 * (k + 1)).astype(integer)
        head, tail = (keys >> shift) >> 8, ((keys >> shift) & 255).astype(jnp.int32)
        wanted = (found >> shift) >> 8
        histogram = jnp.full(keys.shape, number, jnp.int32)  # the last one is for pixels that nobody asks about
        for r in range(number - 1, -1, -1):  # ranks with equal heads share the histogram of the first of them
            histogram = jnp.where(head == wanted[r], r, histogram)
        owner = jnp.argmax(wanted[:, None] == wanted[None], axis=1)
        tally = jnp.zeros((number + 1) * 256, jnp.int32)
        tally = tally.at[histogram * 256 + tail].add(1, mode="promise_in_bounds").reshape(number + 1, 256)
        until = below[:, None] + jnp.cumsum(tally[owner], axis=1)
        digit = jnp.minimum(jnp.sum(until.astype(y.dtype) < ranks[:, None], axis=1), 255)
        before = jnp.take_along_axis(until, jnp.maximum(digit - 1, 0)[:, None], axis=1)[:, 0]
        return found | (digit.astype(integer) << shift), jnp.where(digit > 0, before, below)

    start = jnp.zeros(number, integer), jnp.zeros(number, jnp.int32)
    found, _ = lax.fori_loop(0, bits // 8, eight_more, start)
    return lax.bitcast_convert_type(found, y.dtype)


# ------------------------------------------------------------------------------------------- band


def _band(y, counts, scale):
    """Blur at `scale` less blur at 2 `scale`: heat flow between pixels that count, nothing crosses the outline."""
    x_open = (counts[:, 1:] & counts[:, :-1]).astype(y.dtype) * STEP
    y_open = (counts[1:] & counts[:-1]).astype(y.dtype) * STEP

    def step(u, _):
        right, down = x_open * (u[:, 1:] - u[:, :-1]), y_open * (u[1:] - u[:-1])
        flow = jnp.pad(right, ((0, 0), (0, 1))) - jnp.pad(right, ((0, 0), (1, 0)))
        flow = flow + jnp.pad(down, ((0, 1), (0, 0))) - jnp.pad(down, ((1, 0), (0, 0)))
        return u + flow, None

    steps = max(1, round(scale**2 / (2 * STEP)))  # n steps blur by sqrt(2 n STEP)
    fine, _ = lax.scan(step, y, None, length=steps)
    coarse, _ = lax.scan(step, fine, None, length=3 * steps)
    return fine - coarse
