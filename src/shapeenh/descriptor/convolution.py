"""Line integral convolution: a direction field made visible (Cabral and Leedom 1993; TH10 8.1, SPEC 10)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.checks import check_range, check_shape, check_size, float_dtype
from shapeenh.numerics import safe_divide, safe_hypot

_LONGEST = 1000.0
_STEP = 0.5  # px


def line_integral_convolution(direction, *, mask=None, length=20.0, noise=None, seed: int = 0) -> jax.Array:
    """White noise smeared along a direction field, whose trajectories it shows (Cabral and Leedom 1993; SPEC 10).

    direction: [H, W, 2], x right, y up: lines, not arrows, of any length; 0 where there is none (such as of
        `principal_directions`, or a LineField's).
    mask: [H, W], nonzero where the field counts; None: everywhere. Trajectories end where it does, and at pixels
        without a direction.
    length: [], px, in [1, 1000]: how far each pixel looks along its trajectory, both ways together.
    noise: [H, W] in [0, 1] to be smeared; None: white noise, the same at every call with the same `seed`.
    *Static*: seed; whether `mask` and `noise` are given.
    Returns [H, W] in [0, 1], around 1/2, its contrast that of half the noise's whatever the length; 1 off the mask.
    Gradient: none; it is a display.
    Errors: ValueError for shapes that disagree and numbers out of range.

        u, v = principal_directions(descriptor.hessian)
        strokes = line_integral_convolution(u, mask=gbuffer.mask)
    """
    check_shape("direction", direction, (None, None, 2))
    shape = np.shape(direction)[:2]
    check_range("length", length, 1, _LONGEST)
    check_shape("length", length, ())
    check_size("seed", seed, low=0, high=2**31 - 1)
    dtype = float_dtype(direction)
    if mask is not None:
        check_shape("mask", mask, shape)
        mask = jnp.asarray(mask) != 0
    if noise is None:
        noise = np.random.default_rng(seed).random(shape)
    check_shape("noise", noise, shape)
    return _convolve(jnp.asarray(direction, dtype), mask, jnp.asarray(length, dtype), jnp.asarray(noise, dtype))


@jax.jit
def _convolve(direction, mask, length, noise):
    height, width = noise.shape
    good = jnp.all(jnp.isfinite(direction), axis=-1) & jnp.isfinite(noise)
    mask = good if mask is None else mask & good
    x, y = (jnp.where(mask, lax.stop_gradient(direction[..., i]), 0) for i in (0, 1))
    size = safe_hypot(x, y)
    x, y = safe_divide(x, size), safe_divide(-y, size)  # from here on y is down, as rows are
    there = (size > 0) & mask
    noise = lax.stop_gradient(jnp.where(mask, noise, 0))
    grain = noise.reshape(-1)
    table = jnp.stack([x.reshape(-1), y.reshape(-1), there.reshape(-1).astype(x.dtype)], axis=-1)
    row, column = jnp.meshgrid(jnp.arange(height, dtype=x.dtype), jnp.arange(width, dtype=x.dtype), indexing="ij")

    def index(r, c):
        near = lambda a, n: jnp.clip(jnp.round(a).astype(jnp.int32), 0, n - 1)  # noqa: E731
        inside = (r > -0.5) & (r < height - 0.5) & (c > -0.5) & (c < width - 0.5)
        return near(r, height) * width + near(c, width), inside

    def one(_, carry):
        r, c, u, v, alive, total, weight = carry
        here, inside = index(r, c)
        found = table[here]
        turn = jnp.where(found[..., 0] * u + found[..., 1] * v < 0, -1, 1)  # a line has no head: go on, not back
        alive = alive & inside & (found[..., 2] > 0)
        u, v = turn * found[..., 0], turn * found[..., 1]
        total = total + jnp.where(alive, grain[here], 0)
        weight = weight + alive.astype(total.dtype)
        return r + _STEP * v, c + _STEP * u, u, v, alive, total, weight

    def way(sign):
        """Sum over the samples on one side, the pixel itself not counted."""
        steps = jnp.round(0.5 * length / _STEP).astype(jnp.int32)
        start = (row + sign * _STEP * y, column + sign * _STEP * x, sign * x, sign * y, there)
        state = (*start, jnp.zeros_like(noise), jnp.zeros_like(noise))
        state = lax.fori_loop(0, steps, one, state)
        return state[5], state[6]

    (ahead, n_ahead), (behind, n_behind) = way(1.0), way(-1.0)
    count = 1 + n_ahead + n_behind
    mean = (noise + ahead + behind) / count
    # the mean of n samples spreads like 1/sqrt(n): show all lengths with the same contrast. Two samples share a pixel
    shown = 0.5 + (mean - 0.5) * jnp.sqrt(jnp.maximum(count * _STEP, 1)) * 0.5
    return jnp.where(mask, jnp.clip(shown, 0, 1), 1)
