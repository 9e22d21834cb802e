"""Height fields with closed forms: sphere, torus, ellipsoid, saddle, cylinder; float64 NumPy.

`height(name, n)` is z(x, y) with its derivatives, for pixels n times as fine; heights and places in pixels.
"""

import numpy as np

SIZE = (36, 44)


def derivatives(name, n, x, y):
    """(z, (z_x, z_y), (z_xx, z_xy, z_yy), inside)."""
    if name == "torus":
        ring, tube = 12.0 * n, 9.0 * n
        r = np.maximum(np.hypot(x, y), 1e-9)
        q = tube**2 - (r - ring) ** 2
        z = np.sqrt(np.maximum(q, 1e-9))
        slope, bend = -(r - ring) / z, -(tube**2) / z**3
        ux, uy = x / r, y / r
        along = slope / r
        second = bend * ux**2 + along * uy**2, (bend - along) * ux * uy, bend * uy**2 + along * ux**2
        return z, (slope * ux, slope * uy), second, (q > 0) & (r > n)
    if name == "saddle":
        size, k = 8.0 * n, 1 / (14.0 * n)
        sx, cx, sy, cy = np.sin(k * x), np.cos(k * x), np.sin(k * y), np.cos(k * y)
        second = -size * k * k * sx * sy, size * k * k * cx * cy, -size * k * k * sx * sy
        return size * sx * sy, (size * k * cx * sy, size * k * sx * cy), second, np.ones_like(x, bool)
    a, b, c = {
        "sphere": (16.3, 16.3, 16.3),
        "ellipsoid": (21.0, 14.0, 10.0),
        "cylinder": (17.2, np.inf, 17.2),
    }[name]
    a, b, c = a * n, b * n, c * n
    q = 1 - (x / a) ** 2 - (y / b) ** 2
    w = np.sqrt(np.maximum(q, 1e-9))
    p, s = x / a**2, y / b**2
    second = -c / w * (1 / a**2 + p * p / q), -c / w * (p * s / q), -c / w * (1 / b**2 + s * s / q)
    return c * w, (-c * p / w, -c * s / w), second, q > 0


def fields(name, n):
    """(fields of a G-buffer, Hessian [H, W, 3], apparent curvature [H, W, 3], inside and gentle [H, W] bool)."""
    h, w = SIZE[0] * n, SIZE[1] * n
    x, y = np.meshgrid(np.arange(w) + 0.5 - w / 2, h / 2 - np.arange(h) - 0.5)
    z, first, second, inside = derivatives(name, n, x, y)
    normal = unit_normal(first)
    on = inside[..., None]
    depth = 1000.0 - z
    record = {
        "mask": inside,
        "depth": np.where(inside, depth, 0),
        "normal": np.where(on, normal, 0),
        "position": np.where(on, np.stack([x, y, -depth], -1), 0),
    }
    return record, np.stack(second, -1), apparent(name, n, x, y, second), inside & (normal[..., 2] > 0.4)


def unit_normal(first):
    n = np.stack([-first[0], -first[1], np.ones_like(first[0])], -1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def apparent(name, n, x, y, second):
    """q t t^T: largest singular value of dn/d(x, y) by tiny differences, and its direction (Judd et al. 2007)."""
    e = 1e-4
    at = lambda dx, dy: unit_normal(derivatives(name, n, x + dx, y + dy)[1])  # noqa: E731
    jacobian = np.stack([at(e, 0) - at(-e, 0), at(0, e) - at(0, -e)], -1) / (2 * e)  # [H, W, 3, 2]
    _, values, rows = np.linalg.svd(jacobian)
    t = rows[..., 0, :]
    bend = second[0] * t[..., 0] ** 2 + 2 * second[1] * t[..., 0] * t[..., 1] + second[2] * t[..., 1] ** 2
    q = np.where(bend > 0, values[..., 0], -values[..., 0])
    return q[..., None] * np.stack([t[..., 0] ** 2, t[..., 0] * t[..., 1], t[..., 1] ** 2], -1)


def patch(name, count):
    """(vertices [V, 3], faces, normals, principal curvatures [V, 2] ascending, inner [V] bool) of a mesh with exact
    normals over the middle of the surface."""
    side = np.linspace(-7.0, 7.0, count)
    x, y = np.meshgrid(side, side)
    x = x + 0.1 * y  # no symmetry that could cancel errors
    x = x + (12.0 if name == "torus" else 0)
    z, first, second, _ = derivatives(name, 1, x, y)
    n = unit_normal(first)
    i = np.arange(count * count).reshape(count, count)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
    # the shape operator's eigenvalues: K and H from z's derivatives
    w = 1 + first[0] ** 2 + first[1] ** 2
    gauss = (second[0] * second[2] - second[1] ** 2) / w**2
    mean = (1 + first[1] ** 2) * second[0] - 2 * first[0] * first[1] * second[1] + (1 + first[0] ** 2) * second[2]
    mean = mean / (2 * w**1.5)
    r = np.sqrt(np.maximum(mean**2 - gauss, 0))
    inner = np.zeros((count, count), bool)
    inner[2:-2, 2:-2] = True
    rows = lambda v: v.reshape(count * count, -1)  # noqa: E731
    k = np.stack([mean - r, mean + r], -1)
    return np.stack([x, y, z], -1).reshape(-1, 3), faces, rows(n), rows(k), inner.ravel()
