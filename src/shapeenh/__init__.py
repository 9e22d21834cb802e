"""shapeenh: makes the shape of things visible. A differentiable JAX toolkit; every public name is here."""

from shapeenh.scene.camera import frame_mesh, orthographic_camera, perspective_camera
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
    "auto_exposure",
    "carved_knot",
    "composite",
    "frame_mesh",
    "make_mesh",
    "named_material",
    "orthographic_camera",
    "perspective_camera",
    "plane",
    "sphere",
    "tone_map",
    "torus",
    "vertex_normals",
]
