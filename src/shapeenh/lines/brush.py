"""Implicit brushes: footprints stamped wherever a skeleton is near (TH10 8.1, SPEC 10).

    I(y) = sum over x of w(x) f(T_x(y - x))                                     (8.1)
    w    = lambda exp(-d^2 / 2 s^2), d the distance to the skeleton             (8.2)

lambda = 1 and a small s is ink, lambda from the height a pencil, s from the curvature an airbrush; f is the footprint,
T_x a similarity that orients and scales it. Sums are premultiplied RGBA; 1 - exp(-I_a) compresses them to [0, 1[.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import register_dataclass

from shapeenh.checks import check_range, check_shape, check_size, check_type, float_dtype, is_concrete
from shapeenh.lines.noise import CHANNELS
from shapeenh.lines.profile import _read
from shapeenh.numerics import safe_divide, safe_hypot, safe_sqrt, smoothstep
from shapeenh.types import LineField, Profile

FOOTPRINTS = ("disc", "ellipse")
LARGEST_REACH = 64
_CUT = 1e-3  # taken off all weights, so that stamps fainter than this are none
_LADDER = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)


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
    grow: [], in [0, 1], how much of the footprint's size follows that same rise.
    shade: [], in [0, 1], how much of the colour comes from the shading at the skeleton.
    paper, gaps, tint: [], in [0, 1], how much noise takes off the picture, interrupts the line, varies the colour.
    wobble: [], px, how far noise moves a stamp.
    """

    color: jax.Array | tuple = (0.0, 0.0, 0.0)
    flow: jax.Array | float = 3.0
    radius: jax.Array | float = 1.5
    aspect: jax.Array | float = 1.0
    width: jax.Array | float = 0.8
    spread: jax.Array | float = 0.0
    low: jax.Array | float = 0.0
    high: jax.Array | float = 1e-6
    grow: jax.Array | float = 0.0
    shade: jax.Array | float = 0.0
    paper: jax.Array | float = 0.0
    gaps: jax.Array | float = 0.0
    tint: jax.Array | float = 0.0
    wobble: jax.Array | float = 0.0


