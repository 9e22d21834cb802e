"""`shapeenh lines`: feature lines of an object, or of the frames of a moving picture, in a named style."""

from __future__ import annotations

import argparse
from functools import lru_cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from shapeenh import codecs, io, pipeline
from shapeenh.cli import frames, render, scene, values
from shapeenh.cli.terminal import Stopwatch
from shapeenh.cli.values import UsageError
from shapeenh.light.radiance import shade
from shapeenh.lines.brush import NOISY, composite_lines, draw_lines
from shapeenh.lines.fields import KINDS, fit_radius, line_field, make_line_field
from shapeenh.lines.noise import surface_noise
from shapeenh.lines.profile import fit_profile
from shapeenh.lines.styles import STYLES, style_brush, style_footprint
from shapeenh.numerics import luminance
from shapeenh.scene.camera import orthographic_camera
from shapeenh.style import tone
from shapeenh.types import GBuffer, replace

PAPER = (0.93, 0.91, 0.86)
OVER = ("paper", "shading", "transparent")
OBJECT_KINDS = ("valley", "ridge", "occlusion")


def add_parser(commands) -> None:
    """`shapeenh lines` and its options."""
    parser = commands.add_parser("lines", help="feature lines of an object or a video", description=run.__doc__)
    parser.set_defaults(run=run, background=PAPER)
    scene.add_arguments(parser)
    add = parser.add_argument
    add("more", nargs="*", metavar="FRAMES", help="images, a folder, a pattern, GIF or video: with --kinds luminance")
    add("-o", "--output", required=True, metavar="OUT", help="picture; of several frames, a folder, .gif or video")
    add("--kinds", type=_kinds, metavar="K,K", help=f"of {', '.join(KINDS)} (default: {','.join(OBJECT_KINDS)})")
    add("--style", default="ink", choices=STYLES, help="(default: ink)")
    add("--over", default="paper", choices=OVER, help="what lines are drawn on; shading: or the frame (default: paper)")
    add("--color", type=values.color, metavar="NAME|#RRGGBB", help="white, black, grey or a colour, for all lines")
    add("--sigma", type=values.number, default=2.0, help="scale of the features, px at 600 px height (default: 2)")
    add("--detail", type=values.number, default=1.0, help="2 shows lines half as strong, 0.5 fewer (default: 1)")
    add("--fps", type=values.number, help="frames per second of a GIF or video (default: the input's, or 12)")
    add("--overwrite", action="store_true", help="replace frames that were drawn with other options")


def run(arguments) -> None:
    """Draw feature lines with implicit brushes: those of an object, or the luminance edges of a moving picture.

    A sequence that was interrupted goes on where it stopped when the same command is given again.
    """
    values.check_between("--sigma", arguments.sigma, 0, 10)
    values.check_between("--detail", arguments.detail, 0.01, 100)
    if arguments.fps is not None:
        values.check_between("--fps", arguments.fps, 0.1, 240)
    inputs = [*([arguments.input] if arguments.input else []), *arguments.more]
    if arguments.kind is None and frames.is_frames(inputs):
        return _run_frames(arguments, inputs)
    if len(inputs) > 1:
        raise UsageError(f"--as {arguments.kind} takes one input, and {len(inputs)} were given")
    return _run_object(arguments)


def _kinds(text: str) -> tuple[str, ...]:
    kinds = tuple(t for t in text.split(",") if t)
    if not kinds or any(k not in KINDS for k in kinds):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of {', '.join(KINDS)}")
    return kinds


def _brush(arguments, kind: str, height: int):
    """The style's brush in the colour and with the threshold asked for."""
    brush = style_brush(arguments.style, kind, height=height)
    brush = replace(brush, low=brush.low / arguments.detail, high=brush.high / arguments.detail)
    if arguments.color is None:
        return brush
    return replace(brush, color=tuple(float(c) for c in codecs.srgb_decode(np.asarray(arguments.color))), shade=0.0)


