"""Stamps: how heavy, where, how large, how turned, in which colour (eqs. 8.2 and 8.3 of TH10), and their footprints."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.fusion import stored, unknown_truth
from shapeenh.lines.candidates import read
from shapeenh.numerics import safe_divide, safe_hypot, safe_sqrt, smoothstep

FOOTPRINTS = ("disc", "ellipse")
LENGTH_WITHIN = 4  # px to all sides, where the length of a stroke is taken
_CUT = 1e-3  # taken off all weights, so that stamps fainter than this are none


class Stamps(NamedTuple):
    """One stamp per pixel, as planes [..., H, W]; None for what is the same everywhere.

    weight: 0 where there is no stamp. radius: px, or None for the brush's. color: [3], or None for the brush's.
    turn: [2], the first row of T_x without its scale; or None. moved: [2], px, the stamp's shift; or None.
    """

    weight: jax.Array
    radius: jax.Array | None
    color: Any
    turn: Any
    moved: Any


class Tip(NamedTuple):
    """What footprints read of a brush."""

    color: jax.Array
    radius: jax.Array
    aspect: jax.Array


# ------------------------------------------------------------------------------------------- weights (8.2), T_x (8.3)


def stamps_planes(profile, field, brush, shading, noise, *, colored, turned, moved, grown, sifted) -> Stamps:
    """The stamps of all pixels; the flags say which planes are wanted."""
    height, distance = profile.height, profile.distance
    rise = smoothstep(brush.low, brush.high, height)
    profile_width = safe_sqrt(safe_divide(jnp.maximum(height, 0), -profile.curvature))
    s = jnp.minimum(brush.width + brush.spread * profile_width, 64)
    bell = jnp.maximum(rise * jnp.exp(-0.5 * (distance / s) ** 2) - _CUT, 0)  # lambda exp(-d^2 / 2 s^2)
    wide = jnp.minimum(profile_width / brush.radius, 1)
    radius = brush.radius * (1 - brush.grow + brush.grow * rise) * (1 - brush.swell + brush.swell * wide)
    if noise is not None:
        radius = radius * (1 - brush.uneven * noise[..., 1])
    usable = profile.valid & (radius > 1e-3)
    radius = jnp.where(usable, radius, 1)

    # What a straight line of such stamps adds up to: its length times its width, or the footprint, if that is smaller.
    line, whole = 2 * radius * np.sqrt(2 * np.pi).item() * s, np.pi * radius * radius * brush.aspect
    total = line * whole / safe_hypot(line, whole)
    weight = brush.flow * bell / total
    if noise is not None:
        weight = weight * (1 - smoothstep(0.3, 0.7, brush.gaps * noise[..., 1]))
    if sifted:
        weight = weight * _long_enough(profile, brush)
    weight = jnp.where(usable, weight, 0)

    theta_x, theta_y = field.direction[..., 0], field.direction[..., 1]
    color = shift = None
    if colored:
        color = jnp.broadcast_to(brush.color[:, None, None], (3, *height.shape))
        if shading is not None:
            color = color + brush.shade * (_at_skeleton(shading, distance, theta_x, theta_y) - color)
        if noise is not None:
            tint = brush.tint * (noise[..., 2] - 0.5)
            color = jnp.maximum(color * (1 + 2 * tint)[None] + jnp.maximum(tint, 0)[None] * 0.2, 0)
    if moved and noise is not None:
        wobble = 2 * brush.wobble * (noise[..., 3] - 0.5)
        shift = jnp.stack([wobble * theta_x, wobble * theta_y])
    if turned and noise is not None:
        angle = brush.twist * (2 * noise[..., 2] - 1)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        theta_x, theta_y = cos * theta_x - sin * theta_y, sin * theta_x + cos * theta_y
    turn = jnp.stack([-theta_y, theta_x]) if turned else None
    return Stamps(weight, radius if grown else None, color, turn, shift)


def _long_enough(profile, brush):
    """0 where less of strokes is around a pixel than `brush.shortest` allows, else 1.

    The length of all skeletons in a window is the sum of bells across them, each worth 1 per px of its line.
    """

    def bells(height, distance, valid):
        there = smoothstep(brush.low, 0.7 * brush.low + 0.3 * brush.high, height)
        bell = there * jnp.exp(-0.5 * distance**2) / np.sqrt(2 * np.pi).item()
        return jnp.pad(jnp.where(valid, bell, 0), LENGTH_WITHIN)

    def added(plane, *, axis):
        size = plane.shape[axis] - 2 * LENGTH_WITHIN
        return sum(lax.slice_in_dim(plane, k, k + size, axis=axis) for k in range(2 * LENGTH_WITHIN + 1))

    always = unknown_truth(profile.height, profile.distance)
    length = stored(always, bells, profile.height, profile.distance, profile.valid)
    for axis in (0, 1):
        length = stored(always, partial(added, axis=axis), length)
    enough = jnp.where(brush.shortest > 0, brush.shortest, 1)
    return jnp.where(brush.shortest > 0, smoothstep(0.6 * enough, enough, length), 1)


def _at_skeleton(shading, distance, theta_x, theta_y):
    """The shading where the skeleton is, `[3, H, W]`."""
    h, w = distance.shape
    row = lax.broadcasted_iota(jnp.int32, (h, w), 0).astype(distance.dtype)
    col = lax.broadcasted_iota(jnp.int32, (h, w), 1).astype(distance.dtype)
    row, col = row - distance * theta_y, col + distance * theta_x
    padded = jnp.pad(jnp.where(jnp.isfinite(shading), shading, 0), ((1, 1), (1, 1), (0, 0)), mode="edge")
    return jnp.stack([read(padded[..., i], row, col) for i in range(3)])


# ------------------------------------------------------------------------------------------- footprints f


def imprint(stamp: Stamps, x, y, brush, image, function):
    """What stamps leave at the offset (x, y) px from them, y up: (alpha, the footprint's own colour or None).

    stamp: planes of any shape, with colours and vectors as tuples of planes.
    """
    radius = brush.radius if stamp.radius is None else stamp.radius
    if stamp.moved is not None:
        x, y = x - stamp.moved[0], y - stamp.moved[1]
    if function == "disc":
        return stamp.weight * jnp.clip(radius - _length(x, y) + 0.5, 0, 1), None
    assert stamp.turn is not None
    cos, sin = stamp.turn[0], stamp.turn[1]
    along, across = cos * x + sin * y, cos * y - sin * x
    if function == "ellipse":
        short = radius * brush.aspect  # (1 - |(u, v / aspect)|) times the short half axis
        return stamp.weight * jnp.clip(short - _length(brush.aspect * along, across) + 0.5, 0, 1), None
    u, v = along / radius, across / radius
    inside = (jnp.abs(u) <= 1) & (jnp.abs(v) <= 1)
    u, v = jnp.where(inside, u, 0), jnp.where(inside, v, 0)
    rgba = _sample(image, u, v) if function == "image" else function(u, v)
    rgb = [rgba[..., i] for i in range(3)] if rgba.ndim > u.ndim else None
    return stamp.weight * jnp.where(inside, rgba if rgb is None else rgba[..., 3], 0), rgb


def _length(x, y):
    """Of moderate numbers; its gradient at 0 is 0. (`safe_hypot` would be most of the work.)"""
    return jnp.sqrt(x * x + y * y + 1e-30)


def tinted(stamp: Stamps, rgb, brush):
    """The three factors that make a stamp's alpha its premultiplied colour."""
    base = brush.color if stamp.color is None else stamp.color
    return [base[i] * (1 if rgb is None else rgb[i]) for i in range(3)]


def _sample(image, u, v):
    """Bilinear RGBA at u (along the columns), v (up) in [-1, 1]; colours are weighted by their opacity."""
    h, w = image.shape[:2]
    row, col = 0.5 * (1 - v) * h - 0.5, 0.5 * (1 + u) * w - 0.5
    alpha = image[..., 3]
    planes = [jnp.pad(p, 1, mode="edge") for p in (*(image[..., i] * alpha for i in range(3)), alpha)]
    red, green, blue, a = (read(p, row, col) for p in planes)
    return jnp.stack([*(safe_divide(c, a) for c in (red, green, blue)), a], axis=-1)
