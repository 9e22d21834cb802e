"""Light warping: the warp tensor, the warp of directions, its inverse and its Jacobian (SPEC 5; LW09 5; TH10 5.2, A).

Directions are unit `[..., 3]` arrays in the frame of the Hessian: camera space, z towards the viewer. A direction l is
`[p : w]` in stereographic coordinates, p = l_xy, w = 1 + l_z, and the warp is linear there, `[L p : w]`. On the sphere

    l' = (L p, l_z - e) / (1 + e),    e = (rho - 1) v / 2,    rho = |L p|^2 / |p|^2,    v = |p|^2 / (1 + l_z) = 1 - l_z

which is the same map, written so that L = I gives back l bit for bit and nothing cancels below the horizon. Only rho is
singular, at the poles: at l = z its factor v is 0, at l = -z it is a convention.
"""

from __future__ import annotations

import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks, numerics

# ------------------------------------------------------------------------------------------- the warp tensor


def _scaled_curvature(k, alpha):
    """alpha k, held where its square is finite: lam is constant to machine precision long before."""
    bound = 0.25 * np.sqrt(np.finfo(k.dtype).max)
    return jnp.clip(alpha * k, -bound, bound)


@functools.cache
def _tangent_series(ratio: Fraction, eps: float) -> tuple[float, ...]:
    """Taylor coefficients of tan(ratio atan(s))/s in s^2, to eps at |s| = tan(pi/16).

    From f' (1 + s^2) = ratio (1 + f^2): the coefficient of each power follows from the ones before it.
    """
    f = [Fraction(0), ratio]
    while float(abs(f[-1])) * np.tan(np.pi / 16) ** (len(f) - 2) > eps / 8:
        n = len(f)  # the next power is n + 1, from the one of f' at s^n; f is odd
        square = sum((f[i] * f[n - i] for i in range(1, n, 2)), Fraction(0))
        f += [Fraction(0), (ratio * square - (n - 1) * f[n - 1]) / (n + 1)]
    return tuple(float(a) for a in f[1::2])


def _half_angle(x):
    """tan(a/2) from x = tan(a), |a| < pi/2."""
    return x / (1 + jnp.sqrt(1 + x * x))


def _tangent_of_multiple(s, ratio: Fraction):
    """tan(ratio a) from s = tan(a), |a| <= pi/16."""
    square = s * s
    series = _tangent_series(ratio, float(np.finfo(s.dtype).eps))
    total = jnp.full_like(s, series[-1])
    for a in series[-2::-1]:
        total = total * square + a
    return total * s


def _half_tangent(x):
    """t = tan(atan(x)/6), |t| <= tan(pi/12) = 0.268. Then lam = tan(atan(x)/6 + pi/4) = (1 + t)/(1 - t): 1 at x = 0.

    By half angles and a short series: only roots and products, which vectorise; atan and tan are library calls.
    """
    return _tangent_of_multiple(_half_angle(_half_angle(_half_angle(x))), Fraction(4, 3))


def _factor(x):
    t = _half_tangent(x)
    return (1 + t) / (1 - t)


def _factor_slope(x):
    """d lam / dx = (1 + t^2) / (3 (1 - t)^2 (1 + x^2))."""
    t = _half_tangent(x)
    return (1 + t * t) / (3 * (1 - t) ** 2) / (1 + x * x)


def _factor_difference(x1, x2, dx):
    """lam(x1) - lam(x2), where dx = x1 - x2 is known better than their difference.

    It is 2 (t1 - t2)/((1 - t1)(1 - t2)) with t1 - t2 = tan(a/6)(1 + t1 t2) and tan(a) = dx / (1 + x1 x2), |a| < pi: no
    cancellation. Numerator and denominator are scaled by 1/max(1, |x|) of both, which keeps them finite.
    """
    t1, t2 = _half_tangent(x1), _half_tangent(x2)
    s1, s2 = 1 / jnp.maximum(1, jnp.abs(x1)), 1 / jnp.maximum(1, jnp.abs(x2))
    along = s1 * s2 + jnp.clip(x1, -1, 1) * jnp.clip(x2, -1, 1)
    across = dx * jnp.minimum(s1, s2) * jnp.maximum(s1, s2)
    length = jnp.sqrt(along * along + across * across)
    obtuse = along < 0  # then `along + length` would cancel
    half = jnp.where(obtuse, length - along, across) / jnp.where(obtuse, across, along + length)
    sixth = _tangent_of_multiple(_half_angle(_half_angle(_half_angle(half))), Fraction(8, 3))
    return 2 * sixth * (1 + t1 * t2) / ((1 - t1) * (1 - t2))