def _wants(arguments, *fields: str) -> bool:
    """Whether any brush that may be used has one of these fields, so that what nobody needs is not computed."""
    brushes = [_brush(arguments, kind, pipeline.REFERENCE_HEIGHT) for kind in KINDS]
    return any(getattr(brush, field) > 0 for brush in brushes for field in fields)


def _over(strokes, below):
    """Strokes over a picture [H, W, 3], or as a picture with alpha over nothing."""
    if below is not None:
        return np.asarray(composite_lines(below, strokes))
    alpha = strokes[..., 3:]
    return np.asarray(jnp.concatenate([strokes[..., :3] / jnp.maximum(alpha, 1e-6), alpha], axis=-1))


# ------------------------------------------------------------------------------------------- an object


def _run_object(arguments) -> None:
    io.check_picture_path(arguments.output)
    clock = Stopwatch(repeat=False)
    loaded = scene.load(arguments, clock)
    gbuffer = clock.stage("G-buffer", lambda: loaded.gbuffer(1))
    descriptor = clock.stage("descriptor", lambda: render.described(gbuffer, arguments))
    kinds = arguments.kinds or OBJECT_KINDS
    picture, exposure, radiance = None, None, None
    if arguments.over == "shading" or "luminance" in kinds or _wants(arguments, "shade"):
        radiance = clock.stage("shade", lambda: shade(gbuffer, loaded.lights, loaded.material))
        exposure = tone.auto_exposure(radiance, gbuffer.mask)
        picture = tone.tone_map(radiance, exposure=exposure)
    camera = image_camera(gbuffer) if loaded.camera is None else loaded.camera
    strokes = clock.stage("lines", lambda: object_lines(gbuffer, descriptor, picture, camera, arguments, kinds))
    below = None
    if arguments.over == "paper":
        below = jnp.broadcast_to(jnp.asarray(PAPER, strokes.dtype), (*strokes.shape[:2], 3))
    elif arguments.over == "shading":
        below = jnp.asarray(_shaded(arguments, loaded, gbuffer, radiance, exposure))
    clock.once("save", lambda: io.save_image(arguments.output, _over(strokes, below)))


def _shaded(arguments, loaded, gbuffer, radiance, exposure) -> np.ndarray:
    """The shaded object over paper, with smooth outlines, as `shapeenh render` shows it."""
    samples = loaded.samples
    coverage = loaded.coverage and loaded.coverage(gbuffer)
    if samples > 1:
        gbuffer = loaded.gbuffer(samples)
        radiance = shade(gbuffer, loaded.lights, loaded.material)
    return render.side_by_side([radiance], exposure, gbuffer.mask, arguments, samples, coverage=coverage)


def object_lines(gbuffer, descriptor, picture, camera, arguments, kinds):
    """Strokes [H, W, 4] of several kinds, each with its own brush, over one another in the given order.

    picture: [H, W, 3], for brushes that take their colour from it and for luminance edges; or None.
    """
    height, width = gbuffer.mask.shape
    noise = None
    if _wants(arguments, *NOISY):
        noise = surface_noise(gbuffer, camera, size=max(4.0 * height / pipeline.REFERENCE_HEIGHT, 1.0))
    strokes = jnp.zeros((height, width, 4), descriptor.hessian.dtype)
    for kind in kinds:
        image = luminance(picture) if kind == "luminance" else None
        field = line_field(kind, gbuffer, descriptor, luminance=image)
        brush = _brush(arguments, kind, height)
        profile = fit_profile(field, radius=fit_radius(kind), least=float(brush.low))
        inputs = {"footprint": style_footprint(arguments.style), "shading": picture, "noise": noise}
        if kind != "occlusion":  # those lie on the silhouettes, all others end there
            inputs |= {"gbuffer": gbuffer, "descriptor": descriptor}
        layer = draw_lines(profile, field, brush, **inputs)
        strokes = layer + (1 - layer[..., 3:]) * strokes
    return strokes


