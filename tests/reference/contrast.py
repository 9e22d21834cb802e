"""Contrast as SPEC 12 has it, float64, one pixel at a time where that is clearest."""

import numpy as np


def _luminance(image, mask):
    """Luminance [K] of the pixels that count, and which they are [H, W]."""
    image = np.asarray(image, np.float64)
    if image.ndim == 2:
        y, counts = image, mask & np.isfinite(image)
    else:
        y, counts = image @ np.array([0.2126, 0.7152, 0.0722]), mask & np.isfinite(image).all(-1)
    return np.where(counts, np.maximum(np.where(counts, y, 0), 0), 0), counts


def rms(image, mask):
    y, counts = _luminance(image, mask)
    y = y[counts]
    return y.std() / y.mean() if y.size and y.mean() > 0 else 0.0


def michelson(image, mask, inner=0.005, outer=0.015):
    """The quantile function is a staircase: pixel k (sorted) from k/n to (k+1)/n; its mean over the two tails."""
    y, counts = _luminance(image, mask)
    y = np.sort(y[counts])
    n = y.size
    if n == 0:
        return 0.0

    def mean_between(a, b):
        total = 0.0
        for k in range(n):
            total += y[k] * max(0.0, min((k + 1) / n, b) - max(k / n, a))
        return total / (b - a)

    low, high = mean_between(inner, outer), mean_between(1 - outer, 1 - inner)
    return (high - low) / (high + low) if high + low > 0 else 0.0


def band(image, mask, scale=2.0, step=0.2):
    """Heat flow between neighbours that both count: fine blur less coarse blur, rms over mean."""
    y, counts = _luminance(image, mask)
    if not counts.any() or y[counts].mean() == 0:
        return 0.0
    height, width = y.shape
    steps = max(1, round(scale**2 / (2 * step)))

    def flow(u, times):
        for _ in range(times):
            new = u.copy()
            for i in range(height):
                for j in range(width):
                    for di, dj in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                        a, b = i + di, j + dj
                        if 0 <= a < height and 0 <= b < width and counts[i, j] and counts[a, b]:
                            new[i, j] += step * (u[a, b] - u[i, j])
            u = new
        return u

    fine = flow(y, steps)
    coarse = flow(fine, 3 * steps)
    return np.sqrt(np.mean((fine - coarse)[counts] ** 2)) / y[counts].mean()
