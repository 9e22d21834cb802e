"""`shapeenh lines`: feature lines of a mesh in a named style."""

from __future__ import annotations

import argparse

import jax.numpy as jnp
import numpy as np

from shapeenh import io
from shapeenh.buffers.gbuffer import render_gbuffer
from shapeenh.cli import values
from shapeenh.descriptor.view import describe
from shapeenh.light.radiance import shade
from shapeenh.lines.brush import composite_lines, draw_lines
from shapeenh.lines.fields import KINDS, line_field
from shapeenh.lines.noise import surface_noise
from shapeenh.lines.profile import fit_profile
from shapeenh.lines.styles import STYLES, style_brush, style_footprint
from shapeenh.numerics import luminance
from shapeenh.scene import environment, shapes
from shapeenh.scene.camera import frame_mesh
from shapeenh.scene.materials import named_material
from shapeenh.style import tone

PAPER = (0.93, 0.91, 0.86)
OVER = ("paper", "shading", "transparent")


def add_parser(commands) -> None:
    """`shapeenh lines` and its options."""
    add = commands.add_parser("lines", help="feature lines of a mesh in a style", description=run.__doc__)
    add.set_defaults(run=run)
    add.add_argument("mesh", nargs="?", metavar="MESH", help="OBJ, PLY, STL, OFF or GLB; default: the carved knot")
    add.add_argument("-o", "--output", required=True, metavar="OUT", help="picture to write; .png keeps transparency")
    add.add_argument(
        "--kinds", type=_kinds, default=("valley", "ridge", "occlusion"), metavar="K,K", help=f"of {', '.join(KINDS)}"
    )
    add.add_argument("--style", default="ink", choices=STYLES, help="(default: ink)")
    add.add_argument("--over", default="paper", choices=OVER, help="what the lines are drawn on (default: paper)")
    add.add_argument(
        "--sigma", type=values.number, default=2.0, help="scale of the features, px at 600 px height (default: 2)"
    )
    add.add_argument("--size", type=values.size, default=(800, 600), metavar="WxH", help="size (default: 800x600)")
    add.add_argument("--view", type=values.view, default=(20.0, 15.0), metavar="AZ,EL", help="degrees (default: 20,15)")
    add.add_argument("--fov", type=values.number, default=30.0, help="vertical field of view, degrees (default: 30)")


def run(arguments) -> None:
    """Draw occlusions, ridges, valleys and other feature lines of a mesh with implicit brushes."""
    values.check_between("--sigma", arguments.sigma, 0, 10)
    values.check_between("--fov", arguments.fov, 0.1, 170)
    io.check_picture_path(arguments.output)
    width, height = arguments.size
    mesh = shapes.carved_knot() if arguments.mesh is None else io.load_mesh(arguments.mesh)
    azimuth, elevation = np.deg2rad(arguments.view)
    direction = (
        float(np.sin(azimuth) * np.cos(elevation)),
        float(np.sin(elevation)),
        float(np.cos(azimuth) * np.cos(elevation)),
    )
    camera = frame_mesh(mesh, direction=direction, fov_degrees=arguments.fov, aspect=width / height)
    strokes, gbuffer, picture = lines_of(
        mesh, camera, kinds=arguments.kinds, style=arguments.style, sigma=arguments.sigma, height=height, width=width
    )
    paper = jnp.broadcast_to(jnp.asarray(PAPER), (height, width, 3))
    if arguments.over == "transparent":
        alpha = strokes[..., 3:]
        image = jnp.concatenate([strokes[..., :3] / jnp.maximum(alpha, 1e-6), alpha], axis=-1)
    elif arguments.over == "shading":
        image = composite_lines(tone.composite(picture, gbuffer.mask, PAPER), strokes)
    else:
        image = composite_lines(paper, strokes)
    io.save_image(arguments.output, np.asarray(image))


def lines_of(mesh, camera, *, kinds, style: str, sigma: float, height: int, width: int):
    """(strokes [H, W, 4], G-buffer, shaded picture [H, W, 3]); the kinds over one another in the given order."""
    scale = height / 600
    gbuffer = render_gbuffer(mesh, camera, height=height, width=width)
    descriptor = describe(gbuffer, sigma=sigma * scale)
    lights = environment.rotate_lights(environment.sample_environment(environment.procedural_studio(), 32), camera)
    radiance = shade(gbuffer, lights, named_material("stone"))
    picture = tone.tone_map(radiance, exposure=tone.auto_exposure(radiance, gbuffer.mask))
    noise = surface_noise(gbuffer, camera, size=max(4.0 * scale, 1.0))
    strokes = jnp.zeros((height, width, 4), picture.dtype)
    for kind in kinds:
        image = luminance(picture) if kind == "luminance" else None
        field = line_field(kind, gbuffer, descriptor, luminance=image, sigma=1.0)
        brush = style_brush(style, kind, height=height)
        radius = 3.0 if kind == "occlusion" else 4.0
        profile = fit_profile(field, radius=radius, least=float(brush.low))
        layer = draw_lines(profile, field, brush, footprint=style_footprint(style), shading=picture, noise=noise)
        strokes = layer + (1 - layer[..., 3:]) * strokes
    return strokes, gbuffer, picture


def _kinds(text: str) -> tuple[str, ...]:
    kinds = tuple(t for t in text.split(",") if t)
    if not kinds or any(k not in KINDS for k in kinds):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of {', '.join(KINDS)}")
    return kinds
