"""Height and direction fields whose ridges are feature lines (TH10 7.1 and 7.2.1, table of SPEC 9).

A direction is a line, not an arrow, and is carried as an arrow of twice its angle, (cos 2 phi, sin 2 phi), which is the
same for theta and -theta: that may be averaged. With the weight |h| it is the traceless part of h theta theta^T.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.checks import check_choice, check_range, check_shape, check_type, float_dtype, is_concrete
from shapeenh.fusion import stored, unknown_truth
from shapeenh.heat import explicit
from shapeenh.numerics import safe_divide, safe_hypot, safe_sqrt, smoothstep
from shapeenh.stencils import derivatives, links, shift
from shapeenh.types import Descriptor, GBuffer, LineField

KINDS = ("occlusion", "surface", "luminance", "ridge", "valley", "inflection")
LEAST_HEIGHT = 1e-5  # slopes and curvatures per px below this are rounding, not shape: no direction there
GREATEST_SIGMA = 20.0
_STEP_SIGMA = 1.5  # px

# ------------------------------------------------------------------------------------------- public


def line_field(kind: str, gbuffer, descriptor, *, luminance=None, sigma=1.0) -> LineField:
    """The field whose ridges are the lines of one kind.

    Source: TH10 table 7.1, 7.2.1; SPEC 9.

    | kind | height | direction |
    | --- | --- | --- |
    | occlusion | gradient of depth, with every step of depth counted as 1 | along the gradient |
    | surface | gradient of the relative depth field | along the gradient |
    | luminance | gradient of an image | along the gradient |
    | ridge | greatest curvature of -H: convex; falls to 0 on saddles that are more concave | its principal direction |
    | valley | greatest curvature of H: concave; falls to 0 on saddles that are more convex | its principal direction |
    | inflection | gradient of the mean curvature | along the gradient |

    Args:
        kind: one of the above.
        gbuffer: GBuffer; None for luminance without geometry (pictures, video).
        descriptor: Descriptor of the same image; None for luminance without geometry.
        luminance: [H, W], for kind "luminance" and no other.
        sigma: [], px, in [0, 20]: heights and directions are diffused this far, insulated by silhouettes. (Occlusion
            lines live *on* the silhouettes: they are diffused freely, background included, and by 1.5 px more, since a
            step is thinner than any profile.)

    Static: kind.
    Returns: LineField [H, W]; 0 off the mask with singularity 1 there, except occlusion lines, which straddle the
        outline and extend a few pixels beyond it.
    Gradient: with respect to descriptor.hessian, descriptor.gradient, luminance, sigma, where the height is not 0; none
        through silhouettes.
    Errors: ValueError for an unknown kind, for shapes that disagree, and for a missing or superfluous luminance.

    >>> field = se.line_field("valley", gbuffer, se.describe(gbuffer, sigma=2.0))
    """
    check_choice("kind", kind, KINDS)
    check_range("sigma", sigma, 0, GREATEST_SIGMA)
    check_shape("sigma", sigma, ())
    if (luminance is not None) != (kind == "luminance"):
        given = "not given" if luminance is None else "given"
        raise ValueError(f"luminance is {given} for kind {kind!r}; accepted is an image for 'luminance' and no other")
    if luminance is not None:
        check_shape("luminance", luminance, (None, None))
        luminance = jnp.asarray(luminance, float_dtype(luminance))
    if kind == "luminance" and gbuffer is None and descriptor is None:
        dtype = luminance.dtype
    else:
        check_type("gbuffer", gbuffer, GBuffer)
        check_type("descriptor", descriptor, Descriptor)
        h, w = np.shape(gbuffer.mask)
        for name, tail in (("hessian", (3,)), ("gradient", (2,)), ("silhouette", ())):
            check_shape(f"descriptor.{name}", getattr(descriptor, name), (h, w, *tail))
        check_shape("gbuffer.depth", gbuffer.depth, (h, w))
        if luminance is not None:
            check_shape("luminance", luminance, (h, w))
        dtype = float_dtype(descriptor.hessian)
    return _assemble(_measure, gbuffer, descriptor, luminance, jnp.asarray(sigma, dtype), kind=kind)


def make_line_field(height, direction, *, mask=None, silhouette=None, sigma=0.0) -> LineField:
    """A field from a caller's own heights and directions (TH10 7.2.1, SPEC 9).

    Args:
        height: [H, W], any unit; lines are its ridges. Where it is not finite it counts as off the mask.
        direction: [H, W, 2], x right, y up, any length: lines, not arrows; 0 where undefined, which is a singularity.
        mask: [H, W], nonzero where the fields count; None: everywhere.
        silhouette: [H, W] in [0, 1], where trajectories must not cross, such as `descriptor.silhouette`; or None.
        sigma: [], px, in [0, 20], as in `line_field`.

    Static: which arguments are None.
    Returns: LineField [H, W]. Gradient: with respect to height, direction and sigma.
    Errors: ValueError for shapes that disagree and numbers out of range.
    """
    check_shape("height", height, (None, None))
    shape = np.shape(height)
    check_shape("direction", direction, (*shape, 2))
    for name, image in (("mask", mask), ("silhouette", silhouette)):
        if image is not None:
            check_shape(name, image, shape)
    check_range("sigma", sigma, 0, GREATEST_SIGMA)
    dtype = float_dtype(height)
    height, direction = jnp.asarray(height, dtype), jnp.asarray(direction, dtype)
    mask = jnp.ones(shape, bool) if mask is None else jnp.asarray(mask) != 0
    silhouette = jnp.zeros(shape, dtype) if silhouette is None else jnp.asarray(silhouette, dtype)
    return _assemble(_take, height, direction, mask, silhouette, jnp.asarray(sigma, dtype))


@partial(jax.jit, static_argnames=("kind",))
def _measure(gbuffer, descriptor, luminance, sigma, *, kind):
    """What the table says, as `_prepare` returns it."""
    always = unknown_truth(sigma, *jax.tree.leaves((gbuffer, descriptor, luminance)))
    if gbuffer is None:
        good, silhouette = jnp.isfinite(luminance), jnp.zeros_like(luminance)
    else:
        good = gbuffer.mask & jnp.all(jnp.isfinite(descriptor.hessian), axis=-1)
        silhouette = lax.stop_gradient(jnp.where(good, descriptor.silhouette, 0))
    if kind == "occlusion":
        height, double = _occlusion(gbuffer, silhouette)
        good, silhouette = jnp.ones_like(good), jnp.zeros_like(silhouette)
        sigma = jnp.sqrt(sigma * sigma + _STEP_SIGMA**2)
    elif kind in ("ridge", "valley"):
        height, double = _curvature(jnp.where(good[..., None], descriptor.hessian, 0), kind)
    else:
        g = _gradient(descriptor, luminance, good, silhouette, kind, always)
        height, double = safe_hypot(*g), _doubled(*g)
    flat = jnp.abs(height) <= LEAST_HEIGHT
    return _prepare(height, double, good, flat, silhouette, sigma)


@jax.jit
def _take(height, direction, mask, silhouette, sigma):
    """A caller's own field, as `_prepare` returns it."""
    good = mask & jnp.isfinite(height) & jnp.all(jnp.isfinite(direction), axis=-1)
    x, y = (jnp.where(good, direction[..., i], 0) for i in (0, 1))
    length = safe_hypot(x, y)
    double = _doubled(safe_divide(x, length), safe_divide(y, length))
    none = jnp.zeros_like(good)
    return _prepare(jnp.where(good, height, 0), double, good, none, jnp.clip(silhouette, 0, 1), sigma)