def image_camera(gbuffer):
    """The orthographic camera of a G-buffer that came from an image: pixels to its world units."""
    mask, position = np.asarray(gbuffer.mask), np.asarray(gbuffer.position)
    height, width = mask.shape
    rows, columns = np.nonzero(mask)

    def pitch(numbers, coordinate):
        if numbers.size == 0 or numbers.min() == numbers.max():
            return 1.0
        first, last = numbers.argmin(), numbers.argmax()
        step = (coordinate[mask][last] - coordinate[mask][first]) / (numbers[last] - numbers[first])
        return abs(float(step)) or 1.0

    dx, dy = pitch(columns, position[..., 0]), pitch(rows, position[..., 1])
    return orthographic_camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), height=height * dy, aspect=width * dx / (height * dy))


# ------------------------------------------------------------------------------------------- frames


def _run_frames(arguments, inputs) -> None:
    if arguments.kinds != ("luminance",):
        raise UsageError(
            f"{inputs[0]} holds pictures without geometry; accepted with --kinds luminance, "
            "or as one image with --as height or --as normals"
        )
    if arguments.size is not None:
        raise UsageError("--size is for meshes and points; frames keep their own size")
    source = frames.open_source(inputs)
    if source.count == 1 and Path(arguments.output).suffix.lower() in io.PICTURE_SUFFIXES:
        io.check_picture_path(arguments.output)
        io.save_image(arguments.output, frame_lines(next(source.frames).read(), arguments))
        return
    options = {name: getattr(arguments, name) for name in ("style", "over", "color", "sigma", "detail")}
    options = {k: list(v) if isinstance(v, tuple) else v for k, v in options.items()} | {"input": source.origin}
    if arguments.over == "transparent" and Path(arguments.output).suffix.lower() in frames.MOVING_SUFFIXES:
        raise UsageError("a GIF or video keeps no transparency; accepted for --over transparent is a folder")
    sink = frames.Sink(arguments.output, options, overwrite=arguments.overwrite)
    drawn, kept = frames.run(source, sink, lambda picture: frame_lines(picture, arguments), fps=arguments.fps)
    if kept:
        print(f"{drawn} frames drawn, {kept} kept from an earlier run")


def frame_lines(picture, arguments) -> np.ndarray:
    """The luminance edges of one frame, drawn (TH10 fig. 8.9); [H, W, 3] or, if transparent, [H, W, 4], linear.

    Edges are those of the displayed picture, which is how an eye sees them; nothing is known of depth, so directions
    alone make singularities, and noise stays where it is on the paper.
    """
    height, width = picture.shape[:2]
    scale = height / pipeline.REFERENCE_HEIGHT
    grey = luminance(jnp.asarray(picture))
    smooth = make_line_field(grey, jnp.zeros((height, width, 2)), sigma=min(arguments.sigma * scale, 20.0)).height
    field = line_field("luminance", None, None, luminance=smooth, sigma=1.0)
    brush = _brush(arguments, "luminance", height)
    profile = fit_profile(field, least=float(brush.low))
    below = None
    linear = jnp.asarray(codecs.srgb_decode(picture), jnp.float32)
    if arguments.over != "transparent":
        below = linear if arguments.over == "shading" else jnp.broadcast_to(jnp.asarray(PAPER), linear.shape)
    noise = paper_noise(height, width) if _wants(arguments, *NOISY) else None
    footprint = style_footprint(arguments.style)
    return _over(draw_lines(profile, field, brush, footprint=footprint, shading=linear, noise=noise), below)


@lru_cache(maxsize=1)
def paper_noise(height: int, width: int):
    """Noise for pictures of this size that know no surface: that of a plane in front of the viewer."""
    empty = jnp.zeros((height, width))
    vectors = jnp.zeros((height, width, 3))
    flat = GBuffer(mask=empty > 0, depth=empty, normal=vectors, position=vectors)
    camera = orthographic_camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), height=float(height), aspect=width / height)
    return surface_noise(flat, camera, size=max(4.0 * height / pipeline.REFERENCE_HEIGHT, 1.0))
