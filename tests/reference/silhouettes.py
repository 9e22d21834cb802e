"""Analytic scenes that say where silhouettes are, and the plain Sobel filter of LW09 to compare with; float64 NumPy.

Each scene is (fields of a G-buffer, far [H, W] bool: the pixels on the far side of a step).
"""

import numpy as np

from tests.reference.descriptor import from_height, pixel_grid, sphere, traced_spheres, waves


def pitch(height, fov):
    """World units between pixels at depth 1; of an orthographic view (fov 0) everywhere."""
    return 2 * np.tan(np.deg2rad(fov) / 2) / height if fov else 1 / height


def planes(height, width, slope, step, fov):
    """Two parallel planes z = slope x, the right one `step` pixels farther; `step` 0: one plane."""
    size = pitch(height, fov)
    x, y = pixel_grid(height, width, size)
    right = x > 0
    far = np.zeros(x.shape, bool)
    far[:, np.argmax(right[0])] = step > 0
    if not fov:
        z = slope * x - np.where(right, step * size, 0)
        return from_height(x, y, z, np.full_like(x, slope), np.zeros_like(x)), far
    mask = 1 + slope * x > 0.3  # the rest lies behind the viewer, or far off
    far &= mask
    depth = np.where(mask, (1 + np.where(right, step * size, 0)) / np.where(mask, 1 + slope * x, 1), 0)
    n = np.array([-slope, 0, 1]) / np.hypot(1, slope)
    return {
        "mask": mask,
        "depth": depth,
        "normal": np.broadcast_to(n, (*x.shape, 3)),
        "position": np.stack([x * depth, y * depth, -depth], -1),
    }, far


def ball(height, width, fov):
    """One sphere that fills the image."""
    if not fov:
        return sphere(height, width, 0.49 * height)[0], np.zeros((height, width), bool)
    reach = np.sin(0.49 * np.deg2rad(fov))
    fields, _ = traced_spheres(height, width, [((0, 0, -1), reach)], fov)
    return fields, np.zeros((height, width), bool)


def balls(height, width, fov):
    """One sphere before another."""
    reach = np.sin(0.3 * np.deg2rad(fov))
    spheres = [((-0.5 * reach, 0, -1), reach), ((0.8 * reach, 0.2 * reach, -1 - 2.6 * reach), 1.2 * reach)]
    fields, index = traced_spheres(height, width, spheres, fov)
    far = np.zeros(index.shape, bool)
    for axis in (0, 1):
        a, b = (np.take(index, np.arange(index.shape[axis] - 1) + i, axis) for i in (0, 1))
        seam = (a >= 0) & (b >= 0) & (a != b)
        pair = [np.insert(seam & (a == 1), seam.shape[axis], False, axis), np.insert(seam & (b == 1), 0, False, axis)]
        far |= pair[0] | pair[1]
    return fields, far


def wavy(height, width, steepness):
    """Waves of 24 px whose steepest slope is `steepness`."""
    wavelength = 24.0
    fields, _ = waves(height, width, wavelength=wavelength, amplitude=steepness * wavelength / (2 * np.pi))
    return fields, np.zeros((height, width), bool)


def scaled(scene, factor):
    """The same scene in other world units."""
    fields, far = scene
    return {k: v * factor if k in ("depth", "position") else v for k, v in fields.items()}, far


def sobel_of_log_depth(fields):
    """|grad log depth| by LW09's Sobel filter, per pixel; 0 where the filter leaves the mask."""
    mask = fields["mask"]
    d = np.pad(np.log(np.where(mask, fields["depth"], 1)), 1, mode="edge")
    at = lambda r, c: d[1 + r : d.shape[0] - 1 + r, 1 + c : d.shape[1] - 1 + c]  # noqa: E731
    x = sum(k * (at(r, 1) - at(r, -1)) for r, k in ((-1, 1), (0, 2), (1, 1))) / 8
    y = sum(k * (at(1, c) - at(-1, c)) for c, k in ((-1, 1), (0, 2), (1, 1))) / 8
    on = np.pad(mask, 1, mode="edge")
    whole = np.all([on[r : r + mask.shape[0], c : c + mask.shape[1]] for r, c in np.ndindex(3, 3)], axis=0)
    return np.where(whole, np.hypot(x, y), 0)
