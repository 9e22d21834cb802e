"""Diffusion in plain NumPy, float64: explicit steps pixel by pixel, and the exact semi-discrete heat flow."""

import numpy as np


def links(c):
    """Harmonic means of neighbouring conductances."""

    def mean(a, b):
        return 2 * a * b / np.where(a + b > 0, a + b, 1)

    return mean(c[:, :-1], c[:, 1:]), mean(c[:-1], c[1:])


def explicit(u, link_x, link_y, budget, step=0.2):
    """Explicit steps of one plane; `budget` a number or a map."""
    h, w = u.shape
    budget = np.broadcast_to(np.asarray(budget, float), (h, w))
    u, k = u.copy(), 0
    while (budget - k * step > 1e-12).any():
        new = u.copy()
        for r in range(h):
            for c in range(w):
                flow = 0.0
                for rr, cc, link in (
                    (r, c + 1, link_x[r, c] if c + 1 < w else 0),
                    (r, c - 1, link_x[r, c - 1] if c > 0 else 0),
                    (r + 1, c, link_y[r, c] if r + 1 < h else 0),
                    (r - 1, c, link_y[r - 1, c] if r > 0 else 0),
                ):
                    if link:
                        flow += link * (u[rr, cc] - u[r, c])
                new[r, c] = u[r, c] + min(max(budget[r, c] - k * step, 0), step) * flow
        u, k = new, k + 1
    return u


def heat_flow(u, link_x, link_y, time):
    """exp(time A) u, by Chebyshev expansion on the spectrum of A, which lies in [-8, 0]."""
    from scipy.special import ive

    def a(v):
        out = np.zeros_like(v)
        fx, fy = link_x * (v[..., 1:] - v[..., :-1]), link_y * (v[..., 1:, :] - v[..., :-1, :])
        out[..., :-1] += fx
        out[..., 1:] -= fx
        out[..., :-1, :] += fy
        out[..., 1:, :] -= fy
        return out

    z = 4 * time
    before, now = u, u + a(u) / 4
    total = ive(0, z) * before + 2 * ive(1, z) * now
    for k in range(2, int(30 + 6 * np.sqrt(2 * z))):
        before, now = now, 2 * (now + a(now) / 4) - before
        total = total + 2 * ive(k, z) * now
    return total


def gaussian(u, sigma):
    """Gaussian of `sigma` px with reflecting borders, spectrally: each cosine mode decays by exp(-sigma^2 w^2 / 2)."""
    from scipy.fft import dctn, idctn

    h, w = u.shape
    wy, wx = np.pi * np.arange(h) / h, np.pi * np.arange(w) / w
    decay = np.exp(-0.5 * sigma**2 * (wy[:, None] ** 2 + wx[None] ** 2))
    return idctn(decay * dctn(u, norm="ortho"), norm="ortho")
