"""Images as sources of G-buffers, pixel by pixel, float64; and MikkTSpace as its author describes it."""

import numpy as np


def slope(values, valid, index):
    """Derivative per sample along one line of heights, towards growing index: central, else the one-sided formula of
    second order, else a plain difference, else None."""

    def ok(k):
        return 0 <= k < len(values) and valid[k]

    i = index
    if ok(i - 1) and ok(i + 1):
        return (values[i + 1] - values[i - 1]) / 2
    if ok(i + 1):
        if ok(i + 2):
            return (-3 * values[i] + 4 * values[i + 1] - values[i + 2]) / 2
        return values[i + 1] - values[i]
    if ok(i - 1):
        if ok(i - 2):
            return (3 * values[i] - 4 * values[i - 1] + values[i - 2]) / 2
        return values[i] - values[i - 1]
    return None


def bilinear(texture, u, v, wrap):
    """One lookup; (0, 0) is the lower left corner."""
    h, w, _ = texture.shape
    if wrap == "repeat":
        u, v = u - np.floor(u), v - np.floor(v)
    else:
        u, v = min(max(u, 0), 1), min(max(v, 0), 1)
    x, y = u * w - 0.5, (1 - v) * h - 0.5
    total = np.zeros(texture.shape[2])
    for j in (int(np.floor(y)), int(np.floor(y)) + 1):
        for i in (int(np.floor(x)), int(np.floor(x)) + 1):
            weight = (1 - abs(x - i)) * (1 - abs(y - j))
            row, column = (j % h, i % w) if wrap == "repeat" else (min(max(j, 0), h - 1), min(max(i, 0), w - 1))
            total += weight * texture[row, column]
    return total


def unit(v):
    length = np.linalg.norm(v)
    return v / length if length > 0 else v


def tangents(vertices, faces, normals, uv):
    """Per corner (tangent, sign) [F][3]: each vertex averages the tangents of its faces of equal handedness, projected
    to its normal's plane, weighted by the corner's angle there."""
    total = {}
    for face in faces:
        (a, b, c), (p, q, r) = vertices[face], uv[face]
        e1, e2, d1, d2 = b - a, c - a, q - p, r - p
        area = d1[0] * d2[1] - d1[1] * d2[0]
        sign = np.sign(area)
        direction = sign * (d2[1] * e1 - d1[1] * e2)
        for k in range(3):
            n, here = normals[face[k]], vertices[face[k]]
            flat = lambda v, n=n: unit(v - (v @ n) * n)  # noqa: E731
            one, other = flat(vertices[face[(k + 1) % 3]] - here), flat(vertices[face[(k + 2) % 3]] - here)
            angle = np.arccos(np.clip(one @ other, -1, 1))
            key = (face[k], sign)
            total[key] = total.get(key, 0) + angle * flat(direction)
    signs = []
    for face in faces:
        p, q, r = uv[face]
        signs.append(np.sign((q - p)[0] * (r - p)[1] - (q - p)[1] * (r - p)[0]))
    return [[(unit(total[(i, s)]), s) for i in face] for face, s in zip(faces, signs, strict=True)]
