"""What can look radiance up in any direction: mirror, refraction, prefiltered diffuse light, and eq. 1 by quadrature.

Source: SPEC 5, forward form, and 6; LW09 eq. 1 and 6.3; TH10 5.2.3 and 5.3.2. Each look is one direction per pixel, in
which light is looked up, warped by the surface's curvature, scaled by it, or both.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks, numerics
from shapeenh.light.brdf import ashikhmin_shirley, check_material, facing_normal
from shapeenh.light.lookup import finite_map, harmonic_radiance, looked_up
from shapeenh.light.scaling import check_strengths, radiance_scale, weighed_curvature
from shapeenh.light.warp import warp, warp_tensor
from shapeenh.types import Descriptor, GBuffer, Material

# ------------------------------------------------------------------------------------------- bending and scaling


def _shading_normal(gbuffer):
    """(unit normals that face the viewer, where they are valid); z elsewhere."""
    normal = jnp.asarray(gbuffer.normal, checks.float_dtype(gbuffer.normal))
    valid = jnp.asarray(gbuffer.mask, bool) & jnp.all(jnp.isfinite(normal), axis=-1)
    return facing_normal(normal, valid), valid


def _to_map(direction, rotation):
    """Camera space to the map's world; a sum of planes, because products of matrices may run in lower precision."""
    return jnp.stack([sum(rotation[i, k] * direction[..., k] for k in range(3)) for i in range(3)], axis=-1)


@functools.partial(jax.jit, static_argnames=("look", "warped", "scaled"))
def _shade_lookup(look, warped, scaled, gbuffer, hessian, radiance_map, rotation, tint, options):
    normal, valid = _shading_normal(gbuffer)
    if hessian is not None:
        valid = valid & jnp.all(jnp.isfinite(hessian), axis=-1)
        hessian = jnp.where(valid[..., None], hessian, 0)
    maps = [gbuffer.albedo, None if gbuffer.occlusion is None else gbuffer.occlusion[..., None]]
    maps = [m for m in maps if m is not None] if look is _diffuse_direction else []
    for m in maps:
        valid = valid & jnp.all(jnp.isfinite(m), axis=-1)
    direction = look(normal, options)
    bent, contrast = direction, jnp.ones_like(normal[..., :1])
    if warped:
        tensor = warp_tensor(hessian, options["alpha"], concave=options["concave"])
        bent = warp(direction, tensor)
        contrast = jnp.exp(options["contrast"] * jnp.log(numerics.determinant(tensor)))[..., None]
    harmonic = radiance_map.ndim == 2
    find = harmonic_radiance if harmonic else looked_up
    radiance_map = finite_map(radiance_map)
    radiance = find(radiance_map, _to_map(bent, rotation))
    if scaled:
        # The level is the brightness relative to the map's brightest place, so that hue stays.
        whole = (
            harmonic_radiance(radiance_map, jnp.asarray(numerics.sphere_directions(512), normal.dtype))
            if harmonic
            else radiance_map
        )
        level = numerics.safe_divide(numerics.luminance(radiance), jnp.max(numerics.luminance(whole)))
        kappa = weighed_curvature(hessian, direction, options["anisotropy"], options["concave"])
        radiance = radiance * radiance_scale(kappa, level, options["invariant"], options["gamma"])[..., None]
    radiance = radiance * contrast * tint
    for m in maps:
        radiance = radiance * jnp.where(valid[..., None], m, 0)  # a product with NaN would poison the gradient of all
    return jnp.where(valid[..., None], radiance, 0)


def _look(look, gbuffer, radiance_map, tint, descriptor, rotation, options, **more):
    """Checks, what can be skipped, and the compiled lookup; `options` are strengths, `more` what `look` needs."""
    checks.check_type("gbuffer", gbuffer, GBuffer)
    checks.check_shape("gbuffer.normal", gbuffer.normal, (None, None, 3))
    size = np.shape(gbuffer.normal)[:2]
    checks.check_shape("gbuffer.mask", gbuffer.mask, size)
    checks.check_finite("radiance_map", radiance_map)
    check_strengths(**options)
    warped, scaled = not checks.is_zero(options["alpha"]), not checks.is_zero(options["gamma"])
    dtype = checks.float_dtype(gbuffer.normal)
    hessian = None
    if warped or scaled:
        checks.check_type("descriptor", descriptor, Descriptor)
        checks.check_shape("descriptor.hessian", descriptor.hessian, (*size, 3))
        hessian = jnp.asarray(descriptor.hessian, dtype)
    if rotation is None:
        rotation = np.eye(3)
    checks.check_shape("rotation", rotation, (3, 3))
    checks.check_finite("rotation", rotation)
    planes = {name: jnp.broadcast_to(jnp.asarray(value, dtype), size) for name, value in (options | more).items()}
    tint = jnp.broadcast_to(jnp.asarray(tint, dtype), (*size, 3))
    radiance_map, rotation = jnp.asarray(radiance_map, dtype), jnp.asarray(rotation, dtype)
    return _shade_lookup(look, warped, scaled, gbuffer, hessian, radiance_map, rotation, tint, planes)


