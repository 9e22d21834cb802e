"""Where the depth field is singular: silhouettes, creases, and the conductance between them (SPEC 3.2 to 3.4).

LW09 finds silhouettes with a Sobel filter on depth. That fires on every steep slope, too; here the step that the
normals already predict is taken off first.
"""

from __future__ import annotations

import jax.numpy as jnp

from shapeenh.numerics import norm, safe_divide, smoothstep
from shapeenh.stencils import shift

# A step counts in units of the distance between neighbouring samples on the surface: 0.25 is the error of the normals
# of a coarse mesh (14 degrees), 0.5 a step of half a pixel between two surfaces that face the viewer.
LOW, HIGH = 0.25, 0.5


# ------------------------------------------------------------------------------------------- pixel footprint


def _pairs(array, axis: int):
    """The two members of every pair of neighbours along `axis`."""
    index = [slice(None)] * array.ndim
    index[axis] = slice(None, -1)
    first = array[tuple(index)]
    index[axis] = slice(1, None)
    return first, array[tuple(index)]


def _pitch(coordinate, usable):
    """(mean, spread relative to it) of the steps of `coordinate` from column to column."""
    a, b = _pairs(coordinate, 1)
    step = jnp.where(usable, b - a, 0)
    count = jnp.maximum(jnp.sum(usable), 1)
    mean = jnp.sum(step) / count
    variance = jnp.sum(jnp.where(usable, (step - mean) ** 2, 0)) / count
    return jnp.abs(mean), safe_divide(variance, mean * mean)


def footprint(position, depth, good):
    """World units between neighbouring pixels at each pixel's depth, [H, W]; 0 everywhere where there is no depth.

    Under an orthographic view `x` grows by the same amount from column to column, under perspective `x / depth` does:
    whichever is more regular decides, so no camera is needed. Images one pixel wide are measured along the other axis.
    """
    depth = jnp.where(good, depth, 1)
    x, y = (jnp.where(good, position[..., i], 0) for i in (0, 1))
    if x.shape[1] == 1:
        x, depth_, good_ = y.T, depth.T, good.T
    else:
        depth_, good_ = depth, good
    left, right = _pairs(good_, 1)
    flat, flat_spread = _pitch(x, left & right)
    angle, angle_spread = _pitch(safe_divide(x, depth_), left & right)
    varies = jnp.max(jnp.where(good, depth, -jnp.inf)) > jnp.min(jnp.where(good, depth, jnp.inf))
    size = jnp.where(angle_spread < flat_spread, angle * depth, flat)
    return jnp.where(good & varies, size, 0)


# ------------------------------------------------------------------------------------------- silhouettes


def _step(position, normal, size, usable, axis: int):
    """How far two neighbours are from lying on one smooth surface, in sample distances; and which one is in front.

    With D the vector from one sample to the next and m the mean of both normals, m . D vanishes to third order on a
    smooth surface, however steep, and exactly on spheres; across a silhouette it is the step. It is measured in units
    of the sample distance that the normals predict, size / m_z. Where each sample lies behind the other's tangent plane
    the two planes meet between them: that is a convex surface or edge, however sharp, and no step at all.
    """
    p, q = _pairs(position, axis)
    n_p, n_q = _pairs(normal, axis)
    size_p, size_q = _pairs(size, axis)
    d = q - p
    m = n_p + n_q
    length = norm(m)
    unit = jnp.minimum(size_p, size_q)
    above_p, below_q = jnp.sum(n_p * d, axis=-1), jnp.sum(n_q * d, axis=-1)
    gap = jnp.abs(above_p + below_q)
    gap = jnp.minimum(gap, 2 * jnp.maximum(0, jnp.maximum(above_p, -below_q)))
    gap = safe_divide(gap * jnp.maximum(m[..., 2], 0.02), unit * length * length)
    return jnp.where(usable, gap, 0), p[..., 2] >= q[..., 2]


def silhouettes(gbuffer, good):
    """w_s, [H, W] in [0, 1]: 1 on the far side of a depth step, 0 off the mask (LW09 4.4, SPEC 3.2).

    The far side alone is marked: one insulated pixel stops the diffusion, and the surface in front keeps its
    curvature up to its very edge. Buffers without depth (constant, or all 0) take silhouettes from the occlusion map,
    if there is one: where it falls below 1/2.

    Gradient: with respect to position and normal through the smoothstep; none through the choice of the side.
    """
    finite = good & jnp.isfinite(gbuffer.depth) & jnp.all(jnp.isfinite(gbuffer.position), axis=-1)
    position = jnp.where(finite[..., None], gbuffer.position, 0)
    normal = jnp.where(finite[..., None], jnp.clip(gbuffer.normal, -2, 2), 0)
    size = footprint(position, gbuffer.depth, finite)

    weight = jnp.zeros(good.shape, normal.dtype)
    for axis in (0, 1):
        p, q = _pairs(finite, axis)
        gap, p_in_front = _step(position, normal, size, p & q, axis)
        w = smoothstep(LOW, HIGH, gap)
        end = [(0, 1) if i == axis else (0, 0) for i in (0, 1)]
        start = [(1, 0) if i == axis else (0, 0) for i in (0, 1)]
        weight = jnp.maximum(weight, jnp.pad(jnp.where(p_in_front, 0, w), end))
        weight = jnp.maximum(weight, jnp.pad(jnp.where(p_in_front, w, 0), start))
    if gbuffer.occlusion is not None:
        open_ = jnp.where(jnp.isfinite(gbuffer.occlusion), gbuffer.occlusion, 1)
        from_occlusion = 1 - smoothstep(0.25, 0.75, open_)
        weight = jnp.where(jnp.any(size > 0), weight, from_occlusion)
    return jnp.where(good, weight, 0)


# ------------------------------------------------------------------------------------------- creases


def creases(normal, good, degrees):
    """w_c, [H, W] in [0, 1]: the largest angle between a normal and its eight neighbours', smoothstepped around
    `degrees` (from 3/4 of it to 5/4); 0 off the mask (LW09 4.4, SPEC 3.3).
    """
    n = jnp.moveaxis(jnp.where(good[..., None], jnp.clip(normal, -2, 2), 0), -1, 0)
    here = good.astype(n.dtype)
    largest = jnp.zeros(good.shape, n.dtype)
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        other = shift(shift(n, dr, 1), dc, 2)
        both = here * shift(shift(here, dr, 0), dc, 1)
        # the chord |a - b| = 2 sin(angle / 2) keeps small angles, which a cosine rounds away
        angle = both * 2 * jnp.arcsin(jnp.clip(0.5 * norm(n - other, axis=0), 0, 0.999999))
        back = shift(shift(angle, -dr, 0), -dc, 1)
        largest = jnp.maximum(largest, jnp.maximum(angle, back))
    threshold = jnp.deg2rad(degrees)
    return jnp.where(good, smoothstep(0.75 * threshold, 1.25 * threshold, largest), 0)


def conductance(silhouette, crease, good):
    """c = 1 - max(w_s, w_c), and 0 off the mask (LW09 4.4, SPEC 3.4)."""
    return jnp.where(good, 1 - jnp.maximum(silhouette, crease), 0)
