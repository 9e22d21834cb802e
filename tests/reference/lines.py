"""Feature lines in plain float64 NumPy, pixel by pixel, written from SPEC 9 and 10."""

import math

import numpy as np
from scipy.spatial import KDTree

# ------------------------------------------------------------------------------------------- profiles


def hermite(low, high, x):
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3 - 2 * t)


def bilinear(image, x, y):
    """The value at column x, row y of an image (pixel centres at integers); clamped at the border."""
    h, w = image.shape[:2]
    x, y = min(max(x, 0.0), w - 1.0), min(max(y, 0.0), h - 1.0)
    i, j = min(int(y), max(h - 2, 0)), min(int(x), max(w - 2, 0))
    i1, j1 = min(i + 1, h - 1), min(j + 1, w - 1)
    v, u = y - i, x - j
    return (1 - v) * ((1 - u) * image[i, j] + u * image[i, j1]) + v * ((1 - u) * image[i1, j] + u * image[i1, j1])


def without_singular(height, gamma):
    """Heights with a ring of one pixel around them; where they are singular, extrapolated from their neighbours."""
    h, w = height.shape
    height = np.pad(np.asarray(height, np.float64), 3)
    weight = np.pad(np.array([[1 - hermite(0.5, 1, g) for g in row] for row in gamma]), 3)
    out = height.copy()
    for i in range(2, h + 4):
        for j in range(2, w + 4):
            first, second = [], []
            for di, dj in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
                a, b = (i + di, j + dj), (i + 2 * di, j + 2 * dj)
                first.append((weight[a], height[a]))
                second.append((weight[a] * weight[b], 2 * height[a] - height[b]))
            for pairs in (second, first):
                total = sum(p[0] for p in pairs)
                if total > 0:
                    mean = sum(p[0] * p[1] for p in pairs) / total
                    break
            else:
                mean = 0.0
            out[i, j] = weight[i, j] * height[i, j] + (1 - weight[i, j]) * mean
    return out[2:-2, 2:-2]


def barrier(g):
    return min(g * (1 + 2 * hermite(0.1, 0.3, g)), 1.0)


def reach(gamma, i, j, theta, radius):
    """How far a trajectory gets on its worse side, 1 px short of where the accumulated singularity is 1."""
    padded = np.pad(gamma, 2, constant_values=1)
    steps = math.ceil(radius)
    step = radius / steps
    limit = 1 - 1e-3
    if barrier(gamma[i, j]) >= limit:
        return 0.0
    best = radius
    for side in (1, -1):
        total = barrier(gamma[i, j])
        for k in range(1, steps + 1):
            t = side * k * step
            x = min(max(j + t * theta[0], -1), gamma.shape[1])
            y = min(max(i - t * theta[1], -1), gamma.shape[0])
            more = barrier(bilinear(padded, x + 2, y + 2))
            if total + more >= limit:
                best = min(best, (k - 1 + (limit - total) / more) * step - 1)
                break
            total += more
    return best


def profile(height, direction, gamma, radius=4.0, samples=9, least=0.0):
    """(distance, height, curvature, valid) by numpy's own least squares and roots."""
    height, gamma = np.asarray(height, np.float64), np.asarray(gamma, np.float64)
    filled = without_singular(height, gamma)
    out = np.zeros((3, *height.shape))
    valid = np.zeros(height.shape, bool)
    k = samples // 2
    for i, j in np.ndindex(height.shape):
        theta = np.asarray(direction[i, j], np.float64)
        length = np.hypot(*theta)
        if length == 0:
            continue
        theta = theta / length
        r = reach(gamma, i, j, theta, radius)
        if r < 1 - 1e-3:
            continue
        t = np.linspace(-r, r, 2 * k + 1)
        p = np.array([bilinear(filled, j + 1 + s * theta[0], i + 1 - s * theta[1]) for s in t])
        if np.ptp(p) < 1e-13 * np.abs(p).max():
            continue
        cubic = np.polyfit(t, p, 3)
        slope, bend = np.polyder(cubic), np.polyder(cubic, 2)
        for root in np.roots(slope):
            if abs(root.imag) < 1e-9 and abs(root.real) <= r and np.polyval(bend, root.real) < 0:
                top = np.polyval(cubic, root.real)
                if top > least:
                    out[:, i, j] = root.real, top, np.polyval(bend, root.real)
                    valid[i, j] = True
    return *out, valid


# ------------------------------------------------------------------------------------------- singularities


def direction_singularity(direction, mask):
    """1 - mean over the neighbours on the mask of |theta . theta_i|; 1 off the mask (TH10 7.2.1)."""
    h, w = mask.shape
    out = np.ones((h, w))
    for i, j in np.argwhere(mask):
        cosines = [
            abs(np.dot(direction[i, j], direction[a, b]))
            for a in range(max(i - 1, 0), min(i + 2, h))
            for b in range(max(j - 1, 0), min(j + 2, w))
            if (a, b) != (i, j) and mask[a, b]
        ]
        out[i, j] = 1 - np.mean(cosines) if cosines else 1
    return out


def step_borders(gbuffer, camera, least: float) -> np.ndarray:
    """[n, 2, 2]: (row, column) of both ends of the borders between pixels where the surface is torn: either of two
    neighbours lies more than `least` px of depth off the other one's tangent plane, or one is background."""
    mask, position, normal = (np.asarray(a) for a in (gbuffer.mask, gbuffer.position, gbuffer.normal))
    perspective = np.where(mask, np.asarray(gbuffer.depth), 1)
    pixel = 2 * perspective / (mask.shape[0] * float(camera.projection[1, 1]))
    found = []
    for axis in (0, 1):
        a, b = np.arange(mask.shape[axis] - 1), np.arange(1, mask.shape[axis])
        at = lambda image, i: np.take(image, i, axis=axis)  # noqa: E731, B023
        across = at(position, b) - at(position, a)
        off = np.maximum(*(np.abs(np.sum(across * at(normal, i), -1)) for i in (a, b)))
        torn = (off > least * np.minimum(at(pixel, a), at(pixel, b))) & at(mask, a) & at(mask, b)
        first = np.argwhere(torn | (at(mask, a) != at(mask, b)))
        ends = ([0.5, -0.5], [0.5, 0.5]) if axis == 0 else ([-0.5, 0.5], [0.5, 0.5])
        found.append(first[:, None] + np.asarray(ends))
    return np.concatenate(found)


def distance_to_borders(points, borders) -> np.ndarray:
    """[n], px, from points [n, 2] to the nearest of the borders [m, 2, 2]."""
    start, along = borders[:, 0], borders[:, 1] - borders[:, 0]
    near = KDTree(borders.mean(axis=1)).query(points, k=min(24, len(borders)))[1].reshape(len(points), -1)
    apart = points[:, None] - start[near]
    share = np.clip(np.sum(apart * along[near], -1), 0, 1)  # borders are 1 px long
    return np.linalg.norm(apart - share[..., None] * along[near], axis=-1).min(axis=1)


def line_points(profile, field) -> np.ndarray:
    """[n, 2] (row, column) of the skeletons, as the pixels within a pixel of one say."""
    near = np.asarray(profile.valid) & (np.abs(profile.distance) <= 1)
    rows, columns = np.nonzero(near)
    distance, theta = np.asarray(profile.distance)[near], np.asarray(field.direction)[near]
    return np.stack([rows - distance * theta[:, 1], columns + distance * theta[:, 0]], -1)
