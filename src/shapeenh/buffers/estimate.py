"""What a bare point cloud lacks: normals and radii, from each point's nearest neighbours (Hoppe et al. 1992).

Runs in NumPy and SciPy, outside of jit; nothing here has a gradient.
"""

from __future__ import annotations

import numpy as np

from shapeenh.checks import check_finite, check_shape, check_size, check_type, is_concrete
from shapeenh.types import Camera

NEIGHBORS = 12
COVERAGE = 8.0  # discs over each point of the surface


def estimate_normals(points, *, neighbors: int = NEIGHBORS, camera: Camera | None = None) -> np.ndarray:
    """Normals of a point cloud: the direction in which each point's neighbours spread least.

    Args:
        points: [N, 3], N >= 3.
        neighbors: how many, the point itself included, 3 to 1000; more smooth, fewer follow.
        camera: normals are turned towards it; None: away from the cloud's centre.

    Returns: [N, 3], unit, world space, NumPy, float64. Not consistent from point to point where the surface is seen
        edge-on, which `gbuffer_from_points` does not mind.
    Gradient: none.
    Errors: ValueError for other shapes or numbers, fewer than 3 points, and under jit.

    >>> normals = se.estimate_normals(points, camera=camera)
    """
    points = _points(points, neighbors)
    neighborhood = points[_nearest(points, neighbors)[1]]
    offset = neighborhood - neighborhood.mean(axis=1, keepdims=True)
    size = np.abs(offset).max(axis=(1, 2), keepdims=True)
    offset = offset / np.where(size > 0, size, 1)
    normals = np.linalg.eigh(np.swapaxes(offset, 1, 2) @ offset)[1][:, :, 0]
    if camera is None:
        towards = points - points.mean(axis=0)
    else:
        check_type("camera", camera, Camera)
        view, projection = np.asarray(camera.view, np.float64), np.asarray(camera.projection, np.float64)
        eye = -view[:3, :3].T @ view[:3, 3]
        parallel = not np.any(projection[3, :3])
        towards = np.broadcast_to(view[2, :3], points.shape) if parallel else eye - points
    return np.where(np.sum(normals * towards, axis=1, keepdims=True) < 0, -normals, normals)


def estimate_radius(points, *, neighbors: int = NEIGHBORS, coverage: float = COVERAGE) -> np.ndarray:
    """Radii of discs that cover the surface of a point cloud several times over, from its local density.

    Args:
        points: [N, 3], N >= 3.
        neighbors: over how many the density is taken, the point itself included, 3 to 1000.
        coverage: how many discs shall lie over each point of the surface, in [1, 1000]; 8 leaves no holes.

    Returns: [N], world units, > 0, NumPy, float64. Outliers do not get larger than eight times the median.
    Gradient: none.
    Errors: as in `estimate_normals`.

    >>> radius = se.estimate_radius(points)
    """
    points = _points(points, neighbors)
    if not 1 <= coverage <= 1000:
        raise ValueError(f"coverage is {coverage}; accepted are numbers from 1 to 1000")
    distance = _nearest(points, neighbors)[0][:, -1]
    # A disc of the distance to the k-th neighbour holds k points.
    radius = distance * np.sqrt(coverage / min(neighbors, len(points)))
    middle = np.median(radius[radius > 0]) if np.any(radius > 0) else 1.0
    return np.clip(radius, middle / 8, middle * 8)


def _points(points, neighbors) -> np.ndarray:
    check_shape("points", points, (None, 3))
    check_size("neighbors", neighbors, low=3, high=1000)
    if not is_concrete(points):
        raise ValueError("points is traced by a JAX transformation; neighbours are found for concrete points only")
    check_finite("points", points)
    points = np.asarray(points, np.float64)
    if len(points) < 3:
        raise ValueError(f"points has shape {points.shape}; accepted are at least 3 points")
    return points


def _nearest(points, neighbors):
    """(distances, indices) [N, k], the point itself first."""
    from scipy.spatial import cKDTree

    return cKDTree(points).query(points, k=min(neighbors, len(points)), workers=-1)
