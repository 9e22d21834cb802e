"""The view-centred, multi-scale descriptor (LW09 section 4, TH10 4.3, SPEC 3)."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.checks import (
    as_number,
    check_choice,
    check_range,
    check_shape,
    check_type,
    float_dtype,
    is_concrete,
)
from shapeenh.descriptor import diffusion, edges, gradient
from shapeenh.descriptor.box import covering_part, crop, paste
from shapeenh.fusion import stored, unknown_truth
from shapeenh.heat import STEP, depth_for
from shapeenh.numerics import determinant, eigenvalues, safe_divide, safe_hypot
from shapeenh.stencils import derivatives_beside, links
from shapeenh.types import Descriptor, GBuffer, replace

CREASE_DEGREES = 40.0

# ------------------------------------------------------------------------------------------- curvatures


def mean_curvature(hessian):
    """Hm = (k1 + k2)/2 = (xx + yy)/2 (SPEC 3.8).

    hessian: [..., 3] (xx, xy, yy), 1/px. Returns [...], 1/px: negative on convexities.
    Gradient: exact.
    """
    check_shape("hessian", hessian, (..., 3))
    return 0.5 * hessian[..., 0] + 0.5 * hessian[..., 2]


def gaussian_curvature(hessian):
    """K = k1 k2 = xx yy - xy^2 (SPEC 3.8).

    hessian: [..., 3] (xx, xy, yy), 1/px. Returns [...], 1/px^2.
    Gradient: exact.
    """
    check_shape("hessian", hessian, (..., 3))
    return determinant(hessian)


def principal_curvatures(hessian):
    """(k1, k2) = Hm ± r, k1 >= k2 (SPEC 3.8).

    hessian: [..., 3] (xx, xy, yy), 1/px. Returns two arrays [...], 1/px.
    Gradient: exact off umbilics; there that of r is taken as 0, so that symmetric functions of both are right.
    """
    check_shape("hessian", hessian, (..., 3))
    return eigenvalues(hessian)


@jax.custom_jvp
def _half_angle(a, b):
    """(cos, sin) of atan2(b, a) / 2, the first not negative, as `[2, ...]`; (1, 0) at the origin with gradient 0."""
    angle = 0.5 * jnp.arctan2(b, jnp.where((a == 0) & (b == 0), 1, a))
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


@_half_angle.defjvp
def _half_angle_jvp(primals, tangents):
    (a, b), (da, db) = primals, tangents
    out = _half_angle(a, b)
    r = safe_hypot(a, b)
    turn = 0.5 * (safe_divide(a, r) * safe_divide(db, r) - safe_divide(b, r) * safe_divide(da, r))
    return out, jnp.stack([-out[1], out[0]]) * turn[None]


def principal_directions(hessian):
    """(u, v): unit image directions (x right, y up) of the principal curvatures k1 and k2 (LW09 4.2).

    hessian: [..., 3] (xx, xy, yy), 1/px. Returns two arrays [..., 2]: lines, not arrows; u has x >= 0, v is u turned by
    90 degrees counter-clockwise. At umbilics every direction is principal: u = (1, 0).
    Gradient: exact off umbilics, where it grows like 1/(k1 - k2); 0 where k1 - k2 is within rounding of 0. What can do
    without directions (SPEC 3, spectral functions) should not ask for them.
    """
    check_shape("hessian", hessian, (..., 3))
    a, b = 0.5 * hessian[..., 0] - 0.5 * hessian[..., 2], hessian[..., 1]
    size = jnp.abs(hessian[..., 0]) + jnp.abs(hessian[..., 2])
    umbilic = jnp.maximum(jnp.abs(a), jnp.abs(b)) <= jnp.finfo(hessian.dtype).eps * size
    cos, sin = _half_angle(jnp.where(umbilic, 0, a), jnp.where(umbilic, 0, b))
    return jnp.stack([cos, sin], axis=-1), jnp.stack([-sin, cos], axis=-1)


# ------------------------------------------------------------------------------------------- the descriptor


FIELDS = tuple(field.name for field in dataclasses.fields(Descriptor))


def describe(
    gbuffer,
    *,
    sigma=0.0,
    foreshortening=1.0,
    importance=None,
    creases=False,
    scheme="fast",
    fields=FIELDS,
) -> Descriptor:
    """The local shape descriptor: silhouettes, creases, and curvature at a scale of `sigma` pixels (LW09 algorithm 1).

    gbuffer: GBuffer. Pixels with a NaN or infinite normal count as off the mask.
    sigma: [], px of this image, in [0, 100]: narrower details are smoothed away, never across a silhouette or crease.
    foreshortening: [], f in [0, 4]: 1 = the surface's own slope; less tones down the rims (TH10 4.3.2).
    importance: [H, W] or None: how many explicit diffusion steps (of 1/5) each pixel takes part in (LW09 4.3); a pixel
        whose count is used up is frozen. With `sigma` > 0 no pixel takes more than `sigma` needs; with `sigma` = 0 the
        counts alone decide.
    creases: False (none computed), True (edges sharper than 40 degrees between pixels), or a threshold in degrees.
    scheme: "explicit" (steps of 1/5) or "fast" (the same sigma on a pyramid, to about 1 %; `importance` needs steps).
    fields: names of the fields that are made, the others are None: light needs ("hessian",) alone.
    *Static*: scheme, fields; whether `importance` is given and `creases` asked for. A concrete `sigma` = 0 skips the
        diffusion, a concrete mask what lies around it (in images of 2^17 pixels or more).
    Returns a Descriptor; its fields are 0 off the mask.
    *Gradient*: in reverse mode, with respect to normals, depth (through the silhouettes' flanks), sigma, foreshortening
        and importance.
    *Errors*: ValueError for fields whose shapes disagree, and for numbers out of range.

        descriptor = describe(render_gbuffer(mesh, camera, height=600, width=800), sigma=2.5)
        concave = mean_curvature(descriptor.hessian) > 0
    """
    check_gbuffer(gbuffer)
    shape = gbuffer.mask.shape
    check_range("sigma", sigma, 0, diffusion.GREATEST_SIGMA)
    check_range("foreshortening", foreshortening, 0, gradient.GREATEST_FORESHORTENING)
    check_shape("sigma", sigma, ())
    check_shape("foreshortening", foreshortening, ())
    if importance is not None:
        check_shape("importance", importance, shape)
        check_range("importance", importance, 0, 5 * diffusion.GREATEST_SIGMA**2 / 2)
    check_choice("scheme", scheme, ("fast", "explicit"))
    for name in fields:
        check_choice("fields", name, FIELDS)
    with_creases = creases is not False
    degrees = CREASE_DEGREES if creases is True else creases
    if with_creases:
        check_range("creases", degrees, 0, 180, open_ends=True)

    dtype = float_dtype(gbuffer.normal)
    number = partial(as_number, dtype=dtype)
    smooth = importance is not None or not is_concrete(sigma) or bool(np.asarray(sigma) > 0)
    part = covering_part(gbuffer.mask) if is_concrete(gbuffer.mask) else None
    corner, size = part if part is not None else (None, None)
    return _describe(
        gbuffer,
        corner,
        number(sigma),
        None if is_concrete(foreshortening) and np.asarray(foreshortening) == 1 else number(foreshortening),
        None if importance is None else number(importance),
        number(degrees),
        smoothing=_smoothing(sigma, importance, scheme) if smooth else None,
        with_creases=with_creases,
        fields=tuple(name for name in FIELDS if name in fields),
        size=size,
    )


def _smoothing(sigma, importance, scheme: str) -> tuple[int, bool, bool]:
    """`levels` and `sure` of `diffuse_stacks`, and whether a chart is needed: what a sigma decides at compile time.

    The fold at an outline, which the chart is for, is gone within half a pixel: exp(-8 t), less than 1e-6 at sigma 2.
    """
    known = is_concrete(sigma, importance)
    longest = 0.5 * (float(sigma) if known else diffusion.GREATEST_SIGMA) ** 2
    chart = not known or importance is not None or float(sigma) < 2
    if importance is not None or scheme == "explicit":
        steps = longest / STEP
        if known and importance is not None:
            most = float(np.max(importance, initial=0))
            steps = min(steps, most) if steps > 0 else most
        return -max(1, depth_for(1.00001 * steps)), True, chart  # rounding may make it one step more
    return diffusion.levels_for(float(sigma) if known else diffusion.GREATEST_SIGMA), known, chart


def check_gbuffer(gbuffer) -> None:
    """Shapes of the fields that descriptors read."""
    check_type("gbuffer", gbuffer, GBuffer)
    check_shape("gbuffer.mask", gbuffer.mask, (None, None))
    h, w = gbuffer.mask.shape
    check_shape("gbuffer.normal", gbuffer.normal, (h, w, 3))
    check_shape("gbuffer.position", gbuffer.position, (h, w, 3))
    check_shape("gbuffer.depth", gbuffer.depth, (h, w))
    if gbuffer.occlusion is not None:
        check_shape("gbuffer.occlusion", gbuffer.occlusion, (h, w))


@partial(jax.jit, static_argnames=("smoothing", "with_creases", "fields", "size"))
def _describe(gbuffer, corner, sigma, foreshortening, importance, degrees, *, size, **static):
    if size is None:
        return _describe_all(gbuffer, sigma, foreshortening, importance, degrees, **static)
    shape = gbuffer.mask.shape
    gbuffer, importance = crop((replace(gbuffer, albedo=None, uv=None), importance), corner, size)
    part = _describe_all(gbuffer, sigma, foreshortening, importance, degrees, **static)
    return paste(part, corner, shape)


def _describe_all(gbuffer, sigma, foreshortening, importance, degrees, *, smoothing, with_creases, fields):
    varies = gbuffer.normal, gbuffer.position, sigma, foreshortening, importance, degrees
    always = unknown_truth(*jax.tree.leaves(varies))

    # 1-2: silhouettes and creases
    normal, good = stored(always, gradient.normal_planes, gbuffer)
    w_s = edges.silhouettes(gbuffer, normal, good, always)
    w_c = edges.creases(normal, good, degrees) if with_creases else jnp.zeros_like(w_s)
    c = edges.conductance(w_s, w_c, good)
    w_s, w_c, c, link_x, link_y = stored(always, lambda *w: (*w, *links(w[-1])), w_s, w_c, c)

    # 3: the gradient of the relative depth field
    g = stored(always, gradient.depth_gradient, normal, foreshortening)

    # 4-6: diffusion, of the gradient and of the places where it was measured
    places, bend = _coordinates(g), jnp.ones_like(sigma)
    if smoothing is not None:
        budget = _budget(sigma, importance)
        stacks = (g, places)  # of two planes: four at once overflow the cache
        levels, sure, chart = smoothing
        flank, most = diffusion.flank(c), diffusion.most_links(c.size, with_creases)
        g, places = diffusion.diffuse_stacks(stacks, c, (link_x, link_y), budget, flank, always, levels, sure, most)
        bend = jnp.exp(-8 * jnp.max(budget)) if chart else None  # type: ignore[assignment]

    # 7: the Hessian, flat at the singular places
    hessian = _hessian(g, places, link_x, link_y, c, foreshortening, bend, always)
    whole = Descriptor(
        hessian=jnp.stack(hessian, axis=-1),
        gradient=jnp.moveaxis(g, 0, -1),
        silhouette=w_s,
        crease=w_c,
        conductance=c,
    )
    return replace(whole, **{name: None for name in FIELDS if name not in fields})


def _budget(sigma, importance):
    """The time each pixel diffuses for, [1, 1] or [H, W]: sigma^2 / 2, and importance steps of 1/5."""
    time = (0.5 * sigma * sigma)[None, None]
    if importance is None:
        return time
    counted = STEP * importance
    return jnp.where(time > 0, jnp.minimum(counted, time), counted)


def _coordinates(g):
    """x and y of the pixels, y up, the origin in the middle, as planes `[2, H, W]`."""
    height, width = g.shape[1:]
    x = jnp.arange(width, dtype=g.dtype) - 0.5 * (width - 1)
    y = 0.5 * (height - 1) - jnp.arange(height, dtype=g.dtype)
    shape = (height, width)
    return jnp.stack([jnp.broadcast_to(x[None], shape), jnp.broadcast_to(y[:, None], shape)])


# Within sigma of an outline the diffused g is an average from one side only and levels off: its plain derivative
# falls to 0 there, which pictures show as a rim. But the average was also *taken* elsewhere. Diffusion is linear, so
# the pixels' coordinates diffused alike, X_s, say where: the derivative of g_s with respect to X_s is exact for every
# linear g up to the outline, and in open regions, where X_s = x, it is grad g_s itself.

_FLOOR = 0.004**2  # |grad X_s|^2 below which X_s counts as constant: a region much narrower than sigma is seen as flat


def _hessian(g, places, link_x, link_y, c, foreshortening, bend, always):
    """c H, H = grad g_s (grad X_s)^-1, symmetrised, as planes xx, xy, yy (SPEC 3.7); `bend` None: without the chart."""

    def slopes(g, d_x, d_y):
        """The derivative of g from that in the chart."""
        if bend is None:
            return d_x, d_y
        scale, along = gradient.from_chart(g, foreshortening, bend)
        s_x, s_y = along * (g[0] * d_x[0] + g[1] * d_x[1]), along * (g[0] * d_y[0] + g[1] * d_y[1])
        return (
            (scale * (d_x[0] + s_x * g[0]), scale * (d_x[1] + s_x * g[1])),
            (scale * (d_y[0] + s_y * g[0]), scale * (d_y[1] + s_y * g[1])),
        )

    def displaced(g, d_x, d_y, x, y, c):
        """H = J^T (J J^T + e^2)^-1 (g_x; g_y), least squares with a floor, J = (x_x y_x; x_y y_y)."""
        (u_x, v_x), (u_y, v_y) = slopes(g, d_x, d_y)
        (x_x, y_x), (x_y, y_y) = x, y
        a, b, d = x_x * x_x + y_x * y_x + _FLOOR, x_x * x_y + y_x * y_y, x_y * x_y + y_y * y_y + _FLOOR
        unit = c * (1 + _FLOOR) / (a * d - b * b)  # so that nothing changes where J = I
        m_xx, m_xy = x_x * d - x_y * b, x_y * a - x_x * b
        m_yx, m_yy = y_x * d - y_y * b, y_y * a - y_x * b
        xy = (m_xx * v_x + m_xy * v_y) + (m_yx * u_x + m_yy * u_y)
        return unit * (m_xx * u_x + m_xy * u_y), (0.5 * unit) * xy, unit * (m_yx * v_x + m_yy * v_y)

    planes = tuple(g) if bend is None else stored(always, lambda g: gradient.to_chart(g, foreshortening, bend), g)
    d, e = derivatives_beside((planes, tuple(places)), link_x, link_y, c, always)
    return stored(always, displaced, g, *d, *e, c)
