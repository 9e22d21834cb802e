"""Ready chains of the stages, with no mathematics of their own.

Each stage decides from concrete inputs what it can skip and calls one compiled function; under somebody's `jit` or
`grad` the general variants are traced.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from shapeenh.buffers.borrow import resolve_coverage
from shapeenh.buffers.coverage import sample_coverage
from shapeenh.buffers.gbuffer import render_gbuffer
from shapeenh.checks import as_number, check_range, check_size, check_type
from shapeenh.descriptor.view import describe
from shapeenh.light.radiance import shade, shade_scaled, shade_warped
from shapeenh.scene.environment import rotate_lights
from shapeenh.types import (
    Camera,
    Descriptor,
    GBuffer,
    Lights,
    LightWarp,
    Material,
    Mesh,
    RadianceScaling,
    replace,
)

REFERENCE_HEIGHT = 600  # px: what a person sets (alpha, sigma) is stated for an image of this height (SPEC 1)


def render(
    mesh: Mesh,
    camera: Camera,
    lights: Lights,
    material: Material,
    enhancement: LightWarp | RadianceScaling | None = None,
    *,
    height: int,
    width: int,
    sigma: float | jax.Array = 0.0,
    foreshortening: float | jax.Array = 1.0,
    creases: bool = False,
    cull: bool | str = False,
    samples: int = 1,
) -> jax.Array:
    """The whole chain, from a mesh to linear radiance (LW09 fig. 4).

    Args:
        mesh, camera: what is seen, and whence.
        lights: directions in *world* space, as `sample_environment` gives them.
        material: reflectance; multiplied by the mesh's colours where it has any.
        enhancement: `LightWarp`, `RadianceScaling`, or None for the plain picture.
        height, width: image size, px.
        sigma: scale of the descriptor, px at an image height of 600, >= 0 (LW09 4.3).
        foreshortening: exponent f of SPEC 3.1.
        creases: whether sharp edges of the normals insulate the descriptor.
        cull: which faces are not drawn, as in `rasterize`.
        samples: per pixel and axis, 1 to 8, for smooth outlines; shading stays at one per pixel (`sample_coverage`).

    `alpha` and `sigma` are stated for a height of 600 px and rescaled, so that the picture is the same at every size.

    Static: height, width, creases, cull, samples. Nothing is compiled again when other values change.
    Returns: `[H, W, 3]` linear RGB radiance, 0 off the mask; with samples, times the covered fraction of the pixel.
    Gradient: with respect to enhancement, lights, material, sigma, camera and mesh, at fixed visibility and coverage.
    Errors: ValueError that names the argument.

    >>> image = se.render(mesh, camera, lights, material, se.LightWarp(alpha=40.0), height=600, width=800, sigma=2.0)
    """
    check_size("samples", samples, high=8)
    gbuffer = render_gbuffer(mesh, camera, height=height, width=width, cull=cull)
    image = enhance(
        gbuffer,
        rotate_lights(lights, camera),
        material,
        enhancement,
        sigma=sigma,
        foreshortening=foreshortening,
        creases=creases,
    )
    if samples == 1:
        return image
    return resolve_coverage(image, sample_coverage(mesh, camera, gbuffer, samples=samples, cull=cull))


def enhance(
    gbuffer: GBuffer,
    lights: Lights,
    material: Material,
    enhancement: LightWarp | RadianceScaling | None = None,
    *,
    sigma: float | jax.Array = 0.0,
    foreshortening: float | jax.Array = 1.0,
    creases: bool = False,
) -> jax.Array:
    """From any G-buffer to linear radiance: descriptor, then light.

    Args: as `render`, but lights in the *camera* frame, that of the normals.
    Returns: `[H, W, 3]` linear RGB radiance, 0 off the mask.
    Gradient: with respect to enhancement, lights, material, sigma and the G-buffer.
    """
    check_type("gbuffer", gbuffer, GBuffer)
    check_enhancement(enhancement)
    check_range("sigma", sigma, 0, jnp.inf)
    if enhancement is None:
        return shade(gbuffer, lights, material)
    scale = gbuffer.mask.shape[0] / REFERENCE_HEIGHT
    descriptor = describe(
        gbuffer,
        sigma=as_number(sigma) * scale,
        foreshortening=foreshortening,
        creases=creases,
        fields=("hessian",),
    )
    return illuminate(gbuffer, descriptor, lights, material, enhancement)


def illuminate(
    gbuffer: GBuffer,
    descriptor: Descriptor,
    lights: Lights,
    material: Material,
    enhancement: LightWarp | RadianceScaling | None,
) -> jax.Array:
    """The light stage for a ready descriptor, with strengths stated for an image height of 600 px."""
    scale = gbuffer.mask.shape[0] / REFERENCE_HEIGHT
    if isinstance(enhancement, LightWarp):
        alpha = as_number(enhancement.alpha) * scale
        return shade_warped(gbuffer, descriptor, lights, material, alpha=alpha, gamma=enhancement.gamma)
    if isinstance(enhancement, RadianceScaling):
        return shade_scaled(
            gbuffer,
            replace(descriptor, hessian=descriptor.hessian * scale),  # curvature as a picture of 600 px would show it
            lights,
            material,
            invariant=enhancement.invariant,
            gamma_diffuse=enhancement.gamma_diffuse,
            gamma_specular=enhancement.gamma_specular,
            anisotropy=enhancement.anisotropy,
        )
    return shade(gbuffer, lights, material)


def check_enhancement(enhancement) -> None:
    """Type and ranges of the enhancement records."""
    if enhancement is None:
        return
    if isinstance(enhancement, LightWarp):
        check_range("alpha", enhancement.alpha, -jnp.inf, jnp.inf)
        check_range("gamma", enhancement.gamma, -1, 1)
    elif isinstance(enhancement, RadianceScaling):
        check_range("invariant", enhancement.invariant, 0, 1, open_ends=True)
        check_range("gamma_diffuse", enhancement.gamma_diffuse, 0, jnp.inf)
        check_range("gamma_specular", enhancement.gamma_specular, 0, jnp.inf)
        check_range("anisotropy", enhancement.anisotropy, -1, 1)
    else:
        given = type(enhancement).__name__
        raise ValueError(f"enhancement is a {given}; accepted are LightWarp, RadianceScaling or None")
