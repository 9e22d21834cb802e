"""Ink, pencil, charcoal and calligraphy side by side: `python examples/lines.py [MESH] [-o lines.png]`."""

from __future__ import annotations

import argparse

import jax.numpy as jnp
import numpy as np

import shapeenh as se

STYLES = ("ink", "pencil", "charcoal", "calligraphy")
PAPER = (0.93, 0.91, 0.86)


def draw(mesh, style: str, *, size: int = 480):
    """Valleys, ridges and outlines of a mesh in one style, on paper."""
    camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=1.0)
    gbuffer = se.render_gbuffer(mesh, camera, height=size, width=size)
    descriptor = se.describe(gbuffer, sigma=2.0 * size / 600)
    noise = se.surface_noise(gbuffer, camera, size=4.0)
    picture = jnp.broadcast_to(jnp.asarray(PAPER), (size, size, 3))
    for kind in ("valley", "ridge", "occlusion"):
        brush = se.style_brush(style, kind, height=size)
        field = se.line_field(kind, gbuffer, descriptor)
        profile = se.fit_profile(field, radius=se.fit_radius(kind), least=float(brush.low))
        ends = {} if kind == "occlusion" else {"gbuffer": gbuffer, "descriptor": descriptor}
        strokes = se.draw_lines(profile, field, brush, footprint=se.style_footprint(style), noise=noise, **ends)
        picture = se.composite_lines(picture, strokes)
    return picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("-o", "--output", default="lines.png")
    arguments = parser.parse_args()
    mesh = se.load_mesh(arguments.mesh) if arguments.mesh else se.carved_knot()
    se.save_image(arguments.output, np.concatenate([draw(mesh, style) for style in STYLES], axis=1))


if __name__ == "__main__":
    main()
