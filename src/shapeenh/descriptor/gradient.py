"""The gradient of the relative depth field from normals (LW09 section 4.2, TH10 4.3.2, SPEC 3.1), and its chart.

Imports `types`, `numerics`, `checks` and `stencils` only.
"""

from __future__ import annotations

import jax.numpy as jnp

LEAST_NZ = 0.01
GREATEST_FORESHORTENING = 4.0


def good_pixels(gbuffer):
    """[H, W] bool: on the mask with a finite normal; all others are treated as off the mask."""
    return gbuffer.mask & jnp.all(jnp.isfinite(gbuffer.normal), axis=-1)


def depth_gradient(normal, good, foreshortening):
    """g = -(n_x, n_y) / n_z^f as planes `[2, H, W]`; 0 where not `good` (SPEC 3.1).

    normal: [H, W, 3]; components beyond ±2 are no normal's and are held there, n_z is held above 0.01.
    foreshortening: [], f >= 0; 1 = the slope of the surface.
    Gradient: exact where n_z > 0.01; with respect to n_z it is 0 below.
    """
    n = jnp.where(good[..., None], normal, jnp.asarray([0, 0, 1], normal.dtype))
    n_xy = jnp.clip(jnp.moveaxis(n[..., :2], -1, 0), -2, 2)
    n_z = jnp.clip(n[..., 2], LEAST_NZ, 2)
    return jnp.where(good[None], -n_xy * jnp.exp(-foreshortening * jnp.log(n_z))[None], 0)


# ------------------------------------------------------------------------------------------- the chart
#
# At an occluding contour a height field has a fold: over the distance t to the outline its slope grows like 1/sqrt(t),
# and finite differences of g miss the curvature by 30 % one pixel inside. The *normal* stays smooth there. So g is
# differentiated in the chart
#     phi(g) = g (1 + s)^(-f/2),  s = |g|^(2/f),
# which for f = 1 is -(n_x, n_y) again, and the chain rule leads back:
#     dphi = (1 + s)^(-f/2) (I - s/(1+s) u u^T) dg,   u = g/|g|,
#     dg   = (1 + s)^( f/2) (I + s u u^T) dphi.
# On planes and at f = 0 the chart is the identity.


def _stretch(g, foreshortening):
    """(s / |g|^2, s), both [H, W]; below |g| = 1e-6, where they are as good as 0 but not smooth, they are held."""
    f = jnp.maximum(foreshortening, 0.02)
    log_q = jnp.log(jnp.maximum(g[0] * g[0] + g[1] * g[1], 1e-12))
    return jnp.exp((1 / f - 1) * log_q), jnp.exp(log_q / f)


def to_chart(g, foreshortening):
    """phi(g), `[2, H, W]`."""
    _, s = _stretch(g, foreshortening)
    return g * jnp.exp(-0.5 * foreshortening * jnp.log1p(s))[None]


def from_chart(g, change, foreshortening):
    """The change of g, `[2, H, W]`, that belongs to a small change of phi(g)."""
    s_over_q, s = _stretch(g, foreshortening)
    along = s_over_q * (g[0] * change[0] + g[1] * change[1])
    return jnp.exp(0.5 * foreshortening * jnp.log1p(s))[None] * (change + along[None] * g)
