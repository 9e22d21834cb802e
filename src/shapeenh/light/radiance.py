"""Reflected radiance: the sums over lights, plain and warped (SPEC 5 and 7; LW09 eq. 2 and 3)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks, numerics
from shapeenh.light import brdf, warp
from shapeenh.types import Descriptor, GBuffer, Lights, Material


def shading_normal(normal):
    """The normal that is shaded: as given where it faces the viewer, mirrored in the image plane where it does not.

    A visible surface faces the viewer, but interpolated normals overshoot at the limb. There every BRDF is 0 and a
    black rim would result; with |n_z| the limb continues the shading of the pixels before it.
    """
    return jnp.concatenate([normal[..., :2], jnp.abs(normal[..., 2:])], axis=-1)


@functools.partial(jax.jit, static_argnames=("warped",))
def _shade(mask, normal, albedo, hessian, lights, material, alpha, gamma, *, warped):
    n = jnp.where(mask[..., None], shading_normal(normal), jnp.asarray([0.0, 0.0, 1.0], normal.dtype)[None, None])
    view = jnp.asarray([0.0, 0.0, 1.0], normal.dtype)
    tensor = warp.warp_tensor(jnp.where(mask[..., None], hessian, 0), alpha) if warped else None
    diffuse = jnp.broadcast_to(material.diffuse, normal.shape) * (1 if albedo is None else albedo)
    material = Material(diffuse, jnp.broadcast_to(material.specular, normal.shape), material.shininess)

    @jax.checkpoint
    def add(total, light):
        direction, radiance = light
        cos_warped = jnp.sum(n * direction[None, None], axis=-1)
        if warped:
            l, weight = warp.unwarp(direction, tensor), warp.warp_jacobian(direction, tensor)
        else:
            l, weight = jnp.broadcast_to(direction, n.shape), 1.0
        cos = jnp.sum(n * l, axis=-1)
        weight = jnp.where((cos > 0) & (cos_warped > 0), cos * weight, 0)
        rho = brdf.ashikhmin_shirley(n, l, view, material)
        return total + rho * weight[..., None] * radiance[None, None], None

    total, _ = lax.scan(add, jnp.zeros_like(normal), (lights.direction, lights.radiance))
    if warped:
        total = total * jnp.exp(gamma * jnp.log(numerics.determinant(tensor)))[..., None]
    return jnp.where(mask[..., None], total, 0)


def _check(gbuffer, lights, material):
    checks.check_type("gbuffer", gbuffer, GBuffer)
    checks.check_type("lights", lights, Lights)
    checks.check_type("material", material, Material)
    checks.check_shape("gbuffer.normal", gbuffer.normal, (None, None, 3))
    checks.check_shape("gbuffer.mask", gbuffer.mask, np.shape(gbuffer.normal)[:2])
    if gbuffer.albedo is not None:
        checks.check_shape("gbuffer.albedo", gbuffer.albedo, np.shape(gbuffer.normal))
    checks.check_shape("lights.direction", lights.direction, (None, 3))
    checks.check_shape("lights.radiance", lights.radiance, np.shape(lights.direction))
    checks.check_finite("lights.direction", lights.direction)
    checks.check_finite("lights.radiance", lights.radiance)
    brdf.check_material(material)


def _call(gbuffer, hessian, lights, material, alpha, gamma, warped):
    dtype = checks.float_dtype(gbuffer.normal)
    lights, material = jax.tree.map(lambda a: jnp.asarray(a, dtype), (lights, material))
    return _shade(gbuffer.mask, gbuffer.normal, gbuffer.albedo, hessian, lights, material, alpha, gamma, warped=warped)


def shade(gbuffer, lights, material):
    """Radiance reflected towards the viewer by Ashikhmin-Shirley under directional lights.

    Source: SPEC 7; `sum over i of rho(z, l_i) <n.l_i> L_i`.
    gbuffer: `GBuffer`; `albedo`, where there is one, multiplies the diffuse reflectance. lights: `Lights` in the frame
    of the normals (camera space). material: `Material`.
    Returns [H, W, 3], linear radiance, >= 0; 0 off the mask. At the limb, where interpolated normals turn away from the
    viewer, |n_z| is used (`shading_normal`).
    Gradient: exact in normals, albedo, lights and material. Errors: ValueError for wrong records, shapes, values.
    """
    _check(gbuffer, lights, material)
    return _call(gbuffer, None, lights, material, 0.0, 0.0, False)


def shade_warped(gbuffer, descriptor, lights, material, *, alpha, gamma=0.0):
    """Radiance reflected towards the viewer with the light bent by the surface's curvature.

    Source: LW09 eq. 2 and 3; SPEC 5, inverse form: `det(L)^gamma sum rho(z, l_i) <n.l_i> L_i J`, l_i = W^-1(l'_i).
    gbuffer, lights, material: as in `shade`. descriptor: `Descriptor`; its `hessian` is used.
    alpha: [], px, any finite value: strength; 0 = no warp. gamma: [], in [-1, 1]: contrast; 0 = none.
    Returns [H, W, 3], linear radiance, >= 0; 0 off the mask. `alpha = gamma = 0` gives `shade` up to rounding.
    Gradient: exact in alpha, gamma, hessian, normals, albedo, lights and material.
    Errors: ValueError for wrong records, shapes, values.
    """
    _check(gbuffer, lights, material)
    checks.check_type("descriptor", descriptor, Descriptor)
    checks.check_shape("descriptor.hessian", descriptor.hessian, np.shape(gbuffer.normal))
    checks.check_finite("alpha", alpha)
    checks.check_range("gamma", gamma, -1, 1)
    dtype = checks.float_dtype(gbuffer.normal)
    alpha, gamma = jnp.asarray(alpha, dtype), jnp.asarray(gamma, dtype)
    return _call(gbuffer, jnp.asarray(descriptor.hessian, dtype), lights, material, alpha, gamma, True)
