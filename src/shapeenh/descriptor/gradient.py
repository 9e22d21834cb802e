"""The gradient of the relative depth field from normals (LW09 4.2, TH10 4.3.2, SPEC 3.1), and a chart for it.

Imports nothing of ours.
"""

from __future__ import annotations

import jax.numpy as jnp

LEAST_NZ = 0.01
GREATEST_FORESHORTENING = 4.0


def normal_planes(gbuffer):
    """(normals as three planes [H, W], good [H, W] bool).

    Good pixels are those on the mask with a finite normal; all others count as off the mask and hold (0, 0, 1).
    Components beyond ±2 are no normal's and are held there.
    """
    n = gbuffer.normal
    good = gbuffer.mask & jnp.isfinite(n[..., 0]) & jnp.isfinite(n[..., 1]) & jnp.isfinite(n[..., 2])
    return tuple(jnp.where(good, jnp.clip(n[..., i], -2, 2), i // 2) for i in range(3)), good


def depth_gradient(normal, foreshortening):
    """g = -(n_x, n_y) / n_z^f as planes `[2, H, W]` (SPEC 3.1).

    normal: three planes [H, W]; n_z is held above 0.01.
    foreshortening: [], f >= 0; 1 = the slope of the surface; None means 1, done without logarithms.
    Gradient: exact where n_z > 0.01; with respect to n_z it is 0 below.
    """
    n_z = jnp.maximum(normal[2], LEAST_NZ)
    power = 1 / n_z if foreshortening is None else jnp.exp(-foreshortening * jnp.log(n_z))
    return jnp.stack([-normal[0] * power, -normal[1] * power])


# ------------------------------------------------------------------------------------------- the chart
#
# At an occluding contour a height field has a fold: at the distance t from the outline its slope grows like 1/sqrt(t),
# and finite differences of g miss the curvature by 30 % one pixel inside. The *normal* stays smooth there. So g is
# differentiated in the chart
#     phi(g) = g (1 + s)^(-b f / 2),  s = |g|^(2/f),
# which for f = 1 and b = 1 is -(n_x, n_y) again, and the chain rule leads back: with u = g/|g|
#     dphi = (1 + s)^(-b f / 2) (I - b s/(1 + s) u u^T) dg,
#     dg   = (1 + s)^( b f / 2) (I + b s/(1 + (1 - b) s) u u^T) dphi.
# b in [0, 1] says how much of it: after diffusion the fold is gone, and b = 0 is the identity.


def _stretch(g, foreshortening, bend):
    """(q = |g|^2, s, b, b f / 2); below |g| = 1e-6, where s is as good as 0 but not smooth, q is held.

    At f = 0 nothing folds, and s would be a step at |g| = 1: b goes to 0 as f does.
    """
    q = jnp.maximum(g[0] * g[0] + g[1] * g[1], 1e-12)
    if foreshortening is None:
        return q, q, bend, 0.5 * bend
    b = jnp.clip(2 * foreshortening - 0.1, 0, 1) * bend
    f = jnp.maximum(foreshortening, 0.05)
    return q, jnp.exp(jnp.log(q) / f), b, 0.5 * b * f


def _power(s, exponent):
    return jnp.sqrt(1 + s) if isinstance(exponent, float) else jnp.exp(exponent * jnp.log1p(s))


def to_chart(g, foreshortening, bend):
    """phi(g), two planes; bend: [], b in [0, 1]."""
    _, s, _, exponent = _stretch(g, foreshortening, bend)
    shrink = 1 / _power(s, exponent)
    return g[0] * shrink, g[1] * shrink


def from_chart(g, foreshortening, bend):
    """(scale, along), [H, W]: a small change dphi of phi(g) belongs to the change scale (I + along g g^T) dphi of g."""
    q, s, b, exponent = _stretch(g, foreshortening, bend)
    return _power(s, exponent), b * s / ((1 + (1 - b) * s) * q)
