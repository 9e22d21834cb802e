"""Pictures with smooth outlines, from one shading per pixel and a `Coverage` (Chajdas, McGuire and Luebke 2011)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks
from shapeenh.buffers.coverage import CHUNK, OWN
from shapeenh.buffers.runs import listed
from shapeenh.buffers.xla import take
from shapeenh.types import Coverage


def resolve_coverage(image, coverage: Coverage):
    """A picture with smooth outlines: the mean over each pixel's samples of the shading that they borrow.

    Source: Chajdas, McGuire and Luebke 2011. The result is premultiplied: `image * fraction` of a single surface; put
    it over a background as `result + background * (1 - coverage.fraction)`. For display, apply the tone curve *first*:
    a light thousands of times brighter than its surroundings would win in every pixel that it touches.

    image: [H, W, C], any unit. coverage: of its size, from `sample_coverage`.
    Returns [H, W, C]; 0 where no sample is covered; a pixel that shows one surface keeps its value to the bit.
    *Gradient*: with respect to image, the samples being constants.
    *Errors*: ValueError for wrong shapes.
    """
    checks.check_type("coverage", coverage, Coverage)
    checks.check_shape("coverage.source", coverage.source, (None, None, None))
    checks.check_shape("image", image, (*coverage.source.shape[:2], None))
    image = jnp.asarray(image)
    return resolved(image.astype(checks.float_dtype(image)), coverage.source)


@jax.jit
def resolved(image, source):
    return weighted(image, source)


@jax.custom_vjp
def weighted(image, source):
    return jax.custom_batching.sequential_vmap(gather)(image, source)


def gather(image, source):
    """Forward: mixed pixels read their neighbours."""
    dtype = image.dtype

    def step(at, weights, valid, flat, out):
        parts = [jnp.where(weights[k][:, None] > 0, weights[k][:, None] * take(flat, at[k]), 0) for k in range(9)]
        return out.at[jnp.where(valid, at[OWN], flat.shape[0])].set(sum(parts), mode="drop")

    return over_mixed(step, image, source, dtype)


def scatter(cotangent, source):
    """Reverse: the same weights, from the pixel to its neighbours."""

    def step(at, weights, valid, flat, out):
        here = take(flat, at[OWN])
        for k in range(9):
            add = jnp.where(valid[:, None], weights[k][:, None] * here, 0)
            out = out.at[at[k]].add(add, mode="promise_in_bounds")
        return out

    return over_mixed(step, cotangent, source, cotangent.dtype)


def over_mixed(step, image, source, dtype):
    """`image` where all samples take their own pixel, and 0 elsewhere; then `step` for the listed mixed pixels."""
    height, width, square = source.shape
    count = height * width
    chunk = min(CHUNK, -(-count // 64) * 64)
    own = jnp.all(source == OWN, axis=-1)
    pixels, total = listed((~own & jnp.any(source >= 0, axis=-1)).reshape(-1), chunk)
    flat, codes = image.reshape(count, -1), source.reshape(count, square)
    out = jnp.where(own.reshape(-1, 1), flat, 0)

    def body(state):
        i, out = state
        pixel = lax.dynamic_slice(pixels, (i * chunk,), (chunk,))
        valid = pixel < count
        pixel = jnp.minimum(pixel, count - 1)
        code = take(codes, pixel)
        numbers = np.arange(9, dtype=np.int8)
        weights = jnp.stack([jnp.sum((code == k).astype(dtype), axis=1) for k in numbers]) * (1 / square)
        row = pixel // width
        y = row[None] + np.repeat(np.arange(-1, 2, dtype=np.int32), 3)[:, None]
        x = (pixel - row * width)[None] + np.tile(np.arange(-1, 2, dtype=np.int32), 3)[:, None]
        at = jnp.clip(y, 0, height - 1) * width + jnp.clip(x, 0, width - 1)  # no weight lies outside of the image
        return i + 1, step(at, weights, valid, flat, out)

    return lax.while_loop(lambda state: state[0] * chunk < total, body, (jnp.int32(0), out))[1].reshape(image.shape)


def _weighted_fwd(image, source):
    return weighted(image, source), source


def _weighted_bwd(source, cotangent):
    return jax.custom_batching.sequential_vmap(scatter)(cotangent, source), np.zeros(source.shape, jax.dtypes.float0)


weighted.defvjp(_weighted_fwd, _weighted_bwd)
