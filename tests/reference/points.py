"""Point splatting as a plain loop over pixels, float64: rays and planes in camera space."""

import numpy as np


def smoothstep(low, high, x):
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def pixel_ray(projection, x, y, height, width):
    """(origin, direction), camera space, of the ray through window coordinates x, y (y down); direction z is -1."""
    ndc = np.array([2 * x / width - 1, 1 - 2 * y / height])

    def at_depth(depth):
        # Solve clip_xy = ndc * w for the camera-space x, y at z = -depth.
        rows = projection[:2] - ndc[:, None] * projection[3][None]
        return np.append(np.linalg.solve(rows[:, :2], -rows[:, 2] * -depth - rows[:, 3]), -depth)

    origin, one = at_depth(0.0), at_depth(1.0)
    return origin, one - origin


def splat(points, normals, radius, view, projection, height, width, *, colors=None, tolerance=1.0, cull="none"):
    """(index of the front disc [H, W], depth [H, W], normal [H, W, 3], colour [H, W, 3])."""
    c = points @ view[:3, :3].T + view[:3, 3]
    n = normals @ view[:3, :3].T
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    parallel = not projection[3, :3].any()
    towards = n[:, 2] if parallel else -np.sum(n * c, axis=1)
    keep = {"none": np.full(len(c), True), "back": towards > 0, "front": towards < 0}[cull]
    n = np.where(towards[:, None] < 0, -n, n)
    w = np.ones(len(c)) if parallel else -c[:, 2]
    scale = np.sqrt(0.25 * height * width * projection[0, 0] * projection[1, 1]) / np.where(w > 0, w, 1)
    r = np.where(w > 0, np.maximum(radius, 0.75 / scale), radius)
    near = -(projection[2, 3] + projection[3, 3]) / -(projection[2, 2] + projection[3, 2])
    homogeneous = np.concatenate([c, np.ones((len(c), 1))], axis=1) @ projection.T
    before = homogeneous[:, 3] > 0  # the eye; other centres have no place in the image, and no part in slopes
    divisor = np.where(before, homogeneous[:, 3], 1)
    px = np.where(before, (homogeneous[:, 0] / divisor + 1) * width / 2, 0)
    py = np.where(before, (1 - homogeneous[:, 1] / divisor) * height / 2, 0)
    size = np.where(before, r * scale, 1e6)

    index = np.full((height, width), -1)
    depth, normal = np.zeros((height, width)), np.zeros((height, width, 3))
    color = np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            o, d = pixel_ray(projection, column + 0.5, row + 0.5, height, width)
            along = n @ d
            t = np.sum(n * (c - o), axis=1) / np.where(along == 0, 1, along)  # = depth, as d_z = -1
            p = o + t[:, None] * d
            rho2 = np.sum((p - c) ** 2, axis=1) / r**2
            hit = keep & (along != 0) & (rho2 <= 1) & (t >= near)
            if not parallel:
                hit &= t > 0
            if not hit.any():
                continue
            front = int(np.argmin(np.where(hit, t, np.inf)))
            index[row, column] = front
            weight = np.where(hit, (1 - np.minimum(rho2, 1)) ** 2 + 1e-3, 0)
            weight *= 1 - smoothstep(0.5, 1, (t - t[front]) / (tolerance * r[front]))
            weight *= smoothstep(0, 0.5, n @ n[front])
            weight /= weight.sum()
            depth[row, column] = weight @ t
            if colors is not None:
                color[row, column] = weight @ colors
            # Weighted least squares of n = n0 + G s about the pixel, with a ridge on G; then n0.
            s = np.stack([px - column - 0.5, py - row - 0.5], axis=1)
            ridge = 0.005 * (weight @ size**2)
            design = np.concatenate([np.ones((len(s), 1)), s], axis=1)
            gram = design.T @ (weight[:, None] * design) + np.diag([0, ridge, ridge])
            fit = np.linalg.solve(gram, design.T @ (weight[:, None] * n))[0]
            fit /= np.linalg.norm(fit)
            fit[2] = max(fit[2], 0.01)
            normal[row, column] = fit / np.linalg.norm(fit)
    return index, depth, normal, color
