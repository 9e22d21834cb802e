"""Radiance scaling: the curvature that a direction sees, and the factor on reflected radiance (SPEC 6; TH10 5.3)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from shapeenh import checks


def curvature_mapping(hessian, direction, anisotropy):
    """kappa = tanh(Hm + lambda l_xy^T (H - Hm I) l_xy), in ]-1, 1[, negative where convex.

    Source: TH10 5.3.1, eq. 5.6, with the half difference of curvatures; SPEC 6.
    hessian: [..., 3] (xx, xy, yy), 1/px. direction: [..., 3], unit, the frame of the Hessian. anisotropy: [] or [...],
    in [-1, 1]: 1 takes the larger principal curvature along its direction (tanh k1 for l = u), 0 the mean one.
    Returns [...]; leading axes broadcast.
    Gradient: exact everywhere. Errors: ValueError for a last axis other than 3 or a concrete anisotropy outside [-1,
    1].
    """
    checks.check_shape("hessian", hessian, (..., 3))
    checks.check_shape("direction", direction, (..., 3))
    checks.check_range("anisotropy", anisotropy, -1, 1)
    dtype = checks.float_dtype(hessian, direction)
    shape = np.broadcast_shapes(np.shape(hessian)[:-1], np.shape(direction)[:-1], np.shape(anisotropy))
    h, l = (jnp.broadcast_to(jnp.asarray(a, dtype), (*shape, 3)) for a in (hessian, direction))
    x, y = l[..., 0], l[..., 1]
    mean, half = 0.5 * h[..., 0] + 0.5 * h[..., 2], 0.5 * h[..., 0] - 0.5 * h[..., 2]
    # as x H x, so that no derivative multiplies two large numbers before a small one
    bend = x * (half * x + h[..., 1] * y) + y * (h[..., 1] * x - half * y)
    return jnp.tanh(mean + jnp.broadcast_to(jnp.asarray(anisotropy, dtype), shape) * bend)


def weighed_curvature(hessian, direction, anisotropy, concave):
    """`curvature_mapping` with concavities at a strength of their own."""
    kappa = curvature_mapping(hessian, direction, anisotropy)
    return jnp.where(kappa > 0, concave * kappa, kappa)


def radiance_scale(kappa, delta, invariant, gamma):
    """sigma(kappa, delta): makes radiance brighter or darker where the surface bends.

    Source: TH10 eq. 5.5 in the form of SPEC 6, `(A e^s + B e^-s)/(A e^-s + B e^s)` with A = a (1 - delta),
    B = (1 - a) delta, s = gamma kappa / 2.
    kappa: [...], curvature in [-1, 1], convex negative. delta: [...], reflectance level; clamped to [0, 1]. invariant:
    a, in ]0, 1[, the level that is left alone. gamma: strength >= 0. All broadcast.
    Returns [...], > 0: on convexities, levels above a get brighter and levels below it darker; the reverse on
    concavities; 1 for kappa = 0, gamma = 0 or delta = a. `exp(gamma kappa)` at delta = 0, its inverse at 1; both are
    held within the range of the number format.
    Gradient: exact inside; finite for every finite gamma kappa; 0 in delta outside [0, 1].
    Errors: ValueError for a concrete invariant outside ]0, 1[ or gamma < 0.
    """
    checks.check_range("invariant", invariant, 0, 1, open_ends=True)
    checks.check_range("gamma", gamma, 0, np.inf)
    dtype = checks.float_dtype(kappa, delta, invariant, gamma)
    shape = np.broadcast_shapes(*(np.shape(a) for a in (kappa, delta, invariant, gamma)))
    kappa, delta, a, gamma = (jnp.broadcast_to(jnp.asarray(v, dtype), shape) for v in (kappa, delta, invariant, gamma))
    delta = jnp.where(delta < 0, 0, jnp.where(delta > 1, 1, delta))
    x = gamma * kappa
    falling, rising = a * (1 - delta), (1 - a) * delta
    # With r the smaller over the larger of A and B and v = e^|x|, sigma or its inverse is (v + r)/(1 + r v): no term
    # cancels, and only v can be large.
    ordered, positive = falling >= rising, x >= 0
    small, large = jnp.where(ordered, rising, falling), jnp.where(ordered, falling, rising)
    r = small / large
    v = jnp.exp(jnp.minimum(jnp.where(positive, x, -x), 0.3 * np.log(np.finfo(dtype).max)))  # v^2 in derivatives
    up = (v + r) / (1 + r * v)
    return jnp.where(ordered == positive, up, 1 / up)


def check_strengths(*, alpha, contrast, invariant, anisotropy, concave, **gammas) -> None:
    """Ranges of what all warped and scaled looks have in common, looked at where concrete; `gammas` by their names."""
    checks.check_finite("alpha", alpha)
    checks.check_range("contrast", contrast, -1, 1)
    checks.check_range("invariant", invariant, 0, 1, open_ends=True)
    for name, gamma in gammas.items():
        checks.check_range(name, gamma, 0, np.inf)
    checks.check_range("anisotropy", anisotropy, -1, 1)
    checks.check_finite("concave", concave)
