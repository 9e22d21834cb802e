"""Implicit brushes: footprints stamped wherever a skeleton is near (TH10 8.1, SPEC 10).

    I(y) = sum over x of w(x) f(T_x(y - x))                                     (8.1)
    w    = lambda exp(-d^2 / 2 s^2), d the distance to the skeleton             (8.2)

lambda = 1 and a small s is ink, lambda from the height a pencil, s from the curvature an airbrush; f is the footprint,
T_x a similarity that orients and scales it. Sums are premultiplied RGBA; 1 - exp(-I_a) compresses them to [0, 1[.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass

from shapeenh.checks import check_range, check_shape, check_size, check_type, float_dtype, is_concrete, is_zero
from shapeenh.lines.accumulate import crossings_on_host, draw_listed, framed_stamps, list_runs
from shapeenh.lines.depth_steps import check_surface, depth_barriers
from shapeenh.lines.noise import CHANNELS
from shapeenh.lines.stamps import FOOTPRINTS, LENGTH_WITHIN
from shapeenh.lines.tiles import list_tiles, margin_for
from shapeenh.lines.traced import draw_traced
from shapeenh.types import Descriptor, GBuffer, LineField, Profile

LARGEST_REACH = 64
NOISY = ("paper", "gaps", "tint", "wobble", "uneven", "twist")  # what of a brush needs noise
_LADDER = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 32, 48, 64)


@register_dataclass
@dataclass(frozen=True, eq=False)
class Brush:
    """How a stroke answers to the profile under it (TH10 8.1).

    color: [3], linear RGB.
    flow: [], >= 0, the optical depth in the middle of a straight line of full weight: 3 is nearly opaque.
    radius: [], px, > 0, of the footprint (half its long side).
    aspect: [], ]0, 1], short over long side of an ellipse; the long one lies along the skeleton.
    width: [], px, > 0, s of the weight: how far from the skeleton stamps are set.
    spread: [], >= 0, added to s: this times sqrt(height / |curvature|), the half width of the profile in px (airbrush).
    low, high: [], heights between which lambda rises from 0 to 1: close together for ink, far apart for a pencil.
    shortest: [], px, in [0, 8]: where less of a line than this lies within 4 px it fades, and at 0.6 times this it is
        gone: specks are left out, lines and their ends are kept.
    grow: [], in [0, 1], how much of the footprint's size follows that same rise.
    swell: [], in [0, 1], how much of it follows the half width of the profile, sqrt(height / |curvature|) px, up to
        `radius` (TH10 fig. 8.5).
    shade: [], in [0, 1], how much of the colour comes from the shading at the skeleton.
    paper, gaps, tint: [], in [0, 1], how much noise takes off the picture, interrupts the line, varies the colour.
    wobble: [], px, how far noise moves a stamp.
    uneven: [], in [0, 1], how much noise takes off the footprint's size; the same noise as that of the gaps, so that a
        line grows thin before it ends.
    twist: [], rad, in [0, pi], how far noise turns the footprint; the same noise as that of the tint.
    """

    color: jax.Array | tuple | list = (0.0, 0.0, 0.0)
    flow: jax.Array | float = 3.0
    radius: jax.Array | float = 1.5
    aspect: jax.Array | float = 1.0
    width: jax.Array | float = 0.8
    spread: jax.Array | float = 0.0
    low: jax.Array | float = 0.0
    high: jax.Array | float = 1e-6
    shortest: jax.Array | float = 0.0
    grow: jax.Array | float = 0.0
    swell: jax.Array | float = 0.0
    shade: jax.Array | float = 0.0
    paper: jax.Array | float = 0.0
    gaps: jax.Array | float = 0.0
    tint: jax.Array | float = 0.0
    wobble: jax.Array | float = 0.0
    uneven: jax.Array | float = 0.0
    twist: jax.Array | float = 0.0


def draw_lines(
    profile,
    field,
    brush,
    *,
    footprint="disc",
    shading=None,
    noise=None,
    gbuffer=None,
    descriptor=None,
    reach: int | None = None,
):
    """The picture that a brush leaves along the lines of a field.

    Source: TH10 8.1 (eqs. 8.1 to 8.3); SPEC 10.

    Args:
        profile: Profile [H, W], from `fit_profile(field)`.
        field: LineField [H, W]; its directions orient the footprint.
        brush: Brush.
        footprint: "disc"; "ellipse", oriented along the skeleton; an image [h, w, 4] (linear RGBA, not premultiplied),
            its rows along the skeleton; or a function `f(u, v)` of arrays in [-1, 1] (u along, v across the skeleton)
            to opacity [...] or RGBA [..., 4]. RGB of images and functions multiplies the brush's colour.
        shading: [H, W, 3] linear RGB, for brushes with `shade` > 0; or None.
        noise: [H, W, 4] in [0, 1] (paper, gaps, tint, wobble), such as `surface_noise`; or None.
        gbuffer, descriptor: those of the field, or None. With them footprints end at the outline and at steps of depth,
            as if each surface were drawn on its own sheet; TH10 lets them spill over. Not for occlusion lines, which
            straddle the steps.
        reach: px, how far stamps may extend, 1 to 64; read off the brush if that is concrete, and required if not.

    Static: footprint where it is no image, reach (rounded up a ladder), which arguments are None, and, of a concrete
        brush, whether it grows, wobbles, and has more than one colour: what it does not do costs nothing.
    Returns: [H, W, 4], premultiplied linear RGBA, alpha in [0, 1[; 0 where nothing is drawn.
        `picture * (1 - alpha) + rgb` lays it over a picture.
    Gradient: with respect to profile, brush, shading, noise and footprint image; not through what a footprint function
        closes over. In reverse mode alone.
    Errors: ValueError for shapes that disagree, numbers out of range, and noise or shading that a brush lacks.

    >>> strokes = se.draw_lines(profile, field, se.Brush(radius=2.0, low=0.02, high=0.1))
    """
    check_type("profile", profile, Profile)
    check_type("field", field, LineField)
    check_type("brush", brush, Brush)
    shape = np.shape(profile.distance)
    check_shape("profile.distance", profile.distance, (None, None))
    check_shape("field.direction", field.direction, (*shape, 2))
    dtype = float_dtype(profile.distance)
    if shading is not None:
        check_shape("shading", shading, (*shape, 3))
        shading = jnp.asarray(shading, dtype)
    if noise is not None:
        check_shape("noise", noise, (*shape, CHANNELS))
        noise = jnp.clip(jnp.nan_to_num(jnp.asarray(noise, dtype), nan=0.5), 0, 1)
    _check_brush(brush, shading, noise)
    _check_sheets(gbuffer, descriptor, shape)
    image, function = _footprint(footprint, dtype)
    reach = _reach(brush, reach, function)
    concrete = is_concrete(profile, field, brush, shading, noise, image, gbuffer, descriptor)
    wants = _wants(brush, shading, noise, function)
    # one by one, JAX's arrays take as long to make as a small picture takes to draw
    array: Any = np.asarray if is_concrete(brush) else jnp.asarray
    brush = Brush(**{name: array(value, dtype) for name, value in vars(brush).items()})
    options = {"function": function, "reach": reach}
    if not concrete:
        barriers = None if gbuffer is None else depth_barriers(gbuffer, descriptor)
        traced = {**options, "wants": tuple(wants.items())}
        return draw_traced(profile, field, brush, shading, noise, image, barriers, **traced)
    valid = np.asarray(profile.valid)
    margin = _margin(profile, wants["sifted"], wants["colored"] and float(brush.shade) > 0)
    tiles = list_tiles(valid, margin)
    images = profile, field, shading, noise
    stamps = framed_stamps(images, brush, tiles, wants=tuple(wants.items()), margin=margin, reach=reach)
    barriers = crossed = None
    if gbuffer is not None:
        barriers = tuple(map(np.asarray, depth_barriers(gbuffer, descriptor, near=valid, around=reach + 1)))
        crossed = crossings_on_host(barriers, reach)
    weight = np.asarray(stamps.weight)[reach:, reach:][: shape[0], : shape[1]]
    listed, counts = list_runs(weight, valid, barriers, reach)
    return draw_listed(stamps, listed, counts, brush, noise, image, crossed, shape=shape, **options)


def _wants(brush, shading, noise, function) -> dict[str, bool]:
    """Which planes of the stamps differ from pixel to pixel, as far as is known."""
    shaded = shading is not None and not is_zero(brush.shade)
    tinted, moved, uneven = (noise is not None and not is_zero(a) for a in (brush.tint, brush.wobble, brush.uneven))
    return {
        "colored": shaded or tinted,
        "turned": function != "disc",
        "moved": moved,
        "sifted": not is_zero(brush.shortest),
        # `stamps_planes` sees to radii near 0, which `draw_lines` refuses if it can
        "grown": not is_zero(brush.grow, brush.swell) or uneven or not is_concrete(brush.radius),
    }


def _margin(profile, sifted: bool, shaded: bool) -> int | None:
    """How far the stamp of a pixel looks, px: along its line, and to the skeleton if it takes its colour there."""
    reach = LENGTH_WITHIN if sifted else 0
    if shaded:
        farthest = np.max(np.abs(np.asarray(profile.distance)), where=np.asarray(profile.valid), initial=0)
        if not np.isfinite(farthest):
            return None
        reach = max(reach, int(farthest) + 2)
    return margin_for(reach)


def _check_sheets(gbuffer, descriptor, shape) -> None:
    if gbuffer is None and descriptor is None:
        return
    check_type("gbuffer", gbuffer, GBuffer)
    check_type("descriptor", descriptor, Descriptor)
    check_surface(gbuffer, shape)
    check_shape("descriptor.silhouette", descriptor.silhouette, shape)


def _check_brush(brush, shading, noise) -> None:
    check_shape("brush.color", brush.color, (3,))
    check_range("brush.color", brush.color, 0, 1e6)
    for name, low, high, ends in (
        ("flow", 0, 1e4, False),
        ("radius", 0, LARGEST_REACH, True),
        ("aspect", 1e-3, 1, False),
        ("width", 1e-2, 64, False),
        ("spread", 0, 64, False),
        ("low", -np.inf, np.inf, False),
        ("high", -np.inf, np.inf, False),
        ("shortest", 0, 2 * LENGTH_WITHIN, False),
        ("grow", 0, 1, False),
        ("swell", 0, 1, False),
        ("shade", 0, 1, False),
        ("paper", 0, 1, False),
        ("gaps", 0, 1, False),
        ("tint", 0, 1, False),
        ("wobble", 0, 32, False),
        ("uneven", 0, 1, False),
        ("twist", 0, np.pi, False),
    ):
        check_shape(f"brush.{name}", getattr(brush, name), ())
        check_range(f"brush.{name}", getattr(brush, name), low, high, open_ends=ends)
    if is_concrete(brush.low, brush.high) and not float(brush.low) < float(brush.high):
        raise ValueError(f"brush.low is {brush.low} and brush.high {brush.high}; accepted is low < high")
    for names, image, what in ((("shade",), shading, "shading"), (NOISY, noise, "noise")):
        used = [n for n in names if is_concrete(getattr(brush, n)) and float(getattr(brush, n)) > 0]
        if used and image is None:
            raise ValueError(f"{what} is None; a brush with {used[0]} > 0 needs an image of {what}")


def _footprint(footprint, dtype):
    """(image or None, function or name): what varies and what is static."""
    if isinstance(footprint, str):
        if footprint not in FOOTPRINTS:
            raise ValueError(f"footprint is {footprint!r}; accepted are 'disc', 'ellipse', an image or a function")
        return None, footprint
    if callable(footprint):
        return None, footprint
    check_shape("footprint", footprint, (None, None, 4))
    return jnp.asarray(footprint, dtype), "image"


def _reach(brush, reach, function) -> int:
    if reach is not None:
        return next(r for r in _LADDER if r >= check_size("reach", reach, high=LARGEST_REACH))
    if not is_concrete(brush.radius, brush.wobble, brush.aspect):
        raise ValueError("reach is None with a traced brush; accepted is a number of px, since it decides array sizes")
    radius, wobble = float(brush.radius), float(brush.wobble)
    if function in FOOTPRINTS:  # 0 from this far on, anti-aliasing included
        end = radius + wobble + 0.5 / (1 if function == "disc" else float(brush.aspect))
        needed = int(np.ceil(end)) - 1
    else:  # the corner of a turned square
        needed = int(np.sqrt(2) * radius + wobble)
    return next((r for r in _LADDER if r >= needed), LARGEST_REACH)


def composite_lines(picture, strokes):
    """Strokes over a picture: rgb + (1 - alpha) picture, in linear RGB (SPEC 10).

    Args: picture [H, W, 3] linear RGB; strokes [H, W, 4] premultiplied, from `draw_lines`.
    Returns: [H, W, 3]. Gradient: exact.
    """
    check_shape("strokes", strokes, (None, None, 4))
    check_shape("picture", picture, (*np.shape(strokes)[:2], 3))
    return strokes[..., :3] + (1 - strokes[..., 3:]) * picture
