"""Ashikhmin-Shirley as SPEC 7 prints it, float64, one direction at a time vectorised by NumPy alone."""

import numpy as np


def ashikhmin_shirley(n, l, e, diffuse, specular, shininess):
    """n, l, e: [..., 3]; diffuse, specular: [3]. Returns [..., 3]; zero behind the surface."""
    nl, ne = np.sum(n * l, -1), np.sum(n * e, -1)
    h = l + e
    length = np.linalg.norm(h, axis=-1, keepdims=True)
    h = np.divide(h, length, out=np.zeros(np.broadcast_shapes(h.shape)), where=length > 0)
    nh, he = np.sum(n * h, -1), np.sum(h * e, -1)
    lit = (nl > 0) & (ne > 0) & (he > 0)
    nl, ne, nh, he = (np.where(lit, a, 1.0) for a in (nl, ne, nh, he))
    rho_d = 28 / (23 * np.pi) * (1 - (1 - nl / 2) ** 5) * (1 - (1 - ne / 2) ** 5)
    rho_s = (shininess + 1) / (8 * np.pi) * nh**shininess / (he * np.maximum(nl, ne))
    fresnel = specular + (1 - specular) * ((1 - he) ** 5)[..., None]
    rho = diffuse * (1 - specular) * rho_d[..., None] + fresnel * rho_s[..., None]
    return np.where(lit[..., None], rho, 0.0)
