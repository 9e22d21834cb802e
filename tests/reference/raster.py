"""SPEC 11 by brute force: every face against every pixel centre, in exact integers and float64. NumPy only.

Faces wholly in front of the near plane: corners snapped to 1/256 px, integer edge functions, top-left rule. Faces that
the near plane or the eye plane cuts: a ray through each pixel centre, in homogeneous coordinates, no snapping; pixels
nearer than 1/64 px to one of their edges are undecided. So are pixels whose two nearest faces are equally near to
rounding.
"""

import numpy as np

SUB = 256
GUARD = 65536 * SUB


def clip_coordinates(vertices, view, projection):
    v = np.asarray(vertices, np.float64)
    return np.c_[v, np.ones(len(v))] @ (np.asarray(projection, np.float64) @ np.asarray(view, np.float64)).T


def snap(clip, height, width):
    """Integer window coordinates, pixel centres at multiples of 256, y down; only meaningful where w > 0."""
    w = np.where(clip[:, 3] > 0, clip[:, 3], 1.0)
    x = (clip[:, 0] / w + 1) * width / 2 - 0.5
    y = (1 - clip[:, 1] / w) * height / 2 - 0.5
    with np.errstate(all="ignore"):
        return np.rint(np.clip(np.stack([x, y], 1) * SUB, -1e15, 1e15)).astype(np.int64)


def rasterize(vertices, faces, view, projection, height, width, cull="none", snapped=None):
    """triangle [H, W], undecided [H, W] (another face may be right as well), nearness [H, W] (-inf: none)."""
    clip = clip_coordinates(vertices, view, projection)
    points = snap(clip, height, width) if snapped is None else np.asarray(snapped, np.int64)
    front = (clip[:, 3] > 0) & (clip[:, 2] >= -clip[:, 3])
    best = np.full((height, width), -np.inf)
    triangle = np.full((height, width), -1, np.int32)
    doubtful = np.full((height, width), -np.inf)  # nearness of the nearest face that may or may not be there
    for index, face in enumerate(np.asarray(faces)):
        if not front[face].any():
            continue
        exact = front[face].all() and np.abs(points[face]).max() <= GUARD
        draw = snapped_face if exact else cut_face
        hit, maybe, near = draw(points[face], clip[face], height, width, cull)
        scale = np.abs(near[hit | maybe]).max(initial=0.0)
        tie = 4e-6 * scale
        near = np.where(hit | maybe, near, -np.inf)
        # two faces as near as rounding can tell: neither is wrong
        close = hit & (triangle >= 0) & (near >= best - tie) & (near <= best + tie)
        doubtful = np.where(close, np.maximum(doubtful, np.maximum(near, best)), doubtful)
        doubtful = np.where(maybe, np.maximum(doubtful, near), doubtful)
        closer = hit & (near > best)
        best, triangle = np.where(closer, near, best), np.where(closer, index, triangle)
    return triangle, (doubtful > -np.inf) & (doubtful >= best), best


def pixels(height, width):
    y, x = np.mgrid[:height, :width]
    return x, y


def kept(area, cull):
    """y is down: a counter-clockwise face has a negative area."""
    return {"none": area != 0, "back": area < 0, "front": area > 0}[cull]


def snapped_face(p, clip, height, width, cull):
    x, y = (t.astype(np.int64) * SUB for t in pixels(height, width))
    nothing = np.zeros((height, width), bool)
    (ax, ay), (bx, by), (cx, cy) = p
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if not kept(area, cull):
        return nothing, nothing, np.zeros((height, width))
    if area < 0:
        edges = [(p[2], p[1]), (p[0], p[2]), (p[1], p[0])]  # opposite corners 0, 1, 2, interior on the positive side
    else:
        edges = [(p[1], p[2]), (p[2], p[0]), (p[0], p[1])]
    hit, weights = ~nothing, []
    for (sx, sy), (tx, ty) in edges:
        e = (tx - sx) * (y - sy) - (ty - sy) * (x - sx)
        inward_x, inward_y = -(ty - sy), tx - sx
        keeps = inward_x > 0 or (inward_x == 0 and inward_y > 0)  # left, or horizontal top
        hit &= (e >= 0) if keeps else (e > 0)
        weights.append(e / abs(area))
    nearness = 1 - clip[:, 2] / clip[:, 3]
    return hit, nothing, sum(w * n for w, n in zip(weights, nearness, strict=True))


def cut_face(p, clip, height, width, cull):
    """Solve for the point of the face's plane behind each pixel centre."""
    x, y = pixels(height, width)
    ndc = np.stack([(x + 0.5) * 2 / width - 1, 1 - (y + 0.5) * 2 / height, np.ones((height, width))], -1)
    corners = clip[:, [0, 1, 3]]
    det = np.linalg.det(corners)
    nothing = np.zeros((height, width), bool)
    if not kept(-det, cull):
        return nothing, nothing, np.zeros((height, width))
    lines = np.cross(corners[[1, 2, 0]], corners[[2, 0, 1]]) / det
    beta = ndc @ lines.T
    slope = np.hypot(lines[:, 0] * 2 / width, lines[:, 1] * 2 / height)  # per pixel
    distance = beta / np.maximum(slope, 1e-300)
    total = beta.sum(-1)
    with np.errstate(all="ignore"):
        nearness = (beta @ (clip[:, 3] - clip[:, 2])) / 1.0  # (w - z) / w: beta is already divided by w
    inside = (beta >= 0).all(-1) & (total > 0) & (nearness <= 2)
    margin = (distance > -1 / 64).all(-1) & (total > -1e-9) & (nearness <= 2 + 1e-5)
    sure = (distance > 1 / 64).all(-1) & (total > 0) & (nearness <= 2 - 1e-5)
    return inside, margin & ~sure, nearness


def interpolate(attribute, vertices, faces, view, projection, triangle):
    """Perspective-correct values [H, W, C] and weights [H, W, 3]: at each pixel, one 3 x 3 system."""
    height, width = triangle.shape
    clip = clip_coordinates(vertices, view, projection)
    out, weights = np.zeros((height, width, np.shape(attribute)[1])), np.zeros((height, width, 3))
    for y, x in zip(*np.nonzero(triangle >= 0), strict=True):
        face = np.asarray(faces)[triangle[y, x]]
        corners = clip[face][:, [0, 1, 3]].T
        beta = np.linalg.solve(corners, [(x + 0.5) * 2 / width - 1, 1 - (y + 0.5) * 2 / height, 1.0])
        weights[y, x] = beta / beta.sum()
        out[y, x] = weights[y, x] @ np.asarray(attribute, np.float64)[face]
    return out, weights
