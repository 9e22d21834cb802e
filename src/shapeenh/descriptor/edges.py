"""Where the depth field is singular: silhouettes, creases, and the conductance between them (SPEC 3.2 to 3.4).

LW09 finds silhouettes with a Sobel filter on depth. That fires on every steep slope, too; here the step that the
normals already predict is taken off first. Normals and positions are triples of planes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from shapeenh.fusion import stored
from shapeenh.numerics import norm, safe_divide, smoothstep
from shapeenh.sparse import pull_from, steep
from shapeenh.stencils import WHOLE, shift, window

# A step counts in units of the distance between neighbouring samples on the surface. Shading normals of real meshes are
# up to 20 degrees off their facets (0.34); 0.6 is a step of 0.6 pixels between two surfaces that face the viewer.
LOW, HIGH = 0.4, 0.8
TILT = 0.5


def _pairs(array, axis: int):
    """The two members of every pair of neighbours along `axis` (-1 or -2)."""
    if axis == -1:
        return array[..., :-1], array[..., 1:]
    return array[..., :-1, :], array[..., 1:, :]


# ------------------------------------------------------------------------------------------- pixel footprint


def _total(array):
    """Sum over an image, by two products with ones: a plain reduction is several times slower on CPU."""
    h, w = array.shape
    rows = jnp.matmul(array, jnp.ones(w, array.dtype), precision="highest")
    return jnp.matmul(jnp.ones(h, array.dtype), rows, precision="highest")


def footprint(position, depth, good):
    """World units between neighbouring pixels at each pixel's depth, [H, W]; 0 everywhere where there is no depth.

    Under an orthographic view `x` grows by the same amount from column to column, under perspective `x / depth` does:
    whichever is more regular decides, so no camera is needed. An image one pixel wide is measured along `y`.
    """
    axis = -1 if depth.shape[1] > 1 else -2
    place = position[0] if axis == -1 else position[1]
    p, q = _pairs(good, axis)
    usable = (p & q).astype(depth.dtype)
    count = jnp.maximum(_total(usable), 1)

    def pitch(coordinate):
        a, b = _pairs(coordinate, axis)
        step = usable * (b - a)
        mean, square = _total(step) / count, _total(step * step) / count
        return jnp.abs(mean), safe_divide(square - mean * mean, square)

    on = jnp.where(good, depth, 1)
    flat, flat_spread = pitch(place)
    angle, angle_spread = pitch(safe_divide(place, on))
    least = jnp.min(jnp.min(jnp.where(good, depth, jnp.inf), axis=0))
    most = jnp.max(jnp.max(jnp.where(good, depth, -jnp.inf), axis=0))
    return jnp.where(good & (most > least), jnp.where(angle_spread < flat_spread, angle * on, flat), 0)


# ------------------------------------------------------------------------------------------- silhouettes


def _step(*values):
    """How far two neighbours are from lying on one smooth surface, in sample distances; positive where the first of
    them is in front, negative where the second is.

    With D the vector from one sample to the next and m the mean of both normals, m . D vanishes to third order on a
    smooth surface, however steep, and exactly on spheres; across a silhouette it is the step. It is measured in units
    of the sample distance that the normals predict, size / m_z. Where each sample lies behind the other's tangent plane
    the two planes meet between them: that is a convex surface or edge, however sharp, and no step at all.
    """
    (*n_p, p_x, p_y, p_z, size_p, on_p), (*n_q, q_x, q_y, q_z, size_q, on_q) = values[0::2], values[1::2]
    d = q_x - p_x, q_y - p_y, q_z - p_z
    m = [n_p[i] + n_q[i] for i in range(3)]
    dot = lambda a, b: a[0] * b[0] + a[1] * b[1] + a[2] * b[2]  # noqa: E731
    above_p, below_q = dot(n_p, d), dot(n_q, d)
    gap = jnp.minimum(jnp.abs(above_p + below_q), 2 * jnp.maximum(0, jnp.maximum(above_p, -below_q)))
    gap = safe_divide(gap * jnp.maximum(m[2], 0.02), jnp.minimum(size_p, size_q) * dot(m, m))
    return (jnp.where(on_p * on_q > 0, jnp.where(d[2] > 0, -gap, gap), 0),)


def _steps(planes, always):
    """`_step` from every pixel to its right neighbour, [H, W-1], and to its lower one, [H-1, W]."""
    domains = (((0, 0), (0, 1)), (0, 0, 0, -1)), (((0, 0), (1, 0)), (0, -1, 0, 0))
    return [window(_step, (reads,) * 8, (WHOLE,) * 8, pairs, always, *planes)[0] for reads, pairs in domains]


def _far_side(*steps):
    """w_s from the largest of a pixel's four steps that it lies behind.

    steps: for x and for y, those of the pair ahead of the pixel, the pair behind it, and the ones beyond these two.
    Shading normals that are off their facet show the same small step at every pair on it: what the pairs next to a step
    show in the same direction is taken off, up to TILT.
    """
    behind = []
    for ahead, back, beyond, before in (steps[:4], steps[4:]):
        behind.append(back - jnp.clip(jnp.maximum(before, ahead), 0, TILT))
        behind.append(-ahead - jnp.clip(jnp.maximum(-beyond, -back), 0, TILT))
    return (smoothstep(LOW, HIGH, jnp.maximum(jnp.maximum(*behind[:2]), jnp.maximum(*behind[2:]))),)


def _weight_of(always, *planes):
    """w_s from the planes of normal, position, footprint, and 1 where these are known, else 0."""
    step_x, step_y = _steps(planes, always)
    step_x, step_y = jnp.pad(step_x, ((0, 0), (2, 2))), jnp.pad(step_y, ((2, 2), (0, 0)))
    reads = tuple((0, k) for k in (0, -1, 1, -2)), tuple((k, 0) for k in (0, -1, 1, -2))
    return window(_far_side, reads, ((0, 0, 2, 1), (2, 1, 0, 0)), WHOLE, always, step_x, step_y)


_weight = jax.custom_vjp(lambda *arguments: _weight_of(*arguments)[0])


def _weight_fwd(always, *planes):
    (weight,) = _weight_of(always, *planes)
    return weight, (always, planes, weight)


def _weight_bwd(saved, cotangent):
    always, (*planes, on), weight = saved
    return None, *pull_from(steep(weight), 2, _weight_of, tuple(planes), (on,), (cotangent,), always), None


_weight.defvjp(_weight_fwd, _weight_bwd)


def silhouettes(gbuffer, normal, good, always):
    """w_s, [H, W] in [0, 1]: 1 on the far side of a depth step, 0 off the mask (LW09 4.4, SPEC 3.2).

    The far side alone is marked: one insulated pixel stops the diffusion, and the surface in front keeps its
    curvature up to its very edge. Buffers without depth (constant, or all 0) take silhouettes from the occlusion map,
    if there is one: where it falls below 1/2.

    Gradient: with respect to position and normal through the smoothstep; none through the choice of the side.
    """

    def clean(position, depth):
        planes = [position[..., i] for i in range(3)]
        finite = good & jnp.isfinite(depth)
        for plane in planes:
            finite = finite & jnp.isfinite(plane)
        return [jnp.where(finite, plane, 0) for plane in planes], jnp.where(finite, depth, 1), finite

    position, depth, finite = stored(always, clean, gbuffer.position, gbuffer.depth)
    size = footprint(position, depth, finite)
    weight = _weight(always, *normal, *position, size, finite.astype(size.dtype))
    if gbuffer.occlusion is not None:
        open_ = jnp.where(jnp.isfinite(gbuffer.occlusion), gbuffer.occlusion, 1)
        weight = jnp.where(jnp.max(size) > 0, weight, 1 - smoothstep(0.25, 0.75, open_))
    return jnp.where(good, weight, 0)


# ------------------------------------------------------------------------------------------- creases


def creases(normal, good, degrees):
    """w_c, [H, W] in [0, 1]: the largest angle between a normal and its eight neighbours', smoothstepped from 3/4 to
    5/4 of `degrees`; 0 off the mask (LW09 4.4, SPEC 3.3).
    """
    here = good.astype(normal[0].dtype)
    largest = jnp.zeros_like(here)
    normal = jnp.stack(normal)
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        other = shift(shift(normal, dr, 1), dc, 2)
        both = here * shift(shift(here, dr, 0), dc, 1)
        # the chord |a - b| = 2 sin(angle / 2) keeps small angles, which a cosine rounds away
        chord = both * norm(normal - other, axis=0)
        largest = jnp.maximum(largest, jnp.maximum(chord, shift(shift(chord, -dr, 0), -dc, 1)))
    angle = 2 * jnp.arcsin(jnp.minimum(0.5 * largest, 0.999999))
    threshold = jnp.deg2rad(degrees)
    return jnp.where(good, smoothstep(0.75 * threshold, 1.25 * threshold, angle), 0)


def conductance(silhouette, crease, good):
    """c = 1 - max(w_s, w_c), and 0 off the mask (LW09 4.4, SPEC 3.4)."""
    return jnp.where(good, 1 - jnp.maximum(silhouette, crease), 0)