def _strength(k, convex, concave):
    """The strength that a principal curvature is bent with: convexities are negative."""
    return jnp.where(k < 0, convex, concave)


def _divided_difference(k1, k2, convex, concave):
    """(lam(k1) - lam(k2)) / (k1 - k2), and lam'(k1) where both are equal."""
    alpha1, alpha2 = _strength(k1, convex, concave), _strength(k2, convex, concave)
    x1, x2 = _scaled_curvature(k1, alpha1), _scaled_curvature(k2, alpha2)
    gap = k1 - k2
    dx = jnp.where(alpha1 == alpha2, _scaled_curvature(gap, alpha1), x1 - x2)
    difference = _factor_difference(x1, x2, dx)
    return jnp.where(gap == 0, alpha1 * _factor_slope(x1), difference / jnp.where(gap == 0, 1, gap))


@jax.custom_jvp
def spectral(hessian, convex, concave):
    """lam(H) of `[..., 3]` with strengths [...] of negative and of positive curvatures; see `warp_tensor`."""
    return numerics.matrix_function(
        hessian,
        lambda k: _factor(_scaled_curvature(k, _strength(k, convex, concave))),
        lambda k1, k2: _divided_difference(k1, k2, convex, concave),
    )


@spectral.defjvp
def _spectral_jvp(primals, tangents):
    """Daleckii-Krein without eigenvectors: with D the deviator of H, r its length and c = D/r (0 at umbilics),

        d mean     = (f1' (dHm + dr) + f2' (dHm - dr)) / 2 + d alpha (g1 + g2) / 2,      dr = c . dD
        d deviator = (f1' (dHm + dr) - f2' (dHm - dr)) / 2 c + f[k1, k2] (dD - c dr) + d alpha (g1 - g2) / 2 c

    f' = alpha h(alpha k), g = k h(alpha k). Every factor is bounded; autodiff of the value would divide by r^2.
    """
    hessian, convex, concave = primals
    dh, d_convex, d_concave = tangents
    k1, k2 = numerics.eigenvalues(hessian)
    d, xy = 0.5 * hessian[..., 0] - 0.5 * hessian[..., 2], hessian[..., 1]
    r = numerics.safe_hypot(d, xy)
    cd, cx = numerics.safe_divide(d, r), numerics.safe_divide(xy, r)
    dd, dx, mean = 0.5 * dh[..., 0] - 0.5 * dh[..., 2], dh[..., 1], 0.5 * dh[..., 0] + 0.5 * dh[..., 2]
    dr = cd * dd + cx * dx

    def along(k, dk):
        alpha, d_alpha = _strength(k, convex, concave), _strength(k, d_convex, d_concave)
        return _factor_slope(_scaled_curvature(k, alpha)) * (alpha * dk + k * d_alpha)

    f1, f2 = along(k1, mean + dr), along(k2, mean - dr)
    slope = _divided_difference(k1, k2, convex, concave)
    change, mean = 0.5 * f1 - 0.5 * f2, 0.5 * f1 + 0.5 * f2
    dd = change * cd + slope * (dd - cd * dr)
    dx = change * cx + slope * (dx - cx * dr)
    return spectral(hessian, convex, concave), jnp.stack([mean + dd, dx, mean - dd], axis=-1)


def warp_tensor(hessian, alpha, *, concave=1.0):
    """The warp tensor `lam(H)`, lam(k) = tan(atan(alpha k)/6 + pi/4), as a matrix function of the Hessian.

    Source: LW09 5.1; SPEC 5 and 3 (spectral functions without eigenvectors).
    hessian: [..., 3] (xx, xy, yy), 1/px; any finite value. alpha: [] or [...], px, any finite value; `-alpha` gives the
    inverse tensor. concave: [] or [...]: the strength of positive (concave) curvatures relative to alpha.
    Returns [..., 3], positive definite, eigenvalues in [tan(pi/6), tan(pi/3)]; the identity, exactly, where alpha = 0
    or the Hessian is 0 (as off the mask).
    Gradient: exact in hessian and alpha, umbilics included; finite everywhere. With concave != 1 it has a kink where a
    curvature is 0.
    Errors: ValueError for a last axis other than 3, or a concrete alpha or concave that is not finite.
    """
    checks.check_shape("hessian", hessian, (..., 3))
    checks.check_finite("alpha", alpha)
    checks.check_finite("concave", concave)
    dtype = checks.float_dtype(hessian)
    hessian = jnp.asarray(hessian, dtype)
    alpha, concave = (jnp.broadcast_to(jnp.asarray(a, dtype), hessian.shape[:-1]) for a in (alpha, concave))
    return spectral(hessian, alpha, alpha * concave)


