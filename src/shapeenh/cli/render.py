"""`shapeenh render`: a picture before and after light warping."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh import io, pipeline
from shapeenh.buffers.borrow import resolve_coverage
from shapeenh.cli import scene, values
from shapeenh.cli.terminal import Stopwatch
from shapeenh.descriptor.display import curvature_colors, curvature_legend
from shapeenh.descriptor.view import describe, mean_curvature
from shapeenh.style import tone
from shapeenh.types import LightWarp


def add_parser(commands) -> None:
    """`shapeenh render` and its options."""
    parser = commands.add_parser("render", help="picture before and after light warping", description=run.__doc__)
    parser.set_defaults(run=run)
    scene.add_arguments(parser)
    add = parser.add_argument
    add("-o", "--output", required=True, metavar="OUT", help="picture to write (.png, .jpg, .exr, .hdr, .tif)")
    add("--only", action="store_true", help="the enhanced picture alone, without the original beside it")
    add("--alpha", type=values.number, default=30.0, help="strength of the warp, px at 600 px height (default: 30)")
    add("--gamma", type=values.number, default=0.0, help="contrast exponent, -1 to 1 (default: 0)")
    add("--sigma", type=values.number, default=2.0, help="scale of the features, px at 600 px height (default: 2)")
    add(
        "--background", type=values.color, default="grey", metavar="NAME|#RRGGBB", help="white, black, grey or a colour"
    )
    add("--buffers", metavar="DIR", help="also write normal, depth and curvature: pictures and float TIFF")
    add("--json", nargs="?", const="-", metavar="FILE", help="timings and parameters as JSON (default: stdout)")


def run(arguments) -> None:
    """Render an object and light-warp it: the original beside the enhanced picture."""
    _check(arguments)
    clock = Stopwatch(repeat=arguments.json is not None)
    loaded = scene.load(arguments, clock)
    lights, material, samples = loaded.lights, loaded.material, loaded.samples
    warp = LightWarp(alpha=arguments.alpha, gamma=arguments.gamma)

    gbuffer = clock.stage("G-buffer", lambda: loaded.gbuffer(samples))
    descriptor = clock.stage("descriptor", lambda: described(gbuffer, arguments))
    plain = clock.stage("shade", lambda: pipeline.illuminate(gbuffer, descriptor, lights, material, None))
    warped = clock.stage("shade warped", lambda: pipeline.illuminate(gbuffer, descriptor, lights, material, warp))

    exposure = tone.auto_exposure(plain, gbuffer.mask)
    coverage = loaded.coverage and clock.stage("coverage", lambda: loaded.coverage(gbuffer))
    pictures = [warped] if arguments.only else [plain, warped]
    shown = side_by_side(pictures, exposure, gbuffer.mask, arguments, samples, coverage=coverage)
    clock.once("save", lambda: io.save_image(arguments.output, shown))
    if arguments.buffers is not None:
        if samples > 1:  # the numbers are those of pixel centres, not averages
            gbuffer = loaded.gbuffer(1)
            descriptor = described(gbuffer, arguments)
        clock.once("save buffers", lambda: _save_buffers(Path(arguments.buffers), gbuffer, descriptor))
    if arguments.json is not None:
        _write_json(arguments, clock, loaded, gbuffer, exposure)


def _check(arguments) -> None:
    values.check_between("--alpha", arguments.alpha, -1e6, 1e6)
    values.check_between("--gamma", arguments.gamma, -1, 1)
    values.check_between("--sigma", arguments.sigma, 0, 10)
    io.check_picture_path(arguments.output)
    if arguments.buffers is not None:
        values.check_folder(Path(arguments.buffers), "--buffers folder")
    if arguments.json not in (None, "-"):
        values.check_folder(Path(arguments.json).parent, "--json folder")


def described(gbuffer, arguments):
    """The descriptor at the scale that the user set for 600 px; sharp edges of the mesh insulate it."""
    scale = gbuffer.mask.shape[0] / pipeline.REFERENCE_HEIGHT
    return describe(gbuffer, sigma=min(arguments.sigma * scale, 100.0), creases=arguments.crease)


def side_by_side(pictures, exposure, mask, arguments, samples: int, *, coverage=None) -> np.ndarray:
    """One image for a display. All are exposed alike; samples are averaged after the tone curve, as they are seen."""
    mapped = [tone.tone_map(picture, exposure=exposure) for picture in pictures]
    if coverage is None:
        panels = [_average(tone.composite(picture, mask, arguments.background), samples) for picture in mapped]
    else:
        behind = (1 - coverage.fraction)[..., None] * jnp.asarray(arguments.background)[None, None]
        panels = [np.asarray(resolve_coverage(picture, coverage) + behind) for picture in mapped]
    return np.concatenate(panels, axis=1)


def _average(image, samples: int) -> np.ndarray:
    """Box filter over the samples of a pixel."""
    image = np.asarray(image)
    height, width, channels = image.shape
    return image.reshape(height // samples, samples, width // samples, samples, channels).mean(axis=(1, 3))


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
    if mask.shape[0] >= 64:
        io.save_image(folder / "curvature-legend.png", _eight_bit(curvature_legend(mask.shape[0])))
    for name, numbers in (("normal", normal), ("depth", depth), ("curvature", curvature)):
        io.save_image(folder / f"{name}.tif", np.float32(numbers))


def _eight_bit(display) -> np.ndarray:
    return np.round(255 * np.clip(np.asarray(display), 0, 1)).astype(np.uint8)


def _write_json(arguments, clock, loaded, gbuffer, exposure) -> None:
    record = {
        "parameters": {k: v for k, v in vars(arguments).items() if k not in ("run", "json")},
        "exposure": float(exposure),
        "size": loaded.size,
        **loaded.facts,
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