# ------------------------------------------------------------------------------------------- table 7.1


def _doubled(x, y):
    """(cos 2 phi, sin 2 phi) of the direction (x, y) as `[2, H, W]`; 0 where it has none."""
    length = safe_hypot(x, y)
    x, y = safe_divide(x, length), safe_divide(y, length)
    return jnp.stack([x * x - y * y, 2 * x * y])


def _curvature(hessian, kind):
    """k_max of -H (ridges) or H (valleys), and its direction: here convexities have negative curvature.

    On a saddle both exist. As in Ohtake et al. 2004, where a valley needs |k_min| > |k_max|, the stronger one wins:
    from k_max = |k_min| on the height falls, to 0 at 2/3 |k_min|. Without that, a limb, where foreshortening makes
    convex curvature huge, is covered with short strong "valleys" across it (12 to 20 % of all on scanned meshes).
    """
    mean = 0.5 * (hessian[..., 0] + hessian[..., 2])
    a, b = 0.5 * (hessian[..., 0] - hessian[..., 2]), hessian[..., 1]
    size = jnp.abs(hessian[..., 0]) + jnp.abs(hessian[..., 2])
    umbilic = jnp.maximum(jnp.abs(a), jnp.abs(b)) <= jnp.finfo(a.dtype).eps * size  # every direction is principal there
    r = jnp.where(umbilic, 0, safe_hypot(a, b))
    k1, k2 = mean + r, mean - r  # what cancels here is a curvature too faint beside the other one to be a line
    double = jnp.stack([safe_divide(a, r), safe_divide(b, r)])
    height, other, double = (-k2, k1, -double) if kind == "ridge" else (k1, -k2, double)
    return jnp.where(height > 0, jnp.clip(3 * height - 2 * other, 0, height), height), double


