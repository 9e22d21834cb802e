"""shapeenh: makes the shape of things visible. A differentiable JAX toolkit; every public name is here."""

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
]
