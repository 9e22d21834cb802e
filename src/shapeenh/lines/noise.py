"""Noise that sticks to the surface and keeps its size on the screen (TH10 8.2, after Benard et al. 2010).

Solid value noise in object space moves with the object, not with the screen (no shower-door effect). As the camera
zooms its octaves are exchanged for coarser or finer ones: a cell always covers about the same number of pixels.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.checks import check_range, check_shape, check_size, check_type, float_dtype
from shapeenh.fusion import stored, unknown_truth
from shapeenh.stencils import shift
from shapeenh.types import Camera, GBuffer

CHANNELS = 4  # paper, gaps, tint, wobble (see `Brush`)
_GRAZING = 0.125  # cosines below this make cells no larger
_BEYOND = 6  # px


def surface_noise(gbuffer, camera, *, size=6.0, seed: int = 0):
    """Four channels of noise fixed to the object, for `draw_lines`.

    Source: TH10 8.1, 8.2 (the noise eta); SPEC 10.

    Args:
        gbuffer: GBuffer [H, W] (position in camera space).
        camera: Camera it was rendered with: the way back to object space.
        size: [], px, in [0.5, 1000]: about how large a cell of the noise is on the screen.
        seed: which noise, 0 to 2^31 - 1.

    Static: seed.
    Returns: [H, W, 4] in [0, 1], mean about 1/2; where a surface is seen at a grazing angle cells are larger, so that
        they do not vanish between pixels. Off the mask the outline's noise goes on for some pixels, as far as a line
        that straddles it is wide, and beyond them it is noise on the plane of mean depth.
    Gradient: with respect to position and camera, piecewise; none through normals.
    Errors: ValueError for shapes that disagree and numbers out of range.
    """
    check_type("gbuffer", gbuffer, GBuffer)
    check_type("camera", camera, Camera)
    check_shape("gbuffer.position", gbuffer.position, (*np.shape(gbuffer.mask), 3))
    check_range("size", size, 0.5, 1000)
    seed = check_size("seed", seed, low=0, high=(1 << 31) - 1)
    return _surface_noise(gbuffer, camera, jnp.asarray(size, float_dtype(gbuffer.position)), seed=seed)


@partial(jax.jit, static_argnames=("seed",))
def _surface_noise(gbuffer, camera, size, *, seed):
    h, w = gbuffer.mask.shape
    dtype = gbuffer.position.dtype
    view, projection = camera.view.astype(dtype), camera.projection.astype(dtype)
    good = gbuffer.mask & jnp.all(jnp.isfinite(gbuffer.position), axis=-1)
    position = jnp.moveaxis(jnp.where(good[..., None], gbuffer.position, 0), -1, 0)
    count = jnp.sum(good)
    depth = jnp.sum(-position[2]) / jnp.maximum(count, 1)
    z = jnp.where(good, position[2], -jnp.where(count > 0, depth, 1))
    scale = projection[3, 2] * z + projection[3, 3]
    x = jnp.broadcast_to(((jnp.arange(w, dtype=dtype) + 0.5) * (2 / w) - 1)[None], (h, w))
    y = jnp.broadcast_to((1 - (jnp.arange(h, dtype=dtype) + 0.5) * (2 / h))[:, None], (h, w))
    x = (x * scale - projection[0, 2] * z - projection[0, 3]) / projection[0, 0]
    y = (y * scale - projection[1, 2] * z - projection[1, 3]) / projection[1, 1]
    px, py = jnp.where(good, position[0], x) - view[0, 3], jnp.where(good, position[1], y) - view[1, 3]
    pz = z - view[2, 3]
    place = [view[0, i] * px + view[1, i] * py + view[2, i] * pz for i in range(3)]
    facing = lax.stop_gradient(jnp.where(good & jnp.isfinite(gbuffer.normal[..., 2]), gbuffer.normal[..., 2], 1))
    cell = size * jnp.abs(2 * scale / (h * projection[1, 1])) / jnp.clip(facing, _GRAZING, 1)
    noise = jnp.stack([_zoomed(place, cell, seed * CHANNELS + channel) for channel in range(CHANNELS)])
    return jnp.moveaxis(stored(unknown_truth(gbuffer.position), _continued, noise, good), 0, -1)


def _continued(noise, good):
    """The planes with those values off the mask that lie within `_BEYOND` pixels of it replaced by means of what is
    nearest to them on it."""

    def grow(_, state):
        known, noise = state
        total = _around(jnp.concatenate([known, known * noise]))
        new = jnp.where(known > 0, noise, jnp.where(total[:1] > 0, total[1:] / jnp.maximum(total[:1], 1), noise))
        return jnp.where(total[:1] > 0, 1.0, known).astype(noise.dtype), new

    known = good[None].astype(noise.dtype)
    return lax.fori_loop(0, _BEYOND, grow, (known, noise))[1]


def _around(planes):
    """Sums over 3 x 3 pixels."""
    for axis in (1, 2):
        planes = planes + shift(planes, 1, axis) + shift(planes, -1, axis)
    return planes


def _zoomed(place, cell, seed: int):
    """Noise whose cells measure about `cell`: two octaves that are a power of two in size, blended."""
    level = jnp.log2(jnp.maximum(cell, 1e-30))
    whole = lax.stop_gradient(jnp.floor(level))
    part = level - whole
    unit = jnp.exp2(whole)
    fine = _value_noise([p / unit for p in place], whole.astype(jnp.int32), seed)
    coarse = _value_noise([p / (2 * unit) for p in place], whole.astype(jnp.int32) + 1, seed)
    mean = (1 - part) * (fine - 0.5) + part * (coarse - 0.5)
    # blending two independent noises lowers their contrast; value noise is flat, so it is raised, too
    mean = mean / jnp.sqrt((1 - part) ** 2 + part**2)
    return jnp.clip(0.5 + 1.5 * mean, 0, 1)


def _hash(x, y, z, level, seed: int):
    """Integer lattice points to [0, 1) (an xor-multiply hash)."""
    mixed = x.astype(jnp.uint32) * np.uint32(0x8DA6B343) ^ y.astype(jnp.uint32) * np.uint32(0xD8163841)
    mixed = mixed ^ z.astype(jnp.uint32) * np.uint32(0xCB1AB31F) ^ level.astype(jnp.uint32) * np.uint32(0x165667B1)
    mixed = mixed + np.uint32(seed * 0x9E3779B1 & 0xFFFFFFFF)
    for factor in (0x7FEB352D, 0x846CA68B):
        mixed = (mixed ^ (mixed >> np.uint32(15))) * np.uint32(factor)
    return (mixed ^ (mixed >> np.uint32(16))) >> np.uint32(8)


def _value_noise(place, level, seed: int):
    """Random values at integer points, interpolated smoothly."""
    bound = 2.0**30
    place = [jnp.clip(p, -bound, bound) for p in place]
    low = [lax.stop_gradient(jnp.floor(p)) for p in place]
    part = [p - q for p, q in zip(place, low, strict=True)]
    ease = [t * t * (3 - 2 * t) for t in part]
    x, y, z = (q.astype(jnp.int32) for q in low)
    total = jnp.zeros_like(place[0])
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                weight = (ease[0] if i else 1 - ease[0]) * (ease[1] if j else 1 - ease[1])
                weight = weight * (ease[2] if k else 1 - ease[2])
                total += weight * _hash(x + i, y + j, z + k, level, seed).astype(total.dtype) * (1 / (1 << 24))
    return total
