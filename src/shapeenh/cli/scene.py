"""What a picture is made from: options and loading of the input, the light and the material."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from shapeenh import io
from shapeenh.buffers.coverage import sample_coverage
from shapeenh.buffers.gbuffer import render_gbuffer
from shapeenh.buffers.points import gbuffer_from_points
from shapeenh.buffers.sources import gbuffer_from_height, gbuffer_from_normals
from shapeenh.cli import values
from shapeenh.cli.values import UsageError
from shapeenh.scene import environment, shapes
from shapeenh.scene.camera import frame_mesh
from shapeenh.types import Camera, Coverage, GBuffer, Lights, Material, Mesh

KINDS = ("mesh", "points", "height", "normals")
DEFAULT_SIZE = (800, 600)


@dataclasses.dataclass(frozen=True)
class Scene:
    """A loaded input: `gbuffer(samples)` makes its G-buffer with that many samples per pixel and axis.

    Pictures of point clouds are supersampled: `samples` says by how much. Those of meshes are shaded once per pixel,
    and `coverage` of their G-buffer smooths the outlines; it is None where that is not wanted. `camera` is None for
    images, which are seen straight on.
    """

    gbuffer: Callable[[int], GBuffer]
    lights: Lights
    material: Material
    size: tuple[int, int]
    samples: int
    coverage: Callable[[GBuffer], Coverage] | None
    facts: dict
    camera: Camera | None = None


def add_arguments(parser) -> None:
    """The input and how it is seen and lit."""
    add = parser.add_argument
    add(
        "input", nargs="?", metavar="MESH", help="mesh, point cloud, height field or normal map; default: a carved knot"
    )
    add(
        "--as",
        dest="kind",
        choices=KINDS,
        help="what the input is (default: mesh or points, by the file; images need 'height' or 'normals')",
    )
    add("--env", default="studio", metavar="MAP", help=".exr, .hdr or image; or 'studio', 'sky' (default: studio)")
    add("--lights", type=int, default=54, metavar="N", help="directions sampled from the map (default: 54)")
    add("--material", type=values.material, default="stone", metavar="NAME|D,S,ETA", help=values.material_help())
    add("--size", type=values.size, metavar="WxH", help="size of a picture (default: 800x600, or that of the image)")
    add("--view", type=values.view, default=(20.0, 15.0), metavar="AZ,EL", help="degrees right and up (default: 20,15)")
    add("--fov", type=values.number, default=30.0, help="vertical field of view, degrees (default: 30)")
    add("--crease", type=values.number, default=70.0, metavar="DEG", help="sharper edges stay sharp (default: 70)")
    add("--samples", type=int, default=2, help="per pixel and axis, for smooth outlines: 1 to 4 (default: 2)")
    add("--spacing", type=values.number, help="of a height field: world units per pixel (default: the file's, or 1)")
    add("--z-factor", type=values.number, default=1.0, help="of a height field: exaggeration (default: 1)")
    add("--nodata", type=float, help="of a height field: what means 'no data', besides NaN (default: the file's)")
    add(
        "--green",
        choices=("up", "down"),
        default="up",
        help="of a normal map: up = OpenGL, down = DirectX (default: up)",
    )


def load(arguments, clock) -> Scene:
    """Check the options, read the files, aim the camera, sample the light."""
    values.check_between("--lights", arguments.lights, 1, 65536)
    values.check_between("--fov", arguments.fov, 0.1, 170)
    values.check_between("--crease", arguments.crease, 1, 179)
    values.check_between("--samples", arguments.samples, 1, 4)
    kind = _kind(arguments)
    if kind in ("height", "normals"):
        gbuffer = clock.once(f"load {kind}", lambda: _from_image(arguments, kind))
        height, width = gbuffer.mask.shape
        lights, material = _lights(arguments, clock), _material(arguments)
        return Scene(lambda samples: gbuffer, lights, material, (width, height), 1, None, {})

    width, height = arguments.size or DEFAULT_SIZE
    if max(width, height) * arguments.samples > values.LARGEST_SIDE:
        raise UsageError(
            f"--size times --samples exceeds {values.LARGEST_SIDE}; accepted is a smaller size or --samples 1"
        )
    samples, coverage = arguments.samples, None
    look = {"direction": _direction(*arguments.view), "fov_degrees": arguments.fov, "aspect": width / height}
    if kind == "points":
        points, normals, colors = clock.once("load points", lambda: io.load_points(arguments.input))
        index = np.arange(len(points), dtype=np.int32)
        camera = frame_mesh(Mesh(points, jnp.asarray(np.stack([index] * 3, axis=-1)), jnp.zeros_like(points)), **look)
        facts = {"points": len(points)}

        def draw(samples):
            fine = {"height": height * samples, "width": width * samples}
            return gbuffer_from_points(points, normals, None, camera, colors=colors, **fine)
    else:
        mesh = clock.once("load mesh", lambda: _mesh(arguments))
        camera = frame_mesh(mesh, **look)
        facts = {"vertices": int(mesh.vertices.shape[0]), "triangles": int(mesh.faces.shape[0])}

        def draw(samples):
            return render_gbuffer(mesh, camera, height=height * samples, width=width * samples)

        if samples > 1:
            samples, coverage = 1, partial(sample_coverage, mesh, camera, samples=samples)

    lights = environment.rotate_lights(_lights(arguments, clock), camera)
    return Scene(draw, lights, _material(arguments), (width, height), samples, coverage, facts, camera)


def _kind(arguments) -> str:
    """What the input is: as told, else by its suffix."""
    if arguments.kind is not None and arguments.input is None:
        raise UsageError(f"--as {arguments.kind} needs an input file")
    by_name = "points" if arguments.input and io.holds_points(arguments.input) else "mesh"
    kind = arguments.kind or by_name
    suffix = Path(arguments.input).suffix.lower() if arguments.input else ""
    if arguments.kind is None and suffix in io.PICTURE_SUFFIXES:
        raise UsageError(f"{arguments.input} is an image; accepted with --as height or --as normals")
    if kind in ("height", "normals") and arguments.size is not None:
        raise UsageError("--size is for meshes and points; an image keeps its own size")
    return kind


def _from_image(arguments, kind: str) -> GBuffer:
    if kind == "normals":
        image = io.load_image(arguments.input)
        if image.ndim != 3:
            raise UsageError(f"{arguments.input} has one channel; accepted are normal maps of three")
        return gbuffer_from_normals(image, green=arguments.green)
    heights, spacing, nodata = io.load_height(arguments.input)
    return gbuffer_from_height(
        heights,
        spacing=arguments.spacing or spacing or 1.0,
        z_factor=arguments.z_factor,
        nodata=nodata if arguments.nodata is None else arguments.nodata,
    )


def _mesh(arguments) -> Mesh:
    if arguments.input is None:
        return shapes.carved_knot()
    return io.load_mesh(arguments.input, crease_degrees=arguments.crease)


def _lights(arguments, clock) -> Lights:
    def radiance_map():
        if arguments.env in ("studio", "sky"):
            return environment.procedural_studio() if arguments.env == "studio" else environment.procedural_sky()
        return io.load_environment(arguments.env)

    radiance = clock.once("load environment", radiance_map)
    return clock.once("sample environment", lambda: environment.sample_environment(radiance, arguments.lights))


def _material(arguments) -> Material:
    return Material(**{k: v and jnp.asarray(v, jnp.float32) for k, v in arguments.material.items()})


def _direction(azimuth: float, elevation: float) -> tuple[float, float, float]:
    """From the object to the camera, for an azimuth to the right of +z and an elevation above the horizon."""
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    return float(np.sin(a) * np.cos(e)), float(np.sin(e)), float(np.cos(a) * np.cos(e))
