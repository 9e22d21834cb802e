"""Height and direction fields whose ridges are feature lines (TH10 table 7.1, table of SPEC 9)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.checks import check_choice, check_range, check_shape, check_type, float_dtype
from shapeenh.fusion import stored, unknown_truth
from shapeenh.lines.depth_steps import SURE, at_pixels, check_surface, depth_steps, surface_of
from shapeenh.lines.smoothing import LEAST_HEIGHT, prepare, smoothed_field
from shapeenh.numerics import safe_divide, safe_hypot, smoothstep
from shapeenh.stencils import derivatives, links, shift
from shapeenh.types import Descriptor, GBuffer, LineField

KINDS = ("occlusion", "surface", "luminance", "ridge", "valley", "inflection")
GREATEST_SIGMA = 20.0
_STEP_SIGMA = 0.65  # px; with more, one line runs between two steps that are 3 px apart

# ------------------------------------------------------------------------------------------- public


def line_field(kind: str, gbuffer, descriptor, *, luminance=None, sigma=None) -> LineField:
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
        sigma: [], px, in [0, 20]: heights and directions are diffused this far, insulated by silhouettes. None: 1, and
            0 for occlusion. (Occlusion lines live *on* the silhouettes: they are diffused freely, background included,
            and by 0.65 px more, since a step is thinner than any profile. Steps less than 3 px apart may become one
            line between them; with larger sigma, or radii of the fit than `fit_radius`, sooner.)

    Static: kind.
    Returns: LineField [H, W]; 0 off the mask with singularity 1 there, except occlusion lines, which straddle the
        outline and extend a few pixels beyond it.
    Gradient: with respect to descriptor.hessian, descriptor.gradient, luminance, sigma, where the height is not 0; none
        through silhouettes. In reverse mode alone: forward mode (jax.jvp, jax.jacfwd) raises a TypeError.
    Errors: ValueError for an unknown kind, for shapes that disagree, and for a missing or superfluous luminance.

    >>> field = se.line_field("valley", gbuffer, se.describe(gbuffer, sigma=2.0))
    """
    check_choice("kind", kind, KINDS)
    if sigma is None:
        sigma = 0.0 if kind == "occlusion" else 1.0
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
        check_surface(gbuffer, (h, w))
        if luminance is not None:
            check_shape("luminance", luminance, (h, w))
        dtype = float_dtype(descriptor.hessian)
    mask = None if gbuffer is None else gbuffer.mask
    spread = _STEP_SIGMA if kind == "occlusion" else 0.0
    images = gbuffer, descriptor, luminance
    return smoothed_field(_measure, images, jnp.asarray(sigma, dtype), mask, _anything, spread=spread, kind=kind)


def fit_radius(kind: str) -> float:
    """The radius, px, with which `fit_profile` finds the lines of one kind (SPEC 9.2: 4; steps of depth are thinner).

    Args: kind, as for `line_field`.
    Returns: 1.5 for occlusion, so that steps next to one another stay apart; else 4.
    Errors: ValueError for an unknown kind.

    >>> profile = se.fit_profile(field, radius=se.fit_radius("occlusion"))
    """
    check_choice("kind", kind, KINDS)
    return 1.5 if kind == "occlusion" else 4.0


