"""Apparent relief, the hybrid descriptor (Vergne et al. 2008, TH10 4.2.2, SPEC 4)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.checks import check_range, check_shape, check_type, float_dtype, is_concrete
from shapeenh.descriptor import diffusion, gradient
from shapeenh.descriptor.view import check_gbuffer, describe, mean_curvature
from shapeenh.fusion import stored, unknown_truth
from shapeenh.numerics import eigenvalues, safe_divide, safe_sqrt
from shapeenh.stencils import derivatives, links
from shapeenh.types import Descriptor

GREATEST_BETA = 20.0
_LEAST_SIGMA = 0.5


def curvature_intensity(x, *, beta):
    """E_beta(x) = x / (exp(beta) (1 - x) + x): intensifies (beta < 0) or tones down (beta > 0) (TH10 4.2.2).

    x: any shape, in [0, 1]; beta: [], in [-20, 20]. Returns x's shape, in [0, 1]; 0 and 1 stay.
    Gradient: exact.
    """
    check_range("beta", beta, -GREATEST_BETA, GREATEST_BETA)
    x = jnp.clip(x, 0, 1)
    return x / (jnp.exp(jnp.asarray(beta, x.dtype)) * (1 - x) + x)


def describe_relief(gbuffer, *, sigma=1.0, beta=0.0, base=None, scales=4) -> Descriptor:
    """Apparent relief: an object's curvature tensor, its strength replaced by what the image shows (TH10 4.2.2).

    gbuffer: GBuffer.
    sigma: [] or [H, W], px, in [0.5, 100]: the scale of the derivatives of Gaussians of the normals. They do not
        read across silhouettes, as the original does. A map is served by linear blends between `scales` sizes.
    beta: [], in [-20, 20], the intensity control E_beta.
    base: Descriptor whose tensor II is rescaled (`describe_object`'s in the paper), or None for `describe(gbuffer)`.
    *Static*: scales, how many sizes a map of sigmas is served by, 2 to 16.
    Returns a Descriptor with the Hessian II' = (L / |Hm|) II, L = E_beta(tanh(sqrt(largest eigenvalue of the Di Zenzo
    tensor))): its mean curvature has the sign of II's and the magnitude L, in [0, 1]. On saddles, where |Hm| is below a
    thousandth of |II|, it stays bounded. The other fields are those of `base`. 0 off the mask.
    Gradient: with respect to normals, sigma, beta and base.
    Errors: ValueError for shapes that disagree and numbers out of range.
    """
    check_gbuffer(gbuffer)
    shape = gbuffer.mask.shape
    if np.ndim(sigma) != 0:
        check_shape("sigma", sigma, shape)
    check_range("sigma", sigma, _LEAST_SIGMA, diffusion.GREATEST_SIGMA)
    check_range("beta", beta, -GREATEST_BETA, GREATEST_BETA)
    if isinstance(scales, bool) or not isinstance(scales, int) or not 2 <= scales <= 16:
        raise ValueError(f"scales is {scales!r}; accepted are integers from 2 to 16")
    if base is None:
        base = describe(gbuffer)
    check_type("base", base, Descriptor)
    check_shape("base.hessian", base.hessian, (*shape, 3))
    dtype = float_dtype(gbuffer.normal)
    widest = float(np.max(sigma, initial=_LEAST_SIGMA)) if is_concrete(sigma) else diffusion.GREATEST_SIGMA
    return _describe_relief(
        gbuffer,
        base,
        jnp.asarray(sigma, dtype),
        jnp.asarray(beta, dtype),
        levels=diffusion.levels_for(widest),
        scales=1 if np.ndim(sigma) == 0 else scales,
    )


@partial(jax.jit, static_argnames=("levels", "scales"))
def _describe_relief(gbuffer, base, sigma, beta, *, levels, scales):
    always = unknown_truth(gbuffer.normal, gbuffer.position, base.hessian)
    normal, good = stored(always, gradient.normal_planes, gbuffer)
    c = base.conductance
    link_x, link_y = links(c)

    flat = jnp.stack(normal[:2])

    def intensity(size):
        time = (0.5 * size * size)[None, None]
        (smooth,) = diffusion.diffuse_stacks((flat,), c, (link_x, link_y), time, None, always, levels)
        d_x, d_y = derivatives(smooth, link_x, link_y, always)
        zenzo = jnp.stack(
            [d_x[0] ** 2 + d_x[1] ** 2, d_x[0] * d_y[0] + d_x[1] * d_y[1], d_y[0] ** 2 + d_y[1] ** 2], axis=-1
        )
        return jnp.tanh(safe_sqrt(eigenvalues(zenzo)[0]))

    if scales == 1:
        strength = intensity(sigma)
    else:
        low, high = jnp.min(sigma), jnp.max(sigma)
        place = safe_divide(sigma - low, high - low) * (scales - 1)
        strength = jnp.zeros_like(sigma)
        for i in range(scales):
            share = jnp.maximum(0, 1 - jnp.abs(place - i))
            strength = strength + share * intensity(low + (high - low) * (i / (scales - 1)))
    strength = jnp.where(good, curvature_intensity(strength, beta=beta), 0)

    h = jnp.where(good[..., None] & jnp.isfinite(base.hessian), base.hessian, 0)
    size = jnp.max(jnp.abs(h), axis=-1)
    size = jnp.where(size > np.finfo(h.dtype).tiny ** 0.5, size, 0)  # flatter is flat: 1/size would overflow
    unit = safe_divide(h, size[..., None])
    mean = mean_curvature(unit)
    hessian = unit * safe_divide(strength * jnp.abs(mean), mean * mean + 1e-6 * (size > 0))[..., None]
    return Descriptor(hessian * c[..., None], base.gradient, base.silhouette, base.crease, base.conductance)
