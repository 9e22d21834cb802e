"""Ambient occlusion from a depth image, plain and warped (SPEC 5: `(1/pi) integral max(n.W(l), 0) V(W(l)) dl`)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks
from shapeenh.light.warp import warp_jacobian, warp_tensor
from shapeenh.numerics import sphere_directions
from shapeenh.types import Camera, Descriptor, GBuffer


def _depth_at(depth, mask, projection, point):
    """(depth of the surface seen where a camera-space point [..., 3] projects, whether there is one)."""
    height, width = depth.shape
    clip = [sum(projection[r, k] * point[..., k] for k in range(3)) + projection[r, 3] for r in (0, 1, 3)]
    ahead = clip[2] > 0
    w = jnp.where(ahead, clip[2], 1)
    column = jnp.floor((clip[0] / w + 1) * (0.5 * width)).astype(jnp.int32)
    row = jnp.floor((1 - clip[1] / w) * (0.5 * height)).astype(jnp.int32)
    inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    row, column = jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)
    return depth[row, column], inside & mask[row, column]


@functools.partial(jax.jit, static_argnames=("directions", "steps", "warped"))
def _occlusion(directions, steps, warped, mask, depth, normal, position, hessian, projection, radius, alpha):
    valid = mask & jnp.all(jnp.isfinite(normal) & jnp.isfinite(position), axis=-1) & jnp.isfinite(depth)
    if warped:
        valid = valid & jnp.all(jnp.isfinite(hessian), axis=-1)
        tensor = warp_tensor(jnp.where(valid[..., None], hessian, 0), alpha)
    z = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], normal.dtype), normal.shape)
    normal = jnp.where(valid[..., None], normal, z)
    start = jnp.where(valid[..., None], position, 0)
    # Off the surface, so that it does not hide itself by the depth image's own steps.
    start = lax.stop_gradient(start + 0.02 * radius * normal)
    # Steps grow outwards: near occluders matter most and are missed first.
    reach = ((np.arange(steps) + 0.5) / steps) ** 1.5

    def visible(l):
        seen = jnp.ones(depth.shape, bool)
        for t in reach:
            point = start + (t * radius) * l
            surface, there = _depth_at(depth, valid, projection, point)
            behind = -point[..., 2] - surface
            # What lies far in front is another part: it does not hide a ray of this length.
            seen = seen & ~(there & (behind > 0) & (behind < 2 * radius))
        return seen

    def add(total, l):
        open_, whole = total
        l = jnp.broadcast_to(l, normal.shape)
        weight = jnp.maximum(jnp.sum(normal * l, axis=-1), 0)
        if warped:
            weight = weight * warp_jacobian(l, tensor)
        return (open_ + jnp.where(visible(l), weight, 0), whole + weight), None

    zero = jnp.zeros(depth.shape, normal.dtype)
    (open_, whole), _ = lax.scan(
        jax.checkpoint(add), (zero, zero), jnp.asarray(sphere_directions(2 * directions), normal.dtype)
    )
    # Plain: the share of the hemisphere that is open. Warped: SPEC's integral as it stands, which also brightens and
    # darkens by how much the warp widens the hemisphere.
    amount = open_ * (2 / directions) if warped else open_ / jnp.maximum(whole, 1e-6)
    return jnp.where(valid, amount, 1)


def ambient_occlusion(gbuffer, camera, *, radius, descriptor=None, alpha=0.0, directions=32, steps=6):
    """Share of the hemisphere that nothing seen in the depth image hides, by rays from every pixel.

    Source: SPEC 5 (warped ambient occlusion) and 6; LW09 6.3. Warped, the integral is taken over warped directions l'
    = W(l), `(1/pi) sum <n.l'> V(l') J`, so the rays are the same for every strength.
    gbuffer: `GBuffer`. camera: `Camera` of the depth image. radius: [], world units, > 0: how far rays look.
    descriptor: `Descriptor`, needed where alpha is not 0. alpha: [], px. *Static*: directions of the hemisphere, steps
    of a ray.
    Returns [H, W], 1 = open; in [0, 1] for alpha = 0; 1 off the mask. For `GBuffer.occlusion`.
    Gradient: in alpha, hessian and normals, at fixed visibility. Errors: ValueError for wrong records, shapes, values.
    """
    checks.check_type("gbuffer", gbuffer, GBuffer)
    checks.check_type("camera", camera, Camera)
    checks.check_shape("gbuffer.normal", gbuffer.normal, (None, None, 3))
    size = np.shape(gbuffer.normal)[:2]
    checks.check_shape("gbuffer.depth", gbuffer.depth, size)
    checks.check_shape("gbuffer.position", gbuffer.position, (*size, 3))
    checks.check_range("radius", radius, 0, np.inf, open_ends=True)
    checks.check_finite("alpha", alpha)
    directions = checks.check_size("directions", directions, low=4, high=1024)
    steps = checks.check_size("steps", steps, low=1, high=64)
    dtype = checks.float_dtype(gbuffer.normal)
    warped = not checks.is_zero(alpha)
    hessian = None
    if warped:
        checks.check_type("descriptor", descriptor, Descriptor)
        checks.check_shape("descriptor.hessian", descriptor.hessian, (*size, 3))
        hessian = jnp.asarray(descriptor.hessian, dtype)
    planes = (jnp.asarray(a, dtype) for a in (gbuffer.depth, gbuffer.normal, gbuffer.position))
    projection, radius, alpha = (jnp.asarray(a, dtype) for a in (camera.projection, radius, alpha))
    mask = jnp.asarray(gbuffer.mask, bool)
    return _occlusion(directions, steps, warped, mask, *planes, hessian, projection, radius, alpha)