# ------------------------------------------------------------------------------------------- warped directions


def _aligned(direction, tensor):
    checks.check_shape("direction", direction, (..., 3))
    checks.check_shape("tensor", tensor, (..., 3))
    dtype = checks.float_dtype(direction, tensor)
    shape = np.broadcast_shapes(np.shape(direction), np.shape(tensor))
    return jnp.broadcast_to(jnp.asarray(direction, dtype), shape), jnp.broadcast_to(jnp.asarray(tensor, dtype), shape)


def _inverse(tensor):
    det = numerics.determinant(tensor)
    return jnp.stack([tensor[..., 2], -tensor[..., 1], tensor[..., 0]], axis=-1) / det[..., None]


def _stretch(l, tensor):
    """(L p, e) of the module's formula."""
    px, py, z = l[..., 0], l[..., 1], l[..., 2]
    xx, xy, yy = tensor[..., 0], tensor[..., 1], tensor[..., 2]
    # rho depends on the direction of p alone: a constant scale keeps its squares from underflowing near the poles.
    scale = lax.stop_gradient(jnp.maximum(jnp.abs(px), jnp.abs(py)))
    pole = scale == 0
    scale = jnp.where(pole, 1, scale)
    qx, qy = jnp.where(pole, 1, px / scale), py / scale
    dx, dy = (xx - 1) * qx + xy * qy, xy * qx + (yy - 1) * qy
    excess = (dx * (2 * qx + dx) + dy * (2 * qy + dy)) / (qx * qx + qy * qy)  # rho - 1
    # At a pole every p is as good as another: the geometric mean of the eigenvalues of L^2 favours none.
    excess = jnp.where(pole, numerics.determinant(tensor) - 1, excess)
    below = z < 0
    v = jnp.where(below, 1 - z, (px * px + py * py) / jnp.where(below, 1, 1 + z))
    return xx * px + xy * py, xy * px + yy * py, 0.5 * excess * v


def _warp(l, tensor):
    x, y, e = _stretch(l, tensor)
    return jnp.stack([x, y, l[..., 2] - e], axis=-1) / (1 + e)[..., None]


def warp(direction, tensor):
    """W: bends directions towards (where the surface is concave) or away from the view axis.

    Source: LW09 5.2; SPEC 5. direction: [..., 3], unit. tensor: [..., 3], the warp tensor; leading axes broadcast.
    Returns [..., 3], unit; both poles are fixed; the identity tensor returns `direction` bit for bit.
    Gradient: exact in both, in the coordinates of the ambient space; finite everywhere, at the pole -z a convention.
    Errors: ValueError for a last axis other than 3.
    """
    return _warp(*_aligned(direction, tensor))


def unwarp(direction, tensor):
    """W^-1: the direction that `warp` takes to `direction`.

    Source, arguments, returns, gradient and errors as `warp`; `tensor` is the same tensor, not its inverse.
    """
    l, tensor = _aligned(direction, tensor)
    return _warp(l, _inverse(tensor))


def warp_jacobian(direction, tensor):
    """J = dl/dl': the solid angle of unwarped directions per solid angle of warped ones.

    Source: SPEC 5; TH10 appendix A, corrected; `det(L^-1) / (1 + e)^2` with e of the inverse map.
    direction: [..., 3], unit, the *warped* direction l'. tensor: [..., 3], the warp tensor; leading axes broadcast.
    Returns [...], in [1/9, 9] up to rounding; its integral over the sphere is 4 pi; 1 for the identity tensor. At
    l' = -z, where J depends on the side it is approached from, it is det(L), the limit for an umbilic.
    Gradient: exact in both off that pole, finite at it. Errors: ValueError for a last axis other than 3.
    """
    l, tensor = _aligned(direction, tensor)
    inverse = _inverse(tensor)
    *_, e = _stretch(l, inverse)
    return numerics.determinant(inverse) / (1 + e) ** 2
