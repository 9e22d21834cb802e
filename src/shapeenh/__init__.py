"""shapeenh: makes the shape of things visible. A differentiable JAX toolkit; every public name is here."""

from shapeenh.light.brdf import ashikhmin_shirley
from shapeenh.light.radiance import shade, shade_warped
from shapeenh.light.warp import unwarp, warp, warp_jacobian, warp_tensor
from shapeenh.scene.camera import frame_mesh, orthographic_camera, perspective_camera
from shapeenh.scene.environment import procedural_sky, procedural_studio, rotate_lights, sample_environment
from shapeenh.scene.materials import named_material
from shapeenh.scene.mesh import make_mesh, vertex_normals
from shapeenh.scene.shapes import carved_knot, plane, sphere, torus
from shapeenh.style.tone import auto_exposure, composite, tone_map
from shapeenh.types import (
    Camera,
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
    "Camera",
    "Descriptor",
    "GBuffer",
    "LightWarp",
    "Lights",
    "LineField",
    "Material",
    "Mesh",
    "Profile",
    "RadianceScaling",
    "Visibility",
    "ashikhmin_shirley",
    "auto_exposure",
    "carved_knot",
    "composite",
    "frame_mesh",
    "make_mesh",
    "named_material",
    "orthographic_camera",
    "perspective_camera",
    "plane",
    "procedural_sky",
    "procedural_studio",
    "rotate_lights",
    "sample_environment",
    "shade",
    "shade_warped",
    "sphere",
    "tone_map",
    "torus",
    "unwarp",
    "vertex_normals",
    "warp",
    "warp_jacobian",
    "warp_tensor",
]