def _gradient(descriptor, luminance, good, silhouette, kind, always):
    """(d/dx, d/dy) of what lines of order 1 and 3 are the steepest places of."""
    if kind == "surface":
        return tuple(jnp.where(good, descriptor.gradient[..., i], 0) for i in (0, 1))
    if kind == "luminance":
        plane = jnp.where(good, luminance, 0)
    else:
        plane = jnp.where(good, 0.5 * (descriptor.hessian[..., 0] + descriptor.hessian[..., 2]), 0)
    link_x, link_y = links(jnp.where(good, 1 - silhouette, 0))
    d_x, d_y = derivatives(plane[None], link_x, link_y, always)
    return d_x[0], d_y[0]


def _occlusion(gbuffer, silhouette):
    """|g_d| and its direction, with every step of depth normalised to 1 and slopes taken off."""
    planes = []
    for axis, step in enumerate(_depth_steps(gbuffer, silhouette)):
        before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
        before[axis], after[axis] = (1, 0), (0, 1)
        half = 0.5 * (jnp.pad(step, before) + jnp.pad(step, after))
        other = 1 - axis
        planes.append(0.5 * half + 0.25 * (shift(half, 1, other) + shift(half, -1, other)))  # Sobel
    g_x, g_y = planes[1], -planes[0]
    return safe_hypot(g_x, g_y), _doubled(g_x, g_y)


def _depth_steps(gbuffer, silhouette):
    """[down the columns [H-1, W], along the rows [H, W-1]]: the step between neighbours, in [-1, 1], positive where the
    second one is farther.

    The descriptor marks the far side of a step with a weight; which of its neighbours it is far *of* is read off the
    depth. Off the mask everything is far.
    """
    depth, mask = gbuffer.depth, gbuffer.mask
    depth = jnp.where(mask & jnp.isfinite(depth), depth, 0)

    def pair(image, axis):
        return tuple(lax.slice_in_dim(image, i, mask.shape[axis] - 1 + i, axis=axis) for i in (0, 1))

    def steps(axis):
        (on_a, on_b), (a, b), (w_a, w_b) = pair(mask, axis), pair(depth, axis), pair(silhouette, axis)
        jump = jnp.where(on_a & on_b, b - a, 0)
        sign = jnp.sign(jump)
        # the step that a steep but smooth surface would show anyway: that of the next pair along the line
        expected = jnp.maximum(jnp.maximum(sign * shift(jump, 1, axis), sign * shift(jump, -1, axis)), 0)
        excess = jnp.maximum(jnp.abs(jump) - expected, 0)
        return on_a, on_b, sign, excess, jnp.where(sign > 0, w_b, w_a)

    def padded(plane, axis):
        """Per pixel, the larger of the values on both of its pairs along an axis."""
        before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
        before[axis], after[axis] = (1, 0), (0, 1)
        return jnp.maximum(jnp.pad(plane, before), jnp.pad(plane, after))

    pairs = [steps(axis) for axis in (0, 1)]
    largest = jnp.maximum(*(padded(p[3], axis) for axis, p in enumerate(pairs)))
    found = []
    for axis, (on_a, on_b, sign, excess, weight) in enumerate(pairs):
        top_a, top_b = pair(largest, axis)
        share = safe_divide(excess, jnp.where(sign > 0, top_b, top_a))
        inner = sign * weight * smoothstep(0.3, 0.6, share)
        outer = on_a.astype(inner.dtype) - on_b.astype(inner.dtype)  # +1 where the second one is background
        found.append(jnp.where(on_a & on_b, inner, outer))
    return found


@jax.jit
def depth_barriers(gbuffer, descriptor):
    """(along the rows [H, W-1], down the columns [H-1, W]) bool: between which neighbours there is a step of depth or
    the outline. No gradient."""
    silhouette = jnp.where(gbuffer.mask & jnp.isfinite(descriptor.silhouette), descriptor.silhouette, 0)
    down, along = _depth_steps(gbuffer, silhouette)
    return jnp.abs(along) > 0.5, jnp.abs(down) > 0.5


# ------------------------------------------------------------------------------------------- smoothing, singularities


