"""Smoothing of heights and directions by insulated diffusion, and their singularities (TH10 7.2.1, SPEC 9.1).

A direction is a line, not an arrow, and is carried as an arrow of twice its angle, (cos 2 phi, sin 2 phi), which is the
same for theta and -theta: that may be averaged. With the weight |h| it is the traceless part of h theta theta^T.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from shapeenh.checks import is_concrete
from shapeenh.fusion import stored, unknown_truth
from shapeenh.heat import STEP, explicit
from shapeenh.lines.tiles import list_tiles, margin_for, over_tiles
from shapeenh.numerics import safe_divide, safe_hypot, safe_sqrt
from shapeenh.stencils import links
from shapeenh.types import LineField

LEAST_HEIGHT = 1e-5  # slopes and curvatures per px below this are rounding, not shape: no direction there
_STENCILS = 5  # px, how far all that is not diffusion reads: derivatives or steps of depth, and neighbours' directions


def smoothed_field(first, images, sigma, mask, anything, *, empty=0.0, spread=0.0, **options) -> LineField:
    """The field that `first(*images, sigma, **options)` measures, smoothed; only where something is, if that is known.

    mask: [H, W] bool, where anything can be; or None: everywhere. anything: images -> [H, W] bool, where heights,
        directions and silhouettes are not all 0; asked if the mask leaves nothing out. empty: the singularity where
        they are. spread: px, beyond which sigma `first` diffuses more; then what it measures also extends off the mask.
    """
    tiles, margin = None, None
    if is_concrete(images, sigma):
        reach = _farthest(math.hypot(sigma, spread), sigma.dtype) + _STENCILS
        margin = margin_for(reach)
        tiles = list_tiles(mask, margin, around=reach if spread else 0)
        if tiles is None and margin is not None:
            tiles = list_tiles(anything(*images, **options), margin, around=reach)
    if tiles is None:
        return _assemble(first, *images, sigma, **options)
    static = {"first": first, "margin": margin, "singularity": (empty, 0.0 if spread else 1.0)}
    return LineField(*_tiled(images, mask, sigma, tiles, options=tuple(options.items()), **static))


def _farthest(sigma: float, dtype) -> int:
    """How far diffusion carries anything, px: one per step, and from beyond so many sigma nothing but rounding."""
    return min(math.ceil(0.5 * sigma**2 / STEP), math.ceil((6.5 if dtype == jnp.float32 else 9) * sigma))


@partial(jax.jit, static_argnames=("first", "margin", "singularity", "options"))
def _tiled(images, mask, sigma, tiles, *, first, margin, singularity, options):
    def field(images):
        found = _assemble(first, *images, sigma, **dict(options))
        return found.height, found.direction, found.singularity

    on, off = singularity
    background = 0.0, 0.0, on if mask is None or on == off else jnp.where(mask, on, off)
    return over_tiles(field, images, tiles, background, margin=margin)


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
    planes, insulated, time, known = call(first, *arguments, **options)
    link_x, link_y = lax.stop_gradient(insulated)
    if not (is_concrete(time) and float(time[0, 0]) == 0):
        planes = [_diffused(plane, link_x, link_y, time) for plane in planes]  # a loop is a border, too
    height, direction, around, flags = call(_directions, planes, known, time)
    return LineField(height, direction, call(_singularity, around, *flags))


def prepare(height, double, good, flat, silhouette, sigma):
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
