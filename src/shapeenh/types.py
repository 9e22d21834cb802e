"""The records that flow between stages: per field its shape, frame, unit and background value.

All records are pytrees of arrays, so `jax.grad`, `jax.jit` and `jax.vmap` go through them. Optional fields are None.
Gradients pass through every floating-point field; masks and triangle ids are constants of the derivative.
Camera space is right-handed, x right, y up, z towards the viewer; images have row 0 at the top.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import jax
from jax.tree_util import register_dataclass


@register_dataclass
@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world space.

    vertices: [V, 3], world units.
    faces: [F, 3] int32, counter-clockwise seen from outside.
    normals: [V, 3], unit, world space.
    colors: [V, 3] linear RGB in [0, 1], or None.
    uv: [V, 2] texture coordinates, v up, or None.
    """

    vertices: jax.Array
    faces: jax.Array
    normals: jax.Array
    colors: jax.Array | None = None
    uv: jax.Array | None = None


@register_dataclass
@dataclass(frozen=True, eq=False)
class Camera:
    """A view: world to camera to OpenGL clip space (x right, y up, -w..w).

    view: [4, 4], world to camera, a rigid motion.
    projection: [4, 4], camera to clip; its last row is (0, 0, -1, 0) for perspective, (0, 0, 0, 1) for orthographic.
    """

    view: jax.Array
    projection: jax.Array


@register_dataclass
@dataclass(frozen=True, eq=False)
class Visibility:
    """What each pixel centre sees.

    triangle: [H, W] int32, index of the nearest face, -1 for background. No gradient.
    """

    triangle: jax.Array


@register_dataclass
@dataclass(frozen=True, eq=False)
class Coverage:
    """Whose shading the samples of each pixel borrow, S x S samples per pixel in reading order.

    source: [H, W, S * S] int8: 0 to 8, one of the 3 x 3 pixels around in reading order, 4 being the pixel itself;
        -1 where the sample sees background. No gradient.
    fraction: [H, W] in [0, 1], the share of the samples that see a surface; 0 where none does. No gradient.
    """

    source: jax.Array
    fraction: jax.Array


@register_dataclass
@dataclass(frozen=True, eq=False)
class GBuffer:
    """Per-pixel geometry, equal whatever it was made from.

    mask: [H, W] bool, True where a surface is seen. No gradient.
    depth: [H, W], distance along the view axis, positive, world units; 0 off the mask.
    normal: [H, W, 3], unit, camera space, z towards the viewer; 0 off the mask.
    position: [H, W, 3], camera space, world units; 0 off the mask.
    albedo: [H, W, 3] linear RGB, or None; 0 off the mask.
    occlusion: [H, W], 1 = open, 0 = occluded, or None; 1 off the mask.
    uv: [H, W, 2] texture coordinates, or None; 0 off the mask.
    """

    mask: jax.Array
    depth: jax.Array
    normal: jax.Array
    position: jax.Array
    albedo: jax.Array | None = None
    occlusion: jax.Array | None = None
    uv: jax.Array | None = None


@register_dataclass
@dataclass(frozen=True, eq=False)
class Descriptor:
    """The shape that an eye reads from a G-buffer (LW09 section 4).

    hessian: [H, W, 3] (xx, xy, yy), 1/px; convexities have negative, concavities positive curvature; 0 off the mask.
    gradient: [H, W, 2], slope of the relative depth field, after diffusion; 0 off the mask.
    silhouette: [H, W] weight in [0, 1]; 0 off the mask.
    crease: [H, W] weight in [0, 1]; 0 off the mask and where creases were not asked for.
    conductance: [H, W] in [0, 1]; 0 off the mask.

    Fields that `describe` was not asked for are None.
    """

    hessian: jax.Array
    gradient: jax.Array
    silhouette: jax.Array
    crease: jax.Array
    conductance: jax.Array


@register_dataclass
@dataclass(frozen=True, eq=False)
class Lights:
    """Directional lights.

    direction: [N, 3], unit, away from the surface. World frame from `sample_environment`, camera frame for `shade*`.
    radiance: [N, 3], linear RGB radiance times solid angle.
    """

    direction: jax.Array
    radiance: jax.Array


@register_dataclass
@dataclass(frozen=True, eq=False)
class Material:
    """Isotropic Ashikhmin-Shirley reflectance (SPEC 7).

    diffuse: [3], R_d in [0, 1]; multiplied by the G-buffer's albedo where there is one.
    specular: [3], R_s, the Fresnel reflectance at normal incidence, in [0, 1]. At 0 Schlick's formula still reflects
        at grazing angles; None = no specular lobe, which nothing is computed for.
    shininess: [], the Phong exponent eta >= 0 of the specular lobe.
    """

    diffuse: jax.Array
    specular: jax.Array | None = None
    shininess: jax.Array | float = 1.0


@register_dataclass
@dataclass(frozen=True, eq=False)
class LineField:
    """A height field and a direction field whose ridges are feature lines (TH10 ch. 7).

    height: [H, W]; 0 off the mask, except of occlusion lines, which straddle the outline and fade out beyond it.
    direction: [H, W, 2], unit, image x right, y up; a line, not an arrow; 0 where undefined, and where the height is 0.
    singularity: [H, W] in [0, 1]; 1 off the mask, except for occlusion lines.
    """

    height: jax.Array
    direction: jax.Array
    singularity: jax.Array


@register_dataclass
@dataclass(frozen=True, eq=False)
class Profile:
    """The height profile across the nearest feature line (TH10 7.2).

    distance: [H, W], signed, px, along the direction field; 0 where not valid.
    height: [H, W], the profile's height at its skeleton; 0 where not valid.
    curvature: [H, W], its second derivative there, 1/px^2 times the height's unit, negative; 0 where not valid.
    valid: [H, W] bool, True where a skeleton was found within the sampled interval.
    """

    distance: jax.Array
    height: jax.Array
    curvature: jax.Array
    valid: jax.Array


@register_dataclass
@dataclass(frozen=True, eq=False)
class LightWarp:
    """Parameters of light warping (LW09 section 5) as `render` takes them.

    alpha: [], strength, px at an image height of 600; 0 = no warp, > 0 compresses light where the surface is curved.
    gamma: [], contrast exponent in [-1, 1] (LW09 eq. 3); 0 = none.
    """

    alpha: jax.Array | float = 0.0
    gamma: jax.Array | float = 0.0


@register_dataclass
@dataclass(frozen=True, eq=False)
class RadianceScaling:
    """Parameters of radiance scaling (TH10 5.3) as `render` takes them.

    invariant: [], in ]0, 1[, the reflectance level that scaling leaves alone.
    gamma_diffuse, gamma_specular: [], strengths >= 0; 0 = none. `render` measures curvature in an image of height 600.
    anisotropy: [], in [-1, 1].
    """

    invariant: jax.Array | float = 0.5
    gamma_diffuse: jax.Array | float = 0.0
    gamma_specular: jax.Array | float = 0.0
    anisotropy: jax.Array | float = 0.0


def replace(record, **changes):
    """A copy of `record` with some fields changed (`dataclasses.replace`)."""
    return dataclasses.replace(record, **changes)