def draw_lines(profile, field, brush, *, footprint="disc", shading=None, noise=None, reach: int | None = None):
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
        reach: px, how far stamps may extend, 1 to 64; read off the brush if that is concrete, and required if not.

    Static: footprint where it is no image, reach (rounded up a ladder), which arguments are None.
    Returns: [H, W, 4], premultiplied linear RGBA, alpha in [0, 1[; 0 where nothing is drawn.
        `picture * (1 - alpha) + rgb` lays it over a picture.
    Gradient: with respect to profile, brush, shading, noise and footprint image.
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
    image, function = _footprint(footprint, dtype)
    reach = _reach(brush, reach)
    brush = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), brush, is_leaf=lambda leaf: isinstance(leaf, tuple))
    if not is_concrete(profile, field, brush, shading, noise, image):
        return _draw_everywhere(profile, field, brush, shading, noise, image, function=function, reach=reach)
    stamps = _stamps_of(profile, field, brush, shading, noise)
    size = shape[0] * shape[1]
    index = np.flatnonzero(np.asarray(stamps[0]).ravel() > 0)
    chunk = max(64, min(4096, (1 << 18) // (2 * reach + 1) ** 2))
    listed = np.zeros(chunk * (size // chunk + 1), np.int32)
    listed[: index.size] = index
    count = jnp.asarray(index.size, jnp.int32)
    return _draw_listed(
        stamps, jnp.asarray(listed), count, brush, noise, image, function=function, reach=reach, chunk=chunk
    )


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
        ("grow", 0, 1, False),
        ("shade", 0, 1, False),
        ("paper", 0, 1, False),
        ("gaps", 0, 1, False),
        ("tint", 0, 1, False),
        ("wobble", 0, 32, False),
    ):
        check_shape(f"brush.{name}", getattr(brush, name), ())
        check_range(f"brush.{name}", getattr(brush, name), low, high, open_ends=ends)
    if is_concrete(brush.low, brush.high) and not float(brush.low) < float(brush.high):
        raise ValueError(f"brush.low is {brush.low} and brush.high {brush.high}; accepted is low < high")
    for names, image, what in ((("shade",), shading, "shading"), (("paper", "gaps", "tint", "wobble"), noise, "noise")):
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


def _reach(brush, reach) -> int:
    if reach is not None:
        return next(r for r in _LADDER if r >= check_size("reach", reach, high=LARGEST_REACH))
    if not is_concrete(brush.radius, brush.wobble):
        raise ValueError("reach is None with a traced brush; accepted is a number of px, since it decides array sizes")
    # the corner of a turned square lies sqrt(2) times as far away, and anti-aliasing adds half a pixel
    needed = np.sqrt(2) * float(brush.radius) + float(brush.wobble) + 0.5
    return next((r for r in _LADDER if r >= needed), LARGEST_REACH)


# ------------------------------------------------------------------------------------------- weights (8.2), T_x (8.3)


def _stamps(profile, field, brush, shading, noise):
    """`[9, H, W]`: weight, colour (3), the first row of T_x (2), the stamp's shift (2), its radius."""
    height, distance = profile.height, profile.distance
    rise = smoothstep(brush.low, brush.high, height)
    if noise is None:
        gaps = tint = wobble = jnp.zeros_like(height)
    else:
        gaps, tint = brush.gaps * noise[..., 1], brush.tint * (noise[..., 2] - 0.5)
        wobble = 2 * brush.wobble * (noise[..., 3] - 0.5)
    profile_width = safe_sqrt(safe_divide(jnp.maximum(height, 0), -profile.curvature))
    s = jnp.minimum(brush.width + brush.spread * profile_width, 64)
    bell = jnp.maximum(rise * jnp.exp(-0.5 * (distance / s) ** 2) - _CUT, 0)  # lambda exp(-d^2 / 2 s^2)
    radius = brush.radius * (1 - brush.grow + brush.grow * rise)
    usable = profile.valid & (radius > 1e-3)
    radius = jnp.where(usable, radius, 1)

    # What a straight line of such stamps adds up to: its length times its width, or the footprint, if that is smaller.
    line, whole = 2 * radius * np.sqrt(2 * np.pi).item() * s, np.pi * radius * radius * brush.aspect
    total = line * whole / safe_hypot(line, whole)
    weight = brush.flow * (1 - smoothstep(0.3, 0.7, gaps)) * bell / total
    weight = jnp.where(usable, weight, 0)

    theta_x, theta_y = field.direction[..., 0], field.direction[..., 1]
    color = jnp.broadcast_to(brush.color[:, None, None], (3, *height.shape))
    if shading is not None:
        color = color + brush.shade * (_at_skeleton(shading, distance, theta_x, theta_y) - color)
    color = jnp.maximum(color * (1 + 2 * tint)[None] + jnp.maximum(tint, 0)[None] * 0.2, 0)
    turn = jnp.stack([-theta_y, theta_x]) / radius[None]
    moved = jnp.stack([wobble * theta_x, wobble * theta_y])
    return jnp.concatenate([weight[None], color, turn, moved, radius[None]])


_stamps_of = jax.jit(_stamps)


def _at_skeleton(shading, distance, theta_x, theta_y):
    """The shading where the skeleton is, `[3, H, W]`."""
    h, w = distance.shape
    row = lax.broadcasted_iota(jnp.int32, (h, w), 0).astype(distance.dtype)
    col = lax.broadcasted_iota(jnp.int32, (h, w), 1).astype(distance.dtype)
    row, col = row - distance * theta_y, col + distance * theta_x
    padded = jnp.pad(jnp.where(jnp.isfinite(shading), shading, 0), ((1, 1), (1, 1), (0, 0)), mode="edge")
    return jnp.stack([_read(padded[..., i], row, col) for i in range(3)])


# ------------------------------------------------------------------------------------------- footprints f


def _imprint(stamp, x, y, aspect, image, function):
    """Premultiplied RGBA planes (list of four) that stamps leave at the offset (x, y) from them; y up."""
    weight, red, green, blue, cos, sin, dx, dy, radius = stamp
    x, y = x - dx, y - dy
    u, v = cos * x + sin * y, cos * y - sin * x
    if isinstance(function, str) and function in FOOTPRINTS:
        r = safe_hypot(u, v / aspect if function == "ellipse" else v)
        alpha = jnp.clip((1 - r) * radius * (aspect if function == "ellipse" else 1) + 0.5, 0, 1)
        rgb = [1.0, 1.0, 1.0]
    else:
        inside = (jnp.abs(u) <= 1) & (jnp.abs(v) <= 1)
        u, v = jnp.where(inside, u, 0), jnp.where(inside, v, 0)
        rgba = _sample(image, u, v) if function == "image" else function(u, v)
        colored = rgba.ndim > u.ndim
        rgb = [rgba[..., i] for i in range(3)] if colored else [1.0, 1.0, 1.0]
        alpha = jnp.where(inside, rgba[..., 3] if colored else rgba, 0)
    alpha = weight * alpha
    return [alpha * c * f for c, f in zip((red, green, blue), rgb, strict=True)] + [alpha]


def _sample(image, u, v):
    """Bilinear RGBA at u (along the columns), v (up) in [-1, 1]; colours are weighted by their opacity."""
    h, w = image.shape[:2]
    row, col = 0.5 * (1 - v) * h - 0.5, 0.5 * (1 + u) * w - 0.5
    alpha = image[..., 3]
    planes = [jnp.pad(p, 1, mode="edge") for p in (*(image[..., i] * alpha for i in range(3)), alpha)]
    red, green, blue, a = (_read(p, row, col) for p in planes)
    return jnp.stack([*(safe_divide(c, a) for c in (red, green, blue)), a], axis=-1)


# ------------------------------------------------------------------------------------------- the sum (8.1)


@partial(jax.jit, static_argnames=("function", "reach", "chunk"))
def _draw_listed(stamps, listed, count, brush, noise, image, *, function, reach, chunk):
    """Stamps of the listed pixels alone, each added as one window of the canvas."""
    _, h, w = stamps.shape
    side = 2 * reach + 1
    flat = stamps.reshape(9, h * w)
    y = (reach - jnp.arange(side, dtype=flat.dtype))[None, :, None]
    x = (jnp.arange(side, dtype=flat.dtype) - reach)[None, None, :]
    numbers = lax.ScatterDimensionNumbers(
        update_window_dims=(1, 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1)
    )

    def add(k, canvas):
        index = lax.dynamic_slice_in_dim(listed, k * chunk, chunk)
        used = k * chunk + lax.iota(jnp.int32, chunk) < count
        stamp = [flat[i][index][:, None, None] for i in range(9)]
        stamp[0] = jnp.where(used[:, None, None], stamp[0], 0)
        planes = _imprint(stamp, x, y, brush.aspect, image, function)
        windows = jnp.stack(jnp.broadcast_arrays(*planes), axis=-1).reshape(chunk, side, side * 4)
        corner = jnp.stack([index // w, index % w * 4], axis=-1)
        return lax.scatter_add(canvas, corner, windows, numbers, mode="promise_in_bounds")

    canvas = jnp.zeros((h + 2 * reach, (w + 2 * reach) * 4), flat.dtype)
    canvas = lax.fori_loop(0, (count + chunk - 1) // chunk, add, canvas)
    canvas = canvas.reshape(h + 2 * reach, w + 2 * reach, 4)[reach : reach + h, reach : reach + w]
    return _compress(jnp.moveaxis(canvas, -1, 0), brush, noise)


@partial(jax.jit, static_argnames=("function", "reach"))
def _draw_everywhere(profile, field, brush, shading, noise, image, *, function, reach):
    """All pixels stamp, one offset of the footprint after another: has a gradient, but costs area times footprint."""
    stamps = _stamps(profile, field, brush, shading, noise)
    _, h, w = stamps.shape
    side = 2 * reach + 1

    @jax.checkpoint
    def add(canvas, k):
        row, col = k // side, k % side
        x, y = (col - reach).astype(stamps.dtype), (reach - row).astype(stamps.dtype)
        planes = jnp.stack(jnp.broadcast_arrays(*_imprint(list(stamps), x, y, brush.aspect, image, function)))
        here = lax.dynamic_slice(canvas, (jnp.zeros_like(row), row, col), (4, h, w))
        return lax.dynamic_update_slice(canvas, here + planes, (jnp.zeros_like(row), row, col)), None

    canvas = jnp.zeros((4, h + 2 * reach, w + 2 * reach), stamps.dtype)
    canvas, _ = lax.scan(add, canvas, jnp.arange(side * side, dtype=jnp.int32))
    return _compress(canvas[:, reach : reach + h, reach : reach + w], brush, noise)


def _compress(total, brush, noise):
    """`[H, W, 4]`: paper, then all four channels by one factor, so that alpha = 1 - exp(-I_a) and colours stay."""
    if noise is not None:
        total = total * (1 - brush.paper * noise[..., 0])[None]
    depth = total[3]
    small = depth < 1e-4
    factor = jnp.where(small, 1 - 0.5 * depth, -jnp.expm1(-depth) / jnp.where(small, 1, depth))
    return jnp.moveaxis(total * factor[None], 0, -1)


def composite_lines(picture, strokes):
    """Strokes over a picture: rgb + (1 - alpha) picture, in linear RGB (SPEC 10).

    Args: picture [H, W, 3] linear RGB; strokes [H, W, 4] premultiplied, from `draw_lines`.
    Returns: [H, W, 3]. Gradient: exact.
    """
    check_shape("strokes", strokes, (None, None, 4))
    check_shape("picture", picture, (*np.shape(strokes)[:2], 3))
    return strokes[..., :3] + (1 - strokes[..., 3:]) * picture
