"""Reflectance: isotropic Ashikhmin-Shirley (SPEC 7; TH10 3.2.2, corrected)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from shapeenh import checks, numerics
from shapeenh.types import Lights, Material

DIFFUSE = 28 / (23 * np.pi)


def _fifth(x):
    """x^5 by three products."""
    y = x * x
    return y * y * x


def diffuse_lobe(cos_light, cos_view):
    """rho_d / (R_d (1 - R_s)): `28/(23 pi) (1 - (1 - n.l/2)^5)(1 - (1 - n.e/2)^5)`."""
    return DIFFUSE * (1 - _fifth(1 - 0.5 * cos_light)) * (1 - _fifth(1 - 0.5 * cos_view))


def specular_lobe(cos_half, half_view, cos_light, cos_view, shininess):
    """rho_s / F: `(eta + 1)/(8 pi) (n.h)^eta / ((h.e) max(n.l, n.e))`.

    The denominator is held above the fourth root of the least number (3e-10 in float32): its square, which the
    derivative divides by, stays a number where light and viewer both graze the surface. 0 where n.h is not positive.
    """
    peak = numerics.safe_power(cos_half, shininess) * (shininess + 1) / (8 * np.pi)
    below = half_view * jnp.maximum(cos_light, cos_view)
    return peak / jnp.maximum(below, np.finfo(below.dtype).tiny ** 0.25)


def fresnel(specular, half_view):
    """Schlick: `F = R_s + (1 - R_s)(1 - e.h)^5`."""
    return specular + (1 - specular) * _fifth(1 - half_view)


def _dot(a, b):
    return jnp.sum(a * b, axis=-1, keepdims=True)


def ashikhmin_shirley(normal, light, view, material):
    """The isotropic Ashikhmin-Shirley BRDF, without the cosine.

    Source: SPEC 7; Ashikhmin and Shirley 2000; TH10 3.2.2 with the norm (eta + 1)/(8 pi).
    normal, light, view: [..., 3], unit, in one frame, pointing away from the surface; leading axes broadcast.
    material: `Material`; its fields may be Python floats, or arrays that broadcast with [..., 3] (shininess: [...]).
    Returns [..., 3], 1/sr, >= 0; 0 where the light or the viewer is behind the surface.
    Gradient: exact in all arguments where n.l > 0 and n.e > 0, zero elsewhere; finite everywhere.
    Errors: ValueError for a last axis other than 3, or concrete R_d, R_s outside [0, 1] or shininess < 0.
    """
    for name, array in (("normal", normal), ("light", light), ("view", view)):
        checks.check_shape(name, array, (..., 3))
    check_material(material)
    dtype = checks.float_dtype(normal, light, view)
    shape = np.broadcast_shapes(np.shape(normal), np.shape(light), np.shape(view))
    n, l, e = (jnp.broadcast_to(jnp.asarray(a, dtype), shape) for a in (normal, light, view))
    glossy = material.specular is not None
    reflectance = (material.diffuse, material.specular if glossy else 0.0)
    diffuse, specular = (jnp.broadcast_to(jnp.asarray(a, dtype), shape) for a in reflectance)
    shininess = jnp.broadcast_to(jnp.asarray(material.shininess, dtype), shape[:-1])[..., None]

    cos_light, cos_view = _dot(n, l), _dot(n, e)
    # Opposite directions have no half vector; one that is all but zero has derivatives that are no numbers.
    opposite = _dot(l + e, l + e) < np.finfo(dtype).tiny ** 0.5
    lit = (cos_light > 0) & (cos_view > 0) & ~opposite
    cos_light, cos_view = jnp.where(lit, cos_light, 1), jnp.where(lit, cos_view, 1)
    rho = diffuse * (1 - specular) * diffuse_lobe(cos_light, cos_view)
    if glossy:
        half = numerics.normalize(jnp.where(lit, l + e, e))
        half_view, cos_half = jnp.minimum(_dot(half, e), 1), jnp.minimum(_dot(n, half), 1)
        rho += fresnel(specular, half_view) * specular_lobe(cos_half, half_view, cos_light, cos_view, shininess)
    return jnp.where(lit, rho, 0)


def facing_normal(normal, valid):
    """[H, W, 3], normals that face the viewer; z where not valid. At the limb, those that turn away are mirrored in the
    image plane, as in the sums over lights."""
    z = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], normal.dtype), normal.shape)
    normal = jnp.where(valid[..., None], normal, z)
    return jnp.concatenate([normal[..., :2], jnp.abs(normal[..., 2:])], axis=-1)


def check_lights(lights) -> None:
    """A `Lights`; where concrete its values are finite and its directions unit vectors, to a tenth."""
    checks.check_type("lights", lights, Lights)
    checks.check_shape("lights.direction", lights.direction, (None, 3))
    checks.check_shape("lights.radiance", lights.radiance, np.shape(lights.direction))
    checks.check_finite("lights.direction", lights.direction)
    checks.check_finite("lights.radiance", lights.radiance)
    if checks.is_concrete(lights.direction):
        lengths = np.linalg.norm(np.asarray(lights.direction, np.float64), axis=-1)
        wrong = lengths[np.abs(lengths - 1) > 0.1]
        if wrong.size:
            raise ValueError(
                f"lights.direction holds {wrong.size} vector(s) of another length than 1, such as {wrong[0]:.3g}; "
                "accepted are unit vectors"
            )


def check_material(material) -> None:
    """A `Material`, and the ranges of its fields where concrete."""
    checks.check_type("material", material, Material)
    checks.check_range("material.diffuse", material.diffuse, 0, 1)
    if material.specular is not None:
        checks.check_range("material.specular", material.specular, 0, 1)
    checks.check_range("material.shininess", material.shininess, 0, np.inf)
