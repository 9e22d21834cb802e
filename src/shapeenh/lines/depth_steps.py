"""Steps of depth between neighbouring pixels: occlusion lines run along them, and footprints end there (SPEC 9, 10)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from shapeenh.checks import check_shape, is_concrete
from shapeenh.fusion import stored, unknown_truth
from shapeenh.lines.tiles import list_tiles, over_tiles
from shapeenh.numerics import safe_divide, smoothstep

SURE = 0.4, 0.8  # shares of a step, from none to all of it
_MARGIN = 8


def check_surface(gbuffer, shape) -> None:
    """Shapes of the fields that steps are read off."""
    for name, tail in (("depth", ()), ("normal", (3,)), ("position", (3,))):
        check_shape(f"gbuffer.{name}", getattr(gbuffer, name), (*shape, *tail))


def at_pixels(pairs, axis: int):
    """What pairs of neighbours along an axis show: at the second pixel of each, and at the first; else 0."""
    second, first = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
    second[axis], first[axis] = (1, 0), (0, 1)
    return jnp.pad(pairs, second), jnp.pad(pairs, first)


def surface_of(mask, depth, normal, position):
    """What `depth_steps` reads of a G-buffer: its mask, and planes that are 0 off it: depth, normal, position."""
    vectors = [image[..., i] for image in (normal, position) for i in range(3)]
    return mask, [lax.stop_gradient(jnp.where(mask & jnp.isfinite(p), p, 0)) for p in (depth, *vectors)]


def depth_steps(surface, silhouette):
    """[down the columns [H-1, W], along the rows [H, W-1]]: the step between neighbours, in [-1, 1], positive where the
    second one is farther.

    The descriptor marks the far side of a step with a weight. Which of its neighbours it is far *of* is read off the
    gaps: how far each of them and the pixel are from lying on one smooth surface with the mean of both normals. Off the
    mask everything is far.
    """
    mask, (depth, *vectors) = surface

    def pair(image, axis):
        return tuple(lax.slice_in_dim(image, i, mask.shape[axis] - 1 + i, axis=axis) for i in (0, 1))

    def steps(axis):
        (on_a, on_b), (a, b), (w_a, w_b) = pair(mask, axis), pair(depth, axis), pair(silhouette, axis)
        sign = jnp.where(on_a & on_b, jnp.sign(b - a), 0)
        ends = [pair(plane, axis) for plane in vectors]
        gap = jnp.abs(sum((m + n) * (q - p) for (m, n), (p, q) in zip(ends[:3], ends[3:], strict=True)))
        return on_a, on_b, sign, gap, jnp.where(sign > 0, w_b, w_a)

    def widest(axis, sign, gap):
        """Per pixel, the wider gap of those of its pairs along an axis of which it is the far one."""
        behind, before = jnp.where(sign > 0, gap, 0), jnp.where(sign < 0, gap, 0)
        return jnp.maximum(at_pixels(behind, axis)[0], at_pixels(before, axis)[1])

    pairs = [steps(axis) for axis in (0, 1)]
    largest = jnp.maximum(*(widest(axis, sign, gap) for axis, (_, _, sign, gap, _) in enumerate(pairs)))
    found = []
    for axis, (on_a, on_b, sign, gap, weight) in enumerate(pairs):
        top_a, top_b = pair(largest, axis)
        share = safe_divide(gap, jnp.where(sign > 0, top_b, top_a))
        inner = sign * weight * smoothstep(*SURE, share)
        outer = on_a.astype(inner.dtype) - on_b.astype(inner.dtype)  # +1 where the second one is background
        found.append(jnp.where(on_a & on_b, inner, outer))
    return found


def depth_barriers(gbuffer, descriptor, *, near=None, around: int = 0):
    """(across, down), [H, W] bool: whether between a pixel and the one to its right, or below, there is a step of depth
    or the outline. No gradient.

    near: [H, W] bool; only up to `around` pixels from where it is set need the answer be right. None: everywhere.
    """
    images = gbuffer.mask, gbuffer.depth, gbuffer.normal, gbuffer.position, descriptor.silhouette
    if is_concrete(images, near):
        tiles = list_tiles(near, _MARGIN, around=around)
        if tiles is not None:
            return _tiled_barriers(images, tiles)
    return _barriers(images)


@jax.jit
def _tiled_barriers(images, tiles):
    always = unknown_truth(images[1])

    def barriers(images):  # what is cut out is stored, or every neighbour that the stencils read is cut out again
        return _between(*stored(always, _planes, images))

    return over_tiles(barriers, images, tiles, (False, False), margin=_MARGIN)


@jax.jit
def _barriers(images):
    return _between(*_planes(images))


def _planes(images):
    *parts, silhouette = images
    return surface_of(*parts), jnp.where(parts[0] & jnp.isfinite(silhouette), silhouette, 0)


def _between(surface, silhouette):
    down, across = depth_steps(surface, silhouette)
    return jnp.pad(jnp.abs(across) > 0.5, ((0, 0), (0, 1))), jnp.pad(jnp.abs(down) > 0.5, ((0, 1), (0, 0)))