def _assemble(first, *arguments, **options) -> LineField:
    """What `first` measures, diffused, with directions from doubled angles, and its singularities.

    Called directly, these are separate compiled functions, plane by plane: together they need more memory than a cache
    holds and than an allocator keeps (twice as slow). Under somebody's jit, borders of fusion stand for them.
    """
    if is_concrete(arguments):
        call = lambda function, *values, **options: function(*values, **options)  # noqa: E731
    else:
        always = unknown_truth(*jax.tree.leaves(arguments))
        call = lambda function, *values, **options: stored(always, partial(function, **options), *values)  # noqa: E731
    planes, (link_x, link_y), time, known = call(first, *arguments, **options)
    if not (is_concrete(time) and float(time[0, 0]) == 0):
        planes = [call(_diffused, plane, link_x, link_y, time) for plane in planes]
    height, direction, around, flags = call(_directions, planes, known, time)
    return LineField(height, direction, call(_singularity, around, *flags))


def _prepare(height, double, good, flat, silhouette, sigma):
    """(the planes to be diffused, their links, the time, what is known before it)."""
    height = jnp.where(good, height, 0)
    double = jnp.where((good & ~flat)[None], double, 0)
    weight = jnp.abs(height)
    planes = [plane[None] for plane in (height, weight * double[0], weight * double[1])]
    insulated = links(lax.stop_gradient(jnp.where(good, 1 - silhouette, 0)))
    return planes, insulated, (0.5 * sigma * sigma)[None, None], (double, good, flat, silhouette)


@jax.jit
def _diffused(plane, link_x, link_y, time):
    return explicit(plane, link_x, link_y, time, jnp.ones_like(time))


@jax.jit
def _directions(planes, known, time):
    """(height, direction, [3, H+2, W+2] for `_singularity`, what else it needs)."""
    double, good, flat, silhouette = known
    # without diffusion the directions are the given ones, also where the height is 0
    smooth = time[0, 0] > 0
    double = jnp.where(smooth, jnp.concatenate(planes[1:]), double)
    height = jnp.where(good, planes[0][0], 0)
    theta, defined = _halved(double, jnp.where(smooth, 1e-3 * jnp.abs(height), 0.5))
    flat &= jnp.abs(height) <= LEAST_HEIGHT
    theta = jnp.where((good & ~flat)[None], theta, 0)
    weight = jnp.where(good & ~flat, 1 - silhouette, 0)
    around = jnp.pad(jnp.concatenate([theta, weight[None]]), ((0, 0), (1, 1), (1, 1)))
    return height, jnp.moveaxis(around[:2, 1:-1, 1:-1], 0, -1), around, (good, flat, defined, silhouette)


@jax.jit
def _singularity(around, good, flat, defined, silhouette):
    gamma = jnp.maximum(_angular(around), silhouette)
    return jnp.where(good, jnp.where(flat, silhouette, jnp.where(defined, gamma, 1)), 1)


def _halved(double, least):
    """(unit direction [2, H, W] of half the angle, whether it is defined); 0 where |double| <= least."""
    length = safe_hypot(double[0], double[1])
    defined = length > least
    c, s = (safe_divide(jnp.where(defined, d, 0), jnp.where(defined, length, 1)) for d in double)
    # (1 + c, s) or (s, 1 - c), whichever does not vanish
    right = c >= 0
    big = safe_sqrt(0.5 * (1 + jnp.where(right, c, -c)))
    small = 0.5 * s / big
    x, y = jnp.where(right, big, small), jnp.where(right, small, big)
    return jnp.where(defined[None], jnp.stack([x, y]), 0), defined


def _angular(around):
    """gamma_theta = 1 - mean over 8 neighbours |theta . theta_i| (TH10 7.2.1).

    around: [3, H+2, W+2], theta and the weight of a pixel, 0 in the ring. The mean is over those neighbours on the same
    surface that are not flat: what lies across a silhouette or has no relief says nothing about directions here.
    Without any it is 1.
    """
    h, w = around.shape[1] - 2, around.shape[2] - 2
    at = lambda dr, dc: around[:, 1 + dr : 1 + dr + h, 1 + dc : 1 + dc + w]  # noqa: E731
    here = at(0, 0)
    total, cosines = jnp.zeros_like(here[2]), jnp.zeros_like(here[2])
    for dr, dc in ((r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)):
        x, y, weight = at(dr, dc)
        total += weight
        cosines += weight * jnp.abs(here[0] * x + here[1] * y)
    return jnp.clip(1 - safe_divide(cosines, total), 0, 1)
