"""shapeenh: makes the shape of things visible. A differentiable JAX toolkit; every public name is here."""

from shapeenh.buffers.borrow import resolve_coverage
from shapeenh.buffers.coverage import sample_coverage
from shapeenh.buffers.estimate import estimate_normals, estimate_radius
from shapeenh.buffers.gbuffer import render_gbuffer
from shapeenh.buffers.interpolate import barycentrics, interpolate
from shapeenh.buffers.normal_map import apply_normal_map
from shapeenh.buffers.normals import decode_normals
from shapeenh.buffers.padding import pad_mesh
from shapeenh.buffers.points import gbuffer_from_points
from shapeenh.buffers.sources import gbuffer_from_height, gbuffer_from_normals
from shapeenh.buffers.textures import apply_texture, sample_texture
from shapeenh.buffers.visibility import rasterize
from shapeenh.descriptor.apparent import describe_apparent, describe_object
from shapeenh.descriptor.convolution import line_integral_convolution
from shapeenh.descriptor.display import curvature_colors, curvature_legend
from shapeenh.descriptor.relief import curvature_intensity, describe_relief
from shapeenh.descriptor.view import (
    describe,
    gaussian_curvature,
    mean_curvature,
    principal_curvatures,
    principal_directions,
)
from shapeenh.fit.contrast import contrast
from shapeenh.fit.picture import FitResult
from shapeenh.fit.to_contrast import fit_contrast
from shapeenh.fit.to_image import fit_image
from shapeenh.io import load_environment, load_height, load_image, load_mesh, load_points, save_image
from shapeenh.light.brdf import ashikhmin_shirley
from shapeenh.light.lookup import environment_radiance, harmonic_radiance, prefilter_map, spherical_harmonics
from shapeenh.light.occlusion import ambient_occlusion
from shapeenh.light.phong import shade_phong
from shapeenh.light.radiance import shade, shade_scaled, shade_warped
from shapeenh.light.reflection import shade_diffuse, shade_forward, shade_mirror, shade_refraction
from shapeenh.light.scaling import curvature_mapping, radiance_scale
from shapeenh.light.warp import unwarp, warp, warp_jacobian, warp_tensor
from shapeenh.lines.brush import Brush, composite_lines, draw_lines
from shapeenh.lines.fields import fit_radius, line_field, make_line_field
from shapeenh.lines.noise import surface_noise
from shapeenh.lines.profile import fit_profile
from shapeenh.lines.styles import style_brush, style_footprint
from shapeenh.memory import keep_memory
from shapeenh.pipeline import enhance, render
from shapeenh.scene.camera import frame_mesh, orthographic_camera, perspective_camera
from shapeenh.scene.curvature import vertex_curvature
from shapeenh.scene.environment import procedural_sky, procedural_studio, rotate_lights, sample_environment
from shapeenh.scene.materials import named_material
from shapeenh.scene.mesh import make_mesh, vertex_normals
from shapeenh.scene.shapes import carved_knot, plane, sphere, torus
from shapeenh.style.lit_sphere import lit_sphere
from shapeenh.style.tone import auto_exposure, composite, tone_map
from shapeenh.types import (
    Camera,
    Coverage,
    Descriptor,
    GBuffer,
    Lights,
    LightWarp,
    LineField,
    Material,
    Mesh,
    Profile,
    RadianceScaling,
    Visibility,
)

__all__ = [
    "Brush",
    "Camera",
    "Coverage",
    "Descriptor",
    "FitResult",
    "GBuffer",
    "LightWarp",
    "Lights",
    "LineField",
    "Material",
    "Mesh",
    "Profile",
    "RadianceScaling",
    "Visibility",
    "ambient_occlusion",
    "apply_normal_map",
    "apply_texture",
    "ashikhmin_shirley",
    "auto_exposure",
    "barycentrics",
    "carved_knot",
    "composite",
    "composite_lines",
    "contrast",
    "curvature_colors",
    "curvature_intensity",
    "curvature_legend",
    "curvature_mapping",
    "decode_normals",
    "describe",
    "describe_apparent",
    "describe_object",
    "describe_relief",
    "draw_lines",
    "enhance",
    "environment_radiance",
    "estimate_normals",
    "estimate_radius",
    "fit_contrast",
    "fit_image",
    "fit_profile",
    "fit_radius",
    "frame_mesh",
    "gaussian_curvature",
    "gbuffer_from_height",
    "gbuffer_from_normals",
    "gbuffer_from_points",
    "harmonic_radiance",
    "interpolate",
    "keep_memory",
    "line_field",
    "line_integral_convolution",
    "lit_sphere",
    "load_environment",
    "load_height",
    "load_image",
    "load_mesh",
    "load_points",
    "make_line_field",
    "make_mesh",
    "mean_curvature",
    "named_material",
    "orthographic_camera",
    "pad_mesh",
    "perspective_camera",
    "plane",
    "prefilter_map",
    "principal_curvatures",
    "principal_directions",
    "procedural_sky",
    "procedural_studio",
    "radiance_scale",
    "rasterize",
    "render",
    "render_gbuffer",
    "resolve_coverage",
    "rotate_lights",
    "sample_coverage",
    "sample_environment",
    "sample_texture",
    "save_image",
    "shade",
    "shade_diffuse",
    "shade_forward",
    "shade_mirror",
    "shade_phong",
    "shade_refraction",
    "shade_scaled",
    "shade_warped",
    "sphere",
    "spherical_harmonics",
    "style_brush",
    "style_footprint",
    "surface_noise",
    "tone_map",
    "torus",
    "unwarp",
    "vertex_curvature",
    "vertex_normals",
    "warp",
    "warp_jacobian",
    "warp_tensor",
]