# ------------------------------------------------------------------------------------------- the looks


def _mirror_direction(normal, options):
    """r = 2 (n.e) n - e, e = z."""
    z = 2 * normal[..., 2:]
    return z * normal - jnp.asarray([0.0, 0.0, 1.0], normal.dtype).reshape((1,) * (normal.ndim - 1) + (3,))


def _refracted_direction(normal, options):
    """Snell's law for the view ray -z that enters a medium of index `ior`."""
    ratio = 1 / options["ior"]
    cos = normal[..., 2]
    # Entering a denser medium never reflects totally; a thinner one does beyond the critical angle: held at grazing.
    inner = numerics.safe_sqrt(1 - ratio * ratio * (1 - cos * cos))
    along = ratio * cos - inner
    return along[..., None] * normal - (ratio[..., None] * jnp.asarray([0.0, 0.0, 1.0], normal.dtype).reshape(1, 1, 3))


def _diffuse_direction(normal, options):
    return normal


def shade_mirror(
    gbuffer,
    radiance_map,
    *,
    descriptor=None,
    rotation=None,
    reflectance=1.0,
    alpha=0.0,
    contrast=0.0,
    invariant=0.5,
    gamma=0.0,
    anisotropy=0.0,
    concave=1.0,
):
    """A perfect mirror under an environment map, plain, warped (eq. 1) or scaled.

    Source: SPEC 5 eq. 1 with a mirror's reflectance, `L(W(r))`; SPEC 6's row with delta = L(r)/max L.
    gbuffer: `GBuffer`. radiance_map: [h, w, 3]. descriptor: `Descriptor`, needed where alpha or gamma is not 0.
    rotation: [3, 3], camera space to the map's world (`camera.view[:3, :3].T`), or None. reflectance: [], [3] or
    [H, W, 3]. alpha, contrast, concave: as `shade_warped`. invariant, gamma, anisotropy: as `shade_scaled`, one
    strength.
    Returns [H, W, 3], linear radiance; 0 off the mask.
    Gradient: through the bilinear lookup, in all arguments; none across the map's pixels' borders.
    Errors: ValueError for wrong records, shapes, values.
    """
    checks.check_shape("radiance_map", radiance_map, (None, None, 3))
    options = {"alpha": alpha, "contrast": contrast, "invariant": invariant, "gamma": gamma}
    options |= {"anisotropy": anisotropy, "concave": concave}
    return _look(_mirror_direction, gbuffer, radiance_map, reflectance, descriptor, rotation, options)


def shade_refraction(
    gbuffer,
    radiance_map,
    *,
    descriptor=None,
    rotation=None,
    ior=1.5,
    transmittance=1.0,
    alpha=0.0,
    contrast=0.0,
    invariant=0.5,
    gamma=0.0,
    anisotropy=0.0,
    concave=1.0,
):
    """A clear body under an environment map: refracted once where the view ray enters, with Fresnel's reflection.

    Source: SPEC 6's row "refraction (one bounce)"; LW09 6.3. Schlick's reflectance weighs reflected and refracted
    light.
    ior: [] or [H, W], relative index of refraction, >= 1. transmittance: [], [3] or [H, W, 3]. All else, what it
    returns, gradient and errors: as `shade_mirror`.
    """
    checks.check_shape("radiance_map", radiance_map, (None, None, 3))
    checks.check_range("ior", ior, 1, np.inf)
    options = {"alpha": alpha, "contrast": contrast, "invariant": invariant, "gamma": gamma}
    options |= {"anisotropy": anisotropy, "concave": concave}
    common = {"descriptor": descriptor, "rotation": rotation, "options": options}
    inside = _look(_refracted_direction, gbuffer, radiance_map, transmittance, **common, ior=ior)
    outside = _look(_mirror_direction, gbuffer, radiance_map, 1.0, **common)
    normal, _ = _shading_normal(gbuffer)
    base = ((jnp.asarray(ior, normal.dtype) - 1) / (jnp.asarray(ior, normal.dtype) + 1)) ** 2
    base = jnp.broadcast_to(base, normal.shape[:2])
    share = (base + (1 - base) * (1 - normal[..., 2]) ** 5)[..., None]
    return inside + share * (outside - inside)