def make_line_field(height, direction, *, mask=None, silhouette=None, sigma=0.0) -> LineField:
    """A field from a caller's own heights and directions (TH10 7.2.1, SPEC 9).

    Args:
        height: [H, W], any unit; lines are its ridges. Where it is not finite it counts as off the mask.
        direction: [H, W, 2], x right, y up, any length: lines, not arrows; 0 where undefined, which is a singularity.
        mask: [H, W], nonzero where the fields count; None: everywhere.
        silhouette: [H, W] in [0, 1], where trajectories must not cross, such as `descriptor.silhouette`; or None.
        sigma: [], px, in [0, 20], as in `line_field`.

    Static: which arguments are None.
    Returns: LineField [H, W]. Gradient: with respect to height, direction and sigma, in reverse mode alone.
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
    images = height, direction, mask, silhouette
    return smoothed_field(_take, images, jnp.asarray(sigma, dtype), mask, _anything_given, empty=1.0)


# ------------------------------------------------------------------------------------------- where anything is


@partial(jax.jit, static_argnames=("kind",))
def _anything(gbuffer, descriptor, luminance, *, kind):
    """Where, within the reach of stencils, there may be a height or a silhouette, [H, W] bool."""
    if kind == "luminance":
        found = _differs(luminance) | ~jnp.isfinite(luminance)
    elif kind == "occlusion":
        found = _differs(gbuffer.mask)
    else:
        found = jnp.any((descriptor.gradient if kind == "surface" else descriptor.hessian) != 0, axis=-1)
    return found if gbuffer is None else found | (descriptor.silhouette != 0)


@jax.jit
def _anything_given(height, direction, mask, silhouette):
    return mask & ((height != 0) | jnp.any(direction != 0, axis=-1) | (silhouette != 0))


def _differs(image):
    """From the pixel to the right or the one below."""
    right, below = (jnp.pad(jnp.diff(image, axis=a) != 0, [(0, int(a == i)) for i in (0, 1)]) for a in (1, 0))
    return right | below


@partial(jax.jit, static_argnames=("kind",))
def _measure(gbuffer, descriptor, luminance, sigma, *, kind):
    """What the table says, as `prepare` returns it."""
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
        # plane by plane, behind a border: else reverse mode works out all three entries for each of them
        entries = [jnp.where(good, descriptor.hessian[..., i], 0) for i in range(3)]
        height, double = stored(always, partial(_curvature, kind=kind), *entries)
    else:
        g = _gradient(descriptor, luminance, good, silhouette, kind, always)
        height, double = safe_hypot(*g), _doubled(*g)
    flat = jnp.abs(height) <= LEAST_HEIGHT
    return prepare(height, double, good, flat, silhouette, sigma)


@jax.jit
def _take(height, direction, mask, silhouette, sigma):
    """A caller's own field, as `prepare` returns it."""
    good = mask & jnp.isfinite(height) & jnp.all(jnp.isfinite(direction), axis=-1)
    x, y = (jnp.where(good, direction[..., i], 0) for i in (0, 1))
    length = safe_hypot(x, y)
    double = _doubled(safe_divide(x, length), safe_divide(y, length))
    none = jnp.zeros_like(good)
    return prepare(jnp.where(good, height, 0), double, good, none, jnp.clip(silhouette, 0, 1), sigma)


# ------------------------------------------------------------------------------------------- table 7.1


def _doubled(x, y):
    """(cos 2 phi, sin 2 phi) of the direction (x, y) as `[2, H, W]`; 0 where it has none."""
    length = safe_hypot(x, y)
    x, y = safe_divide(x, length), safe_divide(y, length)
    return jnp.stack([x * x - y * y, 2 * x * y])


def _curvature(xx, xy, yy, *, kind):
    """k_max of -H (ridges) or H (valleys), and its direction: here convexities have negative curvature.

    On a saddle both exist. As in Ohtake et al. 2004, where a valley needs |k_min| > |k_max|, the stronger one wins:
    from k_max = |k_min| on the height falls, to 0 at 2/3 |k_min|. Without that, a limb, where foreshortening makes
    convex curvature huge, is covered with short strong "valleys" across it (12 to 20 % of all on scanned meshes).
    """
    mean, a, b = 0.5 * (xx + yy), 0.5 * (xx - yy), xy
    size = jnp.abs(xx) + jnp.abs(yy)
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
    planes, surface = [], surface_of(gbuffer.mask, gbuffer.depth, gbuffer.normal, gbuffer.position)
    for axis, step in enumerate(depth_steps(surface, silhouette)):
        # half marked at a pixel or two is the fold of a coarse mesh, not an edge
        step = jnp.sign(step) * smoothstep(*SURE, jnp.abs(step))
        half = 0.5 * sum(at_pixels(step, axis))
        other = 1 - axis
        planes.append(0.5 * half + 0.25 * (shift(half, 1, other) + shift(half, -1, other)))  # Sobel
    g_x, g_y = planes[1], -planes[0]
    return safe_hypot(g_x, g_y), _doubled(g_x, g_y)
