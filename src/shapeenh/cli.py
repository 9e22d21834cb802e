"""The command line: `shapeenh render MESH -o out.png`."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh import io, pipeline
from shapeenh.buffers.gbuffer import render_gbuffer
from shapeenh.descriptor.display import curvature_colors
from shapeenh.descriptor.view import describe, mean_curvature
from shapeenh.scene import environment, materials, shapes
from shapeenh.scene.camera import frame_mesh
from shapeenh.style import tone
from shapeenh.types import LightWarp, Material

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "grey": (0.78, 0.78, 0.78)}
LARGEST_SIDE = 8192


class UsageError(Exception):
    """Wrong input: ends the program with one plain line and exit code 2."""


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        raise UsageError(message)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code: 0, or 2 for wrong input."""
    parser = _build_parser()
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = _show_warning
        try:
            arguments = parser.parse_args(argv)
            _use_compilation_cache()
            arguments.run(arguments)
        except (UsageError, ValueError, OSError) as error:
            print(f"shapeenh: error: {_one_line(error)}", file=sys.stderr)
            return 2
        except MemoryError:
            print("shapeenh: error: not enough memory; try a smaller --size", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            return 130
    return 0


# ------------------------------------------------------------------------------------------- arguments


def _build_parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="shapeenh", description="Makes the shape of things visible.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    add = commands.add_parser(
        "render", help="picture of a mesh before and after light warping", description=cmd_render.__doc__
    )
    add.set_defaults(run=cmd_render)
    add.add_argument(
        "mesh", nargs="?", metavar="MESH", help="OBJ, PLY, STL, OFF or GLB; default: the embedded carved knot"
    )
    add.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="picture to write (.png, .jpg, .exr, .hdr, .tif)"
    )
    add.add_argument(
        "--env", default="studio", metavar="MAP", help=".exr, .hdr or image; or 'studio', 'sky' (default: studio)"
    )
    add.add_argument("--only", action="store_true", help="the enhanced picture alone, without the original beside it")
    add.add_argument(
        "--alpha", type=_number, default=30.0, help="strength of the warp, px at 600 px height (default: 30)"
    )
    add.add_argument("--gamma", type=_number, default=0.0, help="contrast exponent, -1 to 1 (default: 0)")
    add.add_argument(
        "--sigma", type=_number, default=2.0, help="scale of the features, px at 600 px height (default: 2)"
    )
    add.add_argument(
        "--size", type=_size, default=(800, 600), metavar="WxH", help="size of a picture (default: 800x600)"
    )
    add.add_argument(
        "--view", type=_view, default=(20.0, 15.0), metavar="AZ,EL", help="degrees right and up (default: 20,15)"
    )
    add.add_argument("--fov", type=_number, default=30.0, help="vertical field of view, degrees (default: 30)")
    add.add_argument(
        "--lights", type=int, default=54, metavar="N", help="directions sampled from the map (default: 54)"
    )
    add.add_argument("--material", type=_material, default="stone", metavar="NAME|D,S,ETA", help=_material_help())
    add.add_argument(
        "--background", type=_color, default="grey", metavar="NAME|#RRGGBB", help="white, black, grey or a colour"
    )
    add.add_argument(
        "--crease", type=_number, default=70.0, metavar="DEG", help="sharper edges stay sharp (default: 70)"
    )
    add.add_argument(
        "--samples", type=int, default=2, help="per pixel and axis, for smooth outlines: 1 to 4 (default: 2)"
    )
    add.add_argument("--buffers", metavar="DIR", help="also write normal, depth and curvature: pictures and float TIFF")
    add.add_argument(
        "--json", nargs="?", const="-", metavar="FILE", help="timings and parameters as JSON (default: stdout)"
    )
    return parser


def _number(text: str) -> float:
    value = float(text)
    if not np.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(t) for t in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 800x600") from None
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise argparse.ArgumentTypeError(f"{text} is outside 1x1 to {LARGEST_SIDE}x{LARGEST_SIDE}")
    return width, height


