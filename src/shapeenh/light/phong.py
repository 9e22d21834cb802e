"""Few lights: Lambert, sub-Lambertian and Phong, each component with its own strength (SPEC 6; TH10 3.2.2 and
5.3.2)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks, numerics
from shapeenh.light.brdf import check_lights, facing_normal
from shapeenh.light.scaling import check_strengths, radiance_scale, weighed_curvature
from shapeenh.light.warp import unwarp, warp_tensor
from shapeenh.types import Descriptor, GBuffer


@functools.partial(jax.jit, static_argnames=("warped", "scaled"))
def _shade_phong(warped, scaled, gbuffer, hessian, direction, radiance, colours, options):
    normal = gbuffer.normal
    valid = jnp.asarray(gbuffer.mask, bool) & jnp.all(jnp.isfinite(normal), axis=-1)
    if hessian is not None:
        valid = valid & jnp.all(jnp.isfinite(hessian), axis=-1)
        hessian = jnp.where(valid[..., None], hessian, 0)
    occlusion = gbuffer.occlusion
    for image in (*colours.values(), *([] if occlusion is None else [occlusion[..., None]])):
        valid = valid & jnp.all(jnp.isfinite(image), axis=-1)
    colours = {name: jnp.where(valid[..., None], image, 0) for name, image in colours.items()}
    normal = facing_normal(normal, valid)
    tensor = warp_tensor(hessian, options["alpha"], concave=options["concave"]) if warped else None

    def scaling(level, l, gamma):
        if not scaled:
            return level
        kappa = weighed_curvature(hessian, l, options["anisotropy"], options["concave"])
        return level * radiance_scale(kappa, level, options["invariant"], gamma)

    @jax.checkpoint
    def add(total, light):
        l, colour = jnp.broadcast_to(light[0], normal.shape), light[1]
        front = jnp.sum(normal * l, axis=-1) > 0
        l = unwarp(l, tensor) if warped else l
        cos = jnp.sum(normal * l, axis=-1)
        lit = front & (cos > 0)
        # r.e = 2 (n.l)(n.e) - l.e, e = z.
        mirrored = jnp.where(lit, 2 * cos * normal[..., 2] - l[..., 2], 0)
        diffuse = numerics.safe_power(jnp.where(lit, jnp.minimum(cos, 1), 0), options["exponent"])
        specular = numerics.safe_power(jnp.clip(mirrored, 0, 1), options["shininess"])
        diffuse = scaling(diffuse, l, options["gamma_diffuse"])
        specular = scaling(specular, l, options["gamma_specular"])
        shaded = colours["diffuse"] * diffuse[..., None] + colours["specular"] * specular[..., None]
        return total + shaded * jnp.broadcast_to(colour, normal.shape), None

    total, _ = lax.scan(add, jnp.zeros_like(normal), (direction, radiance))
    ambient = jnp.ones(normal.shape[:2], normal.dtype)
    if scaled:
        # A constant has no direction: mean curvature, at full level, brightens what is convex (mean-curvature shading).
        viewer = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], normal.dtype), normal.shape)
        ambient = scaling(ambient, viewer, options["gamma_ambient"])
    total = total + colours["ambient"] * ambient[..., None]
    if occlusion is not None:
        total = total * jnp.where(valid, occlusion, 0)[..., None]
    if warped:
        total = total * jnp.exp(options["contrast"] * jnp.log(numerics.determinant(tensor)))[..., None]
    return jnp.where(valid[..., None], total, 0)


def shade_phong(
    gbuffer,
    lights,
    *,
    descriptor=None,
    ambient=0.1,
    diffuse=0.7,
    specular=0.2,
    shininess=30.0,
    exponent=1.0,
    alpha=0.0,
    contrast=0.0,
    invariant=0.5,
    gamma_ambient=0.0,
    gamma_diffuse=0.0,
    gamma_specular=0.0,
    anisotropy=0.0,
    concave=1.0,
):
    """Phong's model under few lights, plain, warped or scaled: Lambert for `specular=0`, sub-Lambertian for exponent <
    1.

    Source: SPEC 6's rows "Phong" and "sub-Lambertian", `k_a + sum (k_d <n.l>^zeta + k_s <r.e>^eta) L_i`; its level
    delta is the lobe itself, and each component has its own strength. On the ambient term alone it is mean-curvature
    shading.
    gbuffer: `GBuffer`; its albedo multiplies ambient and diffuse colours, its occlusion everything. lights: `Lights` in
    the frame of the normals. descriptor: `Descriptor`, needed where a strength is not 0. ambient, diffuse, specular:
    [], [3] or [H, W, 3]. shininess: eta >= 0. exponent: zeta in [0, 1]. alpha, contrast, concave: as `shade_warped`
    (without J: a light is a colour here, not radiance over a solid angle). invariant, anisotropy: as `shade_scaled`.
    Returns [H, W, 3]; 0 off the mask. Gradient: in all arguments; 0 where a lobe is dark.
    Errors: ValueError for wrong records, shapes, values.
    """
    checks.check_type("gbuffer", gbuffer, GBuffer)
    check_lights(lights)
    checks.check_shape("gbuffer.normal", gbuffer.normal, (None, None, 3))
    size = np.shape(gbuffer.normal)[:2]
    checks.check_shape("gbuffer.mask", gbuffer.mask, size)
    checks.check_range("shininess", shininess, 0, np.inf)
    checks.check_range("exponent", exponent, 0, 1)
    strengths = {"gamma_ambient": gamma_ambient, "gamma_diffuse": gamma_diffuse, "gamma_specular": gamma_specular}
    options = {"alpha": alpha, "contrast": contrast, "invariant": invariant, "anisotropy": anisotropy} | strengths
    options |= {"concave": concave}
    check_strengths(**options)
    warped, scaled = not checks.is_zero(alpha), not checks.is_zero(*strengths.values())
    dtype = checks.float_dtype(gbuffer.normal)
    hessian = None
    if warped or scaled:
        checks.check_type("descriptor", descriptor, Descriptor)
        checks.check_shape("descriptor.hessian", descriptor.hessian, (*size, 3))
        hessian = jnp.asarray(descriptor.hessian, dtype)
    options |= {"shininess": shininess, "exponent": exponent}
    options = {name: jnp.broadcast_to(jnp.asarray(value, dtype), size) for name, value in options.items()}
    colours = {"ambient": ambient, "diffuse": diffuse, "specular": specular}
    for name, value in colours.items():
        checks.check_range(name, value, 0, np.inf)
    colours = {name: jnp.broadcast_to(jnp.asarray(value, dtype), (*size, 3)) for name, value in colours.items()}
    if gbuffer.albedo is not None:
        colours |= {name: colours[name] * jnp.asarray(gbuffer.albedo, dtype) for name in ("ambient", "diffuse")}
    direction, radiance = (jnp.asarray(a, dtype) for a in (lights.direction, lights.radiance))
    return _shade_phong(warped, scaled, gbuffer, hessian, direction, radiance, colours, options)