def shade_diffuse(
    gbuffer,
    irradiance,
    *,
    descriptor=None,
    rotation=None,
    albedo=0.7,
    alpha=0.0,
    contrast=0.0,
    invariant=0.5,
    gamma=0.0,
    anisotropy=0.0,
    concave=1.0,
):
    """A matt body under a prefiltered environment, with ambient occlusion: `A(p) rho Lbar(n)`.

    Source: SPEC 6's row "prefiltered diffuse + ambient occlusion"; TH10 5.3.2.
    irradiance: [h, w, 3] of `prefilter_map`, or the nine coefficients [9, 3] of `spherical_harmonics`: on a CPU 30
    times faster to look up, and 3 to 10 % off under maps with lamps, where a map of 32 rows is 0.3 % off
    (`benchmarks/diffuse.py`). albedo: [], [3] or [H, W, 3]; multiplied by the G-buffer's albedo and
    occlusion where there are any. All else, what it returns, gradient and errors: as `shade_mirror`.
    """
    options = {"alpha": alpha, "contrast": contrast, "invariant": invariant, "gamma": gamma}
    options |= {"anisotropy": anisotropy, "concave": concave}
    if np.shape(irradiance) != (9, 3):
        checks.check_shape("irradiance", irradiance, (None, None, 3))
    return _look(_diffuse_direction, gbuffer, irradiance, albedo, descriptor, rotation, options)


# ------------------------------------------------------------------------------------------- eq. 1 by quadrature


@functools.partial(jax.jit, static_argnames=("samples",))
def _integrate(samples, gbuffer, hessian, radiance_map, rotation, material, alpha, gamma):
    radiance_map = finite_map(radiance_map)
    normal, valid = _shading_normal(gbuffer)
    valid = valid & jnp.all(jnp.isfinite(hessian), axis=-1)
    tensor = warp_tensor(jnp.where(valid[..., None], hessian, 0), alpha)
    view = jnp.asarray([0.0, 0.0, 1.0], normal.dtype)
    if gbuffer.albedo is not None:
        valid = valid & jnp.all(jnp.isfinite(gbuffer.albedo), axis=-1)
        albedo = jnp.where(valid[..., None], gbuffer.albedo, 0)
        material = Material(material.diffuse * albedo, material.specular, material.shininess)

    @jax.checkpoint
    def add(total, l):
        l = jnp.broadcast_to(l, normal.shape)
        bent = warp(l, tensor)
        cos, cos_bent = (jnp.sum(normal * d, axis=-1) for d in (l, bent))
        weight = jnp.where((cos > 0) & (cos_bent > 0), cos, 0)[..., None]
        light = looked_up(radiance_map, _to_map(bent, rotation))
        return total + ashikhmin_shirley(normal, l, view, material) * light * weight, None

    directions = jnp.asarray(numerics.sphere_directions(samples), normal.dtype)
    total, _ = lax.scan(add, jnp.zeros_like(normal), directions)
    contrast = jnp.exp(gamma * jnp.log(numerics.determinant(tensor)))[..., None]
    return jnp.where(valid[..., None], total * contrast * (4 * np.pi / samples), 0)


def shade_forward(gbuffer, descriptor, radiance_map, material, *, alpha, gamma=0.0, rotation=None, samples=1024):
    """Light warping in its forward form: `integral rho(e, l) <n.l> L(W(l)) dl`, radiance looked up in a map.

    Source: LW09 eq. 1; SPEC 5. The same integral as `shade_warped` with more and more lights; for what can look
    radiance up in any direction, and slower: a lookup per pixel and direction.
    gbuffer, descriptor, material, alpha, gamma: as `shade_warped`. radiance_map: [h, w, 3]. rotation: [3, 3], camera
    space to the map's world, or None. *Static*: samples, directions of the quadrature (golden spiral).
    Returns [H, W, 3]; 0 off the mask. Gradient: in all arguments; memory does not grow with samples.
    Errors: ValueError for wrong records, shapes, values.
    """
    checks.check_type("gbuffer", gbuffer, GBuffer)
    checks.check_type("descriptor", descriptor, Descriptor)
    checks.check_type("material", material, Material)
    checks.check_shape("gbuffer.normal", gbuffer.normal, (None, None, 3))
    checks.check_shape("descriptor.hessian", descriptor.hessian, np.shape(gbuffer.normal))
    checks.check_shape("radiance_map", radiance_map, (None, None, 3))
    checks.check_finite("radiance_map", radiance_map)
    check_material(material)
    checks.check_finite("alpha", alpha)
    checks.check_range("gamma", gamma, -1, 1)
    samples = checks.check_size("samples", samples, high=1 << 20)
    dtype = checks.float_dtype(gbuffer.normal)
    rotation = np.eye(3) if rotation is None else rotation
    checks.check_shape("rotation", rotation, (3, 3))
    size = np.shape(gbuffer.normal)
    arrays = (descriptor.hessian, radiance_map, rotation)
    hessian, radiance_map, rotation = (jnp.asarray(a, dtype) for a in arrays)
    material = jax.tree.map(lambda field: jnp.asarray(field, dtype), material)
    diffuse = jnp.broadcast_to(material.diffuse, size)
    material = Material(diffuse, material.specular, material.shininess)
    alpha, gamma = (jnp.broadcast_to(jnp.asarray(a, dtype), size[:2]) for a in (alpha, gamma))
    return _integrate(samples, gbuffer, hessian, radiance_map, rotation, material, alpha, gamma)
