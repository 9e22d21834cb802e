"""Subpixel reconstruction antialiasing by brute force (Chajdas et al. 2011), in float64. NumPy only.

Every sample of every pixel is compared with each of the 3 x 3 pixels around: no list, no shortcut, but for the rule
that a pixel inside of the image whose 8 neighbours show its own surface keeps its own shading.
"""

import numpy as np

from tests.reference.raster import clip_coordinates

PLANE, NORMAL, NEARER = (0.5, 2.0), (0.25, 1.0), 1e-3


def ramp(x, ends):
    return np.clip((x - ends[0]) / (ends[1] - ends[0]), 0, 1)


def mismatch(p, n, q, m, size):
    gap = p - q
    off = np.maximum(np.abs((n * gap).sum(-1)), np.abs((m * gap).sum(-1))) / size
    return np.maximum(ramp(off, PLANE), ramp(np.linalg.norm(n - m, axis=-1), NORMAL))


def footprint(z, projection, height, width):
    w = projection[3, 2] * z + projection[3, 3]
    return 2 * w / min(height * abs(projection[1, 1]), width * abs(projection[0, 0]))


def surface(mesh, camera, triangle):
    """Camera-space position and normal at every pixel of an image of ids, not held at the outline."""
    height, width = triangle.shape
    view = np.asarray(camera.view, np.float64)
    clip = clip_coordinates(mesh.vertices, camera.view, camera.projection)
    vertices, normals = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.normals, np.float64)
    position, normal = np.zeros((height, width, 3)), np.zeros((height, width, 3))
    for y, x in zip(*np.nonzero(triangle >= 0), strict=True):
        face = np.asarray(mesh.faces)[triangle[y, x]]
        corners = clip[face][:, [0, 1, 3]].T
        beta = np.linalg.solve(corners, [(x + 0.5) * 2 / width - 1, 1 - (y + 0.5) * 2 / height, 1.0])
        b = beta / beta.sum()
        position[y, x] = view[:3, :3] @ (b @ vertices[face]) + view[:3, 3]
        a, c, d = vertices[face] @ view[:3, :3].T + view[:3, 3]
        outward = np.cross(c - a, d - a)
        if view[:3, :3] @ normals[face].sum(0) @ outward * np.sign(np.linalg.det(corners)) < 0:
            normals_here = -normals[face]
        else:
            normals_here = normals[face]
        n = view[:3, :3] @ (b @ normals_here)
        n = n / np.linalg.norm(n)
        n[2] = max(n[2], 0.01)
        normal[y, x] = n / np.linalg.norm(n)
    return position, normal


def scores(mesh, camera, mask, position, normal, fine, samples):
    """keeps [H, W]: own shading, not compared; scores [H, W, S * S, 9]: the least is taken, 9 = nothing there."""
    height, width = mask.shape
    mask, position, normal = (np.asarray(a) for a in (mask, position, normal))
    projection = np.asarray(camera.projection, np.float64)
    at, turned = surface(mesh, camera, fine)
    keeps = mask.copy()
    result = np.full((height, width, samples * samples, 9), 9.0)
    for y in range(height):
        for x in range(width):
            for k in range(9):
                v, u = y + k // 3 - 1, x + k % 3 - 1
                if not (0 <= v < height and 0 <= u < width):
                    keeps[y, x] = False
                    continue
                if not mask[v, u]:
                    keeps[y, x] = False
                    continue
                p, n = position[v, u], normal[v, u]
                if mask[y, x]:
                    size = footprint(max(p[2], position[y, x, 2]), projection, height, width)
                    keeps[y, x] &= mismatch(p, n, position[y, x], normal[y, x], size) == 0
                for s in range(samples * samples):
                    fy, fx = y * samples + s // samples, x * samples + s % samples
                    if fine[fy, fx] < 0:
                        continue
                    size = footprint(max(p[2], at[fy, fx, 2]), projection, height, width)
                    dy = k // 3 - 1 - ((s // samples + 0.5) / samples - 0.5)
                    dx = k % 3 - 1 - ((s % samples + 0.5) / samples - 0.5)
                    off = mismatch(at[fy, fx], turned[fy, fx], p, n, size)
                    result[y, x, s, k] = off + NEARER * (dx * dx + dy * dy)
    return keeps, result


def resolve(image, source):
    """The mean over the samples of what they borrow."""
    square = source.shape[-1]
    out = np.zeros(np.shape(image))
    for y, x, s in zip(*np.nonzero(source >= 0), strict=True):
        k = int(source[y, x, s])
        out[y, x] += np.asarray(image, np.float64)[y + k // 3 - 1, x + k % 3 - 1] / square
    return out
