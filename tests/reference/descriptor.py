"""Analytic G-buffers with their exact Hessians, and plain NumPy twins of SPEC 3, float64, written for reading.

Heights are in pixels unless said otherwise, x right, y up, the origin in the image's middle.
"""

import numpy as np


def pixel_grid(height, width, spacing=1.0):
    """(x, y) of the pixel centres, y up."""
    x = (np.arange(width) + 0.5 - width / 2) * spacing
    y = (height / 2 - np.arange(height) - 0.5) * spacing
    return np.meshgrid(x, y)


def from_height(x, y, z, gx, gy, mask=None):
    """G-buffer fields of an orthographic height field (towards the viewer) with slopes gx, gy."""
    mask = np.ones(x.shape, bool) if mask is None else mask
    n = np.stack([-gx, -gy, np.ones_like(gx)], -1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    depth = 1000.0 - z
    position = np.stack([x, y, -depth], -1)
    return {
        "mask": mask,
        "depth": np.where(mask, depth, 0),
        "normal": np.where(mask[..., None], n, 0),
        "position": np.where(mask[..., None], position, 0),
    }


# ------------------------------------------------------------------------------------------- (fields, Hessian)


def waves(height, width, wavelength=64.0, amplitude=5.0, mask=None):
    """z = A sin(kx) cos(0.7 ky)."""
    x, y = pixel_grid(height, width)
    k = 2 * np.pi / wavelength
    m = 0.7 * k
    sx, cx, sy, cy = np.sin(k * x), np.cos(k * x), np.sin(m * y), np.cos(m * y)
    z = amplitude * sx * cy
    hessian = amplitude * np.stack([-k * k * sx * cy, -k * m * cx * sy, -m * m * sx * cy], -1)
    return from_height(x, y, z, amplitude * k * cx * cy, -amplitude * m * sx * sy, mask), hessian


def paraboloid(height, width, hessian=(-0.01, 0.004, 0.006), mask=None):
    """z = p^T H p / 2: its slope is linear."""
    x, y = pixel_grid(height, width)
    a, b, c = hessian
    z = 0.5 * (a * x * x + 2 * b * x * y + c * y * y)
    fields = from_height(x, y, z, a * x + b * y, b * x + c * y, mask)
    return fields, np.broadcast_to(np.array(hessian), (height, width, 3))


def sphere(height, width, radius, centre=(0.0, 0.0)):
    """The front half of a sphere: g = -p / z, H = -(1/z) (I + p p^T / z^2)."""
    x, y = pixel_grid(height, width)
    x, y = x - centre[0], y - centre[1]
    q = radius**2 - x * x - y * y
    mask = q > 0
    z = np.sqrt(np.where(mask, q, 1))
    h = -np.stack([1 + (x / z) ** 2, x * y / z**2, 1 + (y / z) ** 2], -1) / z[..., None]
    return from_height(x, y, z, -x / z, -y / z, mask), np.where(mask[..., None], h, 0)


def torus(height, width, ring, tube):
    """The upper half of a torus that lies in the image plane: z = sqrt(tube^2 - (r - ring)^2)."""
    x, y = pixel_grid(height, width)
    r = np.hypot(x, y)
    r = np.where(r == 0, 1e-9, r)
    w = r - ring
    q = tube**2 - w * w
    mask = q > 0
    z = np.sqrt(np.where(mask, q, 1))
    slope, bend = -w / z, -(tube**2) / z**3  # dz/dr, d2z/dr2
    ux, uy = x / r, y / r
    h = np.stack(
        [
            bend * ux * ux + slope / r * uy * uy,
            (bend - slope / r) * ux * uy,
            bend * uy * uy + slope / r * ux * ux,
        ],
        -1,
    )
    return from_height(x, y, z, slope * ux, slope * uy, mask), np.where(mask[..., None], h, 0)


def traced_spheres(height, width, spheres, fov_degrees=40.0):
    """Spheres (centre [3] in camera space, radius) in perspective; also returns the index seen, -1 for none."""
    size = 2 * np.tan(np.deg2rad(fov_degrees) / 2) / height
    x, y = pixel_grid(height, width, size)
    ray = np.stack([x, y, -np.ones_like(x)], -1)
    best = np.full(x.shape, np.inf)
    index = np.full(x.shape, -1)
    for i, (centre, radius) in enumerate(spheres):
        c = np.asarray(centre, float)
        a, b, d = (ray * ray).sum(-1), (ray * c).sum(-1), (c * c).sum() - radius**2
        disc = b * b - a * d
        t = (b - np.sqrt(np.maximum(disc, 0))) / a
        hit = (disc > 0) & (t > 0) & (t < best)
        best, index = np.where(hit, t, best), np.where(hit, i, index)
    mask = index >= 0
    t = np.where(mask, best, 1)
    position = ray * t[..., None]
    centres = np.array([c for c, _ in spheres], float)
    normal = position - centres[np.maximum(index, 0)]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    on = mask[..., None]
    fields = {
        "mask": mask,
        "depth": np.where(mask, t, 0),
        "normal": np.where(on, normal, 0),
        "position": np.where(on, position, 0),
    }
    return fields, index
