"""Display: exposure, tone curve, composition. All in linear RGB; sRGB comes last, in `save_image`."""

from __future__ import annotations

import jax.numpy as jnp

from shapeenh.checks import check_finite, check_range, check_shape
from shapeenh.numerics import luminance, safe_divide

MIDDLE = 0.30  # where the average luminance under the mask goes, linear: a mid tone of 148 of 255 on the display


def auto_exposure(radiance, mask):
    """The factor that brings the mean luminance under the mask to a mid tone.

    Take it from the *original* picture and use it for the enhanced one too, so that both are shown alike.

    Args: radiance `[H, W, 3]` linear; mask `[H, W]` bool.
    Returns: [] factor > 0; 1 where the mask is empty or all is black. Pixels that are not finite do not count.
    Gradient: with respect to radiance.
    """
    check_shape("radiance", radiance, (None, None, 3))
    check_shape("mask", mask, radiance.shape[:2])
    counts = jnp.asarray(mask, bool) & jnp.all(jnp.isfinite(radiance), axis=-1)
    y = luminance(jnp.where(counts[..., None], radiance, 0))
    mean = safe_divide(jnp.sum(y), jnp.sum(counts).astype(y.dtype))
    return jnp.where(mean > 0, MIDDLE / jnp.where(mean > 0, mean, 1), 1)


def tone_map(radiance, *, exposure=1.0, white=4.0):
    """Extended Reinhard curve on luminance (Reinhard et al. 2002, eq. 4), hue kept.

    Args:
        radiance: `[..., 3]` linear RGB, >= 0; colours of negative luminance keep it, times the exposure.
        exposure: [] factor > 0.
        white: [] exposed luminance that becomes 1, > 0; brighter is clipped by the display.

    Returns: `[..., 3]` linear display RGB. Gradient: everywhere; 0 at black keeps its slope.
    """
    check_shape("radiance", radiance, (..., 3))
    check_range("exposure", exposure, 0, jnp.inf, open_ends=True)
    check_range("white", white, 0, jnp.inf, open_ends=True)
    x = radiance * exposure
    y = luminance(x)[..., None]
    y = jnp.where(y < 0, 0, y)
    return x * ((1 + y / (white * white)) / (1 + y))


def composite(image, coverage, background):
    """`image` over a background: `image * coverage + background * (1 - coverage)`, in linear RGB.

    Args: image `[H, W, 3]`; coverage `[H, W]` in [0, 1] or bool; background [3] or `[H, W, 3]`.
    """
    check_shape("image", image, (None, None, 3))
    check_shape("coverage", coverage, image.shape[:2])
    check_finite("background", background)
    a = jnp.asarray(coverage, image.dtype)[..., None]
    b = jnp.broadcast_to(jnp.asarray(background, image.dtype), image.shape)
    return image * a + b * (1 - a)
