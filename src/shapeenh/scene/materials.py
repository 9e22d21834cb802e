"""Named materials: Ashikhmin-Shirley parameters that read well under an environment (SPEC 7)."""

from __future__ import annotations

import jax.numpy as jnp

from shapeenh.checks import check_choice
from shapeenh.types import Material

#        diffuse R_d                 specular R_s            shininess
#                                    (None: no lobe)
PRESETS = {
    "plaster": ((0.80, 0.79, 0.77), None, 1.0),
    "clay": ((0.62, 0.46, 0.38), (0.02, 0.02, 0.02), 12.0),
    "stone": ((0.55, 0.54, 0.52), (0.03, 0.03, 0.03), 20.0),
    "porcelain": ((0.75, 0.76, 0.78), (0.05, 0.05, 0.05), 300.0),
    "jade": ((0.30, 0.52, 0.40), (0.05, 0.05, 0.05), 120.0),
    "bronze": ((0.10, 0.06, 0.03), (0.55, 0.38, 0.20), 40.0),
    "silver": ((0.05, 0.05, 0.05), (0.85, 0.84, 0.82), 60.0),
}


def named_material(name: str) -> Material:
    """One of the presets: plaster (matte white), clay, stone, porcelain, jade, bronze, silver.

    Errors: ValueError for another name.

    >>> material = se.named_material("stone")
    """
    check_choice("name", name, tuple(PRESETS))
    diffuse, specular, shininess = PRESETS[name]
    return Material(jnp.asarray(diffuse), None if specular is None else jnp.asarray(specular), jnp.asarray(shininess))
