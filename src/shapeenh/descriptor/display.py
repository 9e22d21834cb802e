"""Pictures of a descriptor (LW09 fig. 6, TH10 fig. 4.7)."""

from __future__ import annotations

import jax.numpy as jnp

from shapeenh.checks import check_range, check_shape, check_type
from shapeenh.descriptor.view import mean_curvature
from shapeenh.types import Descriptor

# sRGB-encoded anchors of the scale at t = -1 (convex), -1/2, 0 (flat), 1/2, 1 (concave)
_SCALE = (
    (0.10, 0.10, 0.55),
    (0.20, 0.60, 0.95),
    (1.00, 1.00, 1.00),
    (1.00, 0.62, 0.15),
    (0.70, 0.05, 0.05),
)


def curvature_scale(t):
    """Display colour of `t` in [-1, 1]: cold hues for convex (< 0), white for flat, warm for concave (LW09 fig. 6).

    t: any shape; beyond ±1 the end colours hold. Returns `[..., 3]` in [0, 1], sRGB encoded (to be saved as it is).
    """
    t = jnp.asarray(t)
    anchors = jnp.asarray(_SCALE, t.dtype)
    at = jnp.linspace(-1, 1, len(_SCALE), dtype=t.dtype)
    return jnp.stack([jnp.interp(t, at, anchors[:, i]) for i in range(3)], axis=-1)


def curvature_colors(descriptor, mask, *, scale=None):
    """The descriptor as in LW09 fig. 6: convex cold, concave warm, by mean curvature; silhouettes and creases black.

    descriptor: Descriptor.
    mask: [H, W] bool, where something is seen.
    scale: [], 1/px, > 0: the |mean curvature| at which colours saturate; None = 60 / H, that is 0.1 at a height of 600.
    Returns [H, W, 3] in [0, 1], sRGB encoded (to be saved as it is); white off the mask.
    Gradient: with respect to the Hessian and the weights.
    Errors: ValueError for a scale that is not positive, or a mask of another size.
    """
    check_type("descriptor", descriptor, Descriptor)
    if scale is None:
        scale = 60 / descriptor.silhouette.shape[0]
    check_range("scale", scale, 0, float("inf"), open_ends=True)
    check_shape("mask", mask, descriptor.silhouette.shape)
    h = mean_curvature(descriptor.hessian) / scale
    ink = jnp.maximum(descriptor.silhouette, descriptor.crease)
    colors = curvature_scale(h) * (1 - ink)[..., None]
    return jnp.where(mask[..., None], colors, 1)
