"""Lit spheres: shading painted on a ball, looked up by the normal (SPEC 6's row "lit sphere"; TH10 5.3.2)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh import checks
from shapeenh.types import Descriptor, GBuffer


def _lookup(texture, x, y):
    """Bilinear in a picture of a ball: (x, y) in [-1, 1] from left to right and bottom to top; clamped at the rim."""
    height, width = texture.shape[:2]
    u, v = (0.5 + 0.5 * x) * width - 0.5, (0.5 - 0.5 * y) * height - 0.5
    left, top = jnp.floor(u), jnp.floor(v)
    fu, fv = (u - left)[..., None], (v - top)[..., None]
    columns = [jnp.clip(left.astype(jnp.int32) + i, 0, width - 1) for i in (0, 1)]
    rows = [jnp.clip(top.astype(jnp.int32) + i, 0, height - 1) for i in (0, 1)]
    upper, lower = (texture[r, columns[0]] + fu * (texture[r, columns[1]] - texture[r, columns[0]]) for r in rows)
    return upper + fv * (lower - upper)


@functools.partial(jax.jit, static_argnames=("two",))
def _lit_sphere(two, mask, normal, mean, convex, concave, transition):
    valid = mask & jnp.all(jnp.isfinite(normal), axis=-1) & jnp.isfinite(mean)
    normal = jnp.where(valid[..., None], normal, 0)
    x, y = normal[..., 0], normal[..., 1]
    colour = _lookup(convex, x, y)
    if two:
        share = (0.5 + 0.5 * jnp.tanh(transition * jnp.where(valid, mean, 0)))[..., None]
        colour = colour + share * (_lookup(concave, x, y) - colour)
    return jnp.where(valid[..., None], colour, 0)


def lit_sphere(gbuffer, texture, *, concave=None, descriptor=None, transition=20.0):
    """Colour of a painted ball at every normal, or of two balls with a transition by mean curvature.

    Source: SPEC 6, "lit sphere (one, or convex + concave pair): texture at n_xy"; Sloan et al. 2001.
    gbuffer: `GBuffer`. texture: [h, w, 3], linear RGB, the picture of a ball that fills it, lit from the viewer's side.
    concave: [h, w, 3], the ball for concavities, or None. descriptor: `Descriptor`, needed with `concave`.
    transition: [], px: how fast the first ball turns into the second, `(1 + tanh(transition Hm))/2`.
    Returns [H, W, 3], linear; 0 off the mask. To warp it, pass a G-buffer with bent normals; to scale it, multiply by
    `radiance_scale` at its luminance.
    Gradient: in the textures, transition and Hessian; in the normals through the bilinear lookup.
    Errors: ValueError for wrong records and shapes.
    """
    checks.check_type("gbuffer", gbuffer, GBuffer)
    checks.check_shape("gbuffer.normal", gbuffer.normal, (None, None, 3))
    size = np.shape(gbuffer.normal)[:2]
    checks.check_shape("texture", texture, (None, None, 3))
    checks.check_finite("texture", texture)
    checks.check_finite("transition", transition)
    dtype = checks.float_dtype(gbuffer.normal)
    mean = jnp.zeros(size, dtype)
    if concave is not None:
        checks.check_shape("concave", concave, (None, None, 3))
        checks.check_finite("concave", concave)
        checks.check_type("descriptor", descriptor, Descriptor)
        checks.check_shape("descriptor.hessian", descriptor.hessian, (*size, 3))
        hessian = jnp.asarray(descriptor.hessian, dtype)
        mean = 0.5 * hessian[..., 0] + 0.5 * hessian[..., 2]
    balls = (jnp.asarray(t, dtype) for t in (texture, texture if concave is None else concave))
    mask, normal = jnp.asarray(gbuffer.mask, bool), jnp.asarray(gbuffer.normal, dtype)
    return _lit_sphere(concave is not None, mask, normal, mean, *balls, jnp.asarray(transition, dtype))