def _view(text: str) -> tuple[float, float]:
    try:
        azimuth, elevation = (_number(t) for t in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not AZIMUTH,ELEVATION in degrees, such as 20,15") from None
    if not -89 <= elevation <= 89:
        raise argparse.ArgumentTypeError(f"elevation {elevation:g} is outside -89 to 89 degrees")
    return azimuth, elevation


def _material(text: str) -> dict:
    if text in materials.PRESETS:
        diffuse, specular, shininess = materials.PRESETS[text]
        return {"diffuse": diffuse, "specular": specular, "shininess": shininess}
    try:
        diffuse, specular, shininess = (_number(t) for t in text.split(","))
    except ValueError:
        names = ", ".join(materials.PRESETS)
        raise argparse.ArgumentTypeError(f"{text!r} is neither one of {names} nor DIFFUSE,SPECULAR,SHININESS") from None
    if not (0 <= diffuse <= 1 and 0 <= specular <= 1 and shininess >= 0):
        raise argparse.ArgumentTypeError(f"{text}: diffuse and specular lie in 0 to 1, shininess is >= 0")
    return {"diffuse": (diffuse,) * 3, "specular": (specular,) * 3, "shininess": shininess}


def _material_help() -> str:
    return f"{', '.join(materials.PRESETS)}, or three numbers (default: stone)"


def _color(text: str) -> tuple[float, float, float]:
    if text in BACKGROUNDS:
        return BACKGROUNDS[text]
    digits = text.removeprefix("#")
    try:
        if len(digits) != 6:
            raise ValueError
        r, g, b = (int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither white, black, grey nor #RRGGBB") from None
    return r, g, b


# ------------------------------------------------------------------------------------------- render


def cmd_render(arguments) -> None:
    """Render a mesh and light-warp it: the original beside the enhanced picture."""
    _check_ranges(arguments)
    io.check_picture_path(arguments.output)
    if arguments.buffers is not None:
        _check_folder(Path(arguments.buffers), "--buffers folder")
    if arguments.json not in (None, "-"):
        _check_folder(Path(arguments.json).parent, "--json folder")
    clock = Stopwatch(repeat=arguments.json is not None)
    width, height = arguments.size
    mesh = clock.once("load mesh", lambda: _mesh(arguments))
    radiance_map = clock.once("load environment", lambda: _environment(arguments.env))
    lights = clock.once("sample environment", lambda: environment.sample_environment(radiance_map, arguments.lights))
    camera = frame_mesh(mesh, direction=_direction(*arguments.view), fov_degrees=arguments.fov, aspect=width / height)
    lights = environment.rotate_lights(lights, camera)
    material = Material(**{k: jnp.asarray(v, jnp.float32) for k, v in arguments.material.items()})
    warp = LightWarp(alpha=arguments.alpha, gamma=arguments.gamma)

    fine = {"height": height * arguments.samples, "width": width * arguments.samples}
    gbuffer = clock.stage("G-buffer", lambda: render_gbuffer(mesh, camera, **fine))
    descriptor = clock.stage("descriptor", lambda: _describe(gbuffer, arguments))
    plain = clock.stage("shade", lambda: pipeline.illuminate(gbuffer, descriptor, lights, material, None))
    warped = clock.stage("shade warped", lambda: pipeline.illuminate(gbuffer, descriptor, lights, material, warp))

    # Both are exposed alike; the samples of a pixel are averaged after the tone curve, as a display shows them.
    exposure = tone.auto_exposure(plain, gbuffer.mask)
    panels = [
        _average(
            tone.composite(tone.tone_map(p, exposure=exposure), gbuffer.mask, arguments.background), arguments.samples
        )
        for p in ([warped] if arguments.only else [plain, warped])
    ]
    clock.once("save", lambda: io.save_image(arguments.output, np.concatenate(panels, axis=1)))
    if arguments.buffers is not None:
        if arguments.samples > 1:  # the numbers are those of pixel centres, not averages
            gbuffer = render_gbuffer(mesh, camera, height=height, width=width)
            descriptor = _describe(gbuffer, arguments)
        clock.once("save buffers", lambda: _save_buffers(Path(arguments.buffers), gbuffer, descriptor))
    if arguments.json is not None:
        _write_json(arguments, clock, mesh, gbuffer, exposure)


def _describe(gbuffer, arguments):
    """The descriptor at the scale that the user set for 600 px; sharp edges of the mesh insulate it."""
    scale = gbuffer.mask.shape[0] / pipeline.REFERENCE_HEIGHT
    return describe(gbuffer, sigma=arguments.sigma * scale, creases=arguments.crease)


def _average(image, samples: int) -> np.ndarray:
    """Box filter over the samples of a pixel."""
    image = np.asarray(image)
    height, width, channels = image.shape
    return image.reshape(height // samples, samples, width // samples, samples, channels).mean(axis=(1, 3))


def _check_ranges(arguments) -> None:
    for name, low, high in (("gamma", -1, 1), ("sigma", 0, 10), ("alpha", -1e6, 1e6), ("lights", 1, 65536)):
        value = getattr(arguments, name)
        if not low <= value <= high:
            raise UsageError(f"--{name} is {value:g}; accepted are numbers from {low:g} to {high:g}")
    if not 1 <= arguments.samples <= 4:
        raise UsageError(f"--samples is {arguments.samples}; accepted are 1 to 4")
    if max(arguments.size) * arguments.samples > LARGEST_SIDE:
        raise UsageError(f"--size times --samples exceeds {LARGEST_SIDE}; accepted is a smaller size or --samples 1")
    if not 0 < arguments.crease < 180:
        raise UsageError(f"--crease is {arguments.crease:g}; accepted are degrees between 0 and 180")
    if not 0.1 <= arguments.fov <= 170:
        raise UsageError(f"--fov is {arguments.fov:g}; accepted are 0.1 to 170 degrees")


def _check_folder(folder: Path, what: str) -> None:
    if not folder.is_dir():
        raise UsageError(f"the {what} {folder} does not exist")


def _mesh(arguments):
    if arguments.mesh is None:
        return shapes.carved_knot()
    return io.load_mesh(arguments.mesh, crease_degrees=arguments.crease)


def _environment(name: str):
    if name in ("studio", "sky"):
        return environment.procedural_studio() if name == "studio" else environment.procedural_sky()
    return io.load_environment(name)


def _direction(azimuth: float, elevation: float) -> tuple[float, float, float]:
    """From the object to the camera, for an azimuth to the right of +z and an elevation above the horizon."""
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    return float(np.sin(a) * np.cos(e)), float(np.sin(e)), float(np.cos(a) * np.cos(e))


def _save_buffers(folder: Path, gbuffer, descriptor) -> None:
    mask = np.asarray(gbuffer.mask)
    depth = np.asarray(gbuffer.depth)
    curvature = np.asarray(mean_curvature(descriptor.hessian))
    near, far = (depth[mask].min(), depth[mask].max()) if mask.any() else (0.0, 1.0)
    shown = np.where(mask, 1 - 0.9 * (depth - near) / max(far - near, 1e-30), 0)
    normal = np.asarray(gbuffer.normal)
    io.save_image(folder / "normal.png", _eight_bit(np.where(mask[..., None], 0.5 + 0.5 * normal, 0)))
    io.save_image(folder / "depth.png", _eight_bit(shown))
    io.save_image(folder / "curvature.png", _eight_bit(curvature_colors(descriptor, mask=gbuffer.mask)))
    for name, numbers in (("normal", normal), ("depth", depth), ("curvature", curvature)):
        io.save_image(folder / f"{name}.tif", np.float32(numbers))


def _eight_bit(display) -> np.ndarray:
    return np.uint8(np.round(255 * np.clip(np.asarray(display), 0, 1)))


def _write_json(arguments, clock, mesh, gbuffer, exposure) -> None:
    record = {
        "parameters": {k: v for k, v in vars(arguments).items() if k not in ("run", "json")},
        "exposure": float(exposure),
        "vertices": int(mesh.vertices.shape[0]),
        "triangles": int(mesh.faces.shape[0]),
        "covered_pixels": int(jnp.sum(gbuffer.mask)),
        "seconds": clock.seconds,
        "versions": {"jax": jax.__version__, "numpy": np.__version__},
        "device": str(jax.devices()[0]),
    }
    text = json.dumps(record, indent=2)
    if arguments.json == "-":
        print(text)
    else:
        Path(arguments.json).write_text(text + "\n")


# ------------------------------------------------------------------------------------------- the user's terminal


class Stopwatch:
    """Times the stages and says what goes on, on stderr when that is a terminal.

    With `repeat`, a compiled stage is run twice, so that its compile time stands apart from its run time.
    """

    def __init__(self, *, repeat: bool):
        self.repeat = repeat
        self.seconds: dict[str, float | dict[str, float]] = {}

    def once(self, name: str, work):
        result, self.seconds[name] = self._timed(name, work)
        return result

    def stage(self, name: str, work):
        result, first = self._timed(name, work)
        if self.repeat:
            result, run = self._timed(name, work)
            self.seconds[name] = {"compile": round(max(first - run, 0.0), 6), "run": run}
        else:
            self.seconds[name] = first
        return result

    @staticmethod
    def _timed(name: str, work):
        if sys.stderr.isatty():
            print(f"shapeenh: {name} ...", file=sys.stderr)
        start = time.perf_counter()
        result = jax.block_until_ready(work())
        return result, round(time.perf_counter() - start, 6)


def _use_compilation_cache() -> None:
    """Keep compiled code between runs, unless JAX is told otherwise by its own environment variable."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "shapeenh"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"shapeenh: warning: {_one_line(message)}", file=sys.stderr)


def _one_line(error) -> str:
    text = str(error) or type(error).__name__
    return " ".join(text.split())


if __name__ == "__main__":
    sys.exit(main())
