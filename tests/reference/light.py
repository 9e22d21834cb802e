"""Light warping and radiance scaling from the printed formulas, float64, with eigenvectors."""

import numpy as np

from tests.reference.brdf import ashikhmin_shirley


def principal(hessian):
    """(k [..., 2], q [..., 2, 2]): k1 >= k2 and the unit eigenvectors as columns, by LAPACK."""
    h = np.asarray(hessian, np.float64)
    full = np.stack([h[..., 0], h[..., 1], h[..., 1], h[..., 2]], -1).reshape(*h.shape[:-1], 2, 2)
    k, q = np.linalg.eigh(full)
    return k[..., ::-1], q[..., ::-1]


def factor(k, alpha):
    """lam of SPEC 5."""
    return np.tan(np.arctan(alpha * k) / 6 + np.pi / 4)


def warp_tensor(hessian, alpha):
    k, q = principal(hessian)
    full = np.einsum("...ij,...j,...kj->...ik", q, factor(k, np.asarray(alpha)[..., None]), q)
    return np.stack([full[..., 0, 0], full[..., 0, 1], full[..., 1, 1]], -1)


def _principal_frame(l, q):
    """Components of l along the two principal directions and the view axis."""
    u, v = q[..., 0], q[..., 1]
    return u[..., 0] * l[..., 0] + u[..., 1] * l[..., 1], v[..., 0] * l[..., 0] + v[..., 1] * l[..., 1], l[..., 2]


def warp(l, hessian, alpha):
    """W of LW09: stereographic coordinates along the principal directions, scaled by lam, and back."""
    k, q = principal(hessian)
    lam = factor(k, np.asarray(alpha)[..., None])
    a, b, c = _principal_frame(l, q)
    # Below the horizon 1 + l_z = (a^2 + b^2)/(1 - l_z), as SPEC 5 says.
    w = np.where(c < 0, (a * a + b * b) / (1 - np.minimum(c, 0)), 1 + c)
    s, t = lam[..., 0] * a / w, lam[..., 1] * b / w
    m = 1 + s * s + t * t
    a, b, c = 2 * s / m, 2 * t / m, (1 - s * s - t * t) / m
    u, v = q[..., 0], q[..., 1]
    return np.stack([u[..., 0] * a + v[..., 0] * b, u[..., 1] * a + v[..., 1] * b, c], -1)


def unwarp(l, hessian, alpha):
    return warp(l, hessian, -np.asarray(alpha))


def jacobian(l, hessian, alpha):
    """J of SPEC 5 as printed there."""
    k, q = principal(hessian)
    lam = factor(k, np.asarray(alpha)[..., None])
    lu, lv = lam[..., 0], lam[..., 1]
    a, b, c = _principal_frame(l, q)
    w = np.where(c < 0, (a * a + b * b) / (1 - np.minimum(c, 0)), 1 + c)
    return 4 * lu**3 * lv**3 * w**2 / (lu**2 * lv**2 * w**2 + lv**2 * a**2 + lu**2 * b**2) ** 2


def shade_warped(normal, hessian, direction, radiance, diffuse, specular, shininess, alpha=0.0, gamma=0.0):
    """Eq. 2 with eq. 3: normal, hessian [..., 3], lights [N, 3]; diffuse [3] or [..., 3]. Returns [..., 3]."""
    n = np.asarray(normal, np.float64)
    e = np.array([0.0, 0.0, 1.0])
    total = np.zeros(n.shape)
    for l2, colour in zip(np.asarray(direction, np.float64), np.asarray(radiance, np.float64), strict=True):
        l2 = np.broadcast_to(l2, n.shape)
        l = unwarp(l2, hessian, alpha)
        nl, nl2 = np.sum(n * l, -1), np.sum(n * l2, -1)
        rho = ashikhmin_shirley(n, l, e, diffuse, specular, shininess)
        weight = np.where((nl > 0) & (nl2 > 0), nl * jacobian(l2, hessian, alpha), 0.0)
        total += rho * weight[..., None] * colour
    k, _ = principal(hessian)
    contrast = np.prod(factor(k, np.asarray(alpha)[..., None]), -1) ** gamma
    return total * contrast[..., None]


def radiance_scale(kappa, delta, a, gamma):
    """TH10 eq. 5.5 as printed; it cancels in float32, which is why the package writes it differently."""
    e = np.exp(gamma * kappa)
    return (a * e + delta * (1 - a * (1 + e))) / (a + delta * (e - a * (1 + e)))


def curvature_mapping(hessian, l, anisotropy):
    """tanh of the mean curvature plus the half difference along the two principal directions."""
    k, q = principal(hessian)
    a, b, _ = _principal_frame(l, q)
    half = 0.5 * (k[..., 0] - k[..., 1])
    return np.tanh(0.5 * (k[..., 0] + k[..., 1]) + anisotropy * half * (a * a - b * b))


def shade_scaled(normal, hessian, direction, radiance, diffuse, specular, shininess, a, gammas, anisotropy, alpha=0.0):
    """TH10 5.3 light by light; with alpha the lights are warped, kappa and delta taken at the unwarped directions."""
    n = np.asarray(normal, np.float64)
    e = np.array([0.0, 0.0, 1.0])
    total = np.zeros(n.shape)
    for l2, colour in zip(np.asarray(direction, np.float64), np.asarray(radiance, np.float64), strict=True):
        l2 = np.broadcast_to(l2, n.shape)
        l = unwarp(l2, hessian, alpha)
        nl, nl2 = np.sum(n * l, -1), np.sum(n * l2, -1)
        h = (l + e) / np.linalg.norm(l + e, axis=-1, keepdims=True)
        nh = np.sum(n * h, -1)
        kappa = curvature_mapping(hessian, l, anisotropy)
        parts = [ashikhmin_shirley(n, l, e, d, s, shininess) for d, s in ((diffuse, specular), (np.zeros(3), specular))]
        both = [parts[0] - parts[1], parts[1]]
        levels = [np.clip(nl, 0, 1), np.clip(nh, 0, 1)]
        weight = np.where((nl > 0) & (nl2 > 0), nl * jacobian(l2, hessian, alpha), 0.0)
        for part, level, gamma in zip(both, levels, gammas, strict=True):
            total += part * (radiance_scale(kappa, level, a, gamma) * weight)[..., None] * colour
    return total
