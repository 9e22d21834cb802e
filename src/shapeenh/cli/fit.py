"""`shapeenh fit`: the warp that gives a picture a wanted contrast."""

from __future__ import annotations

import json

import numpy as np

from shapeenh import io, pipeline
from shapeenh.cli import render, scene, values
from shapeenh.cli.terminal import Stopwatch
from shapeenh.cli.values import UsageError
from shapeenh.fit.contrast import MEASURES, contrast
from shapeenh.fit.to_contrast import fit_contrast
from shapeenh.style import tone
from shapeenh.types import LightWarp

NAMES = ("alpha", "gamma")


def add_parser(commands) -> None:
    """`shapeenh fit` and its options."""
    parser = commands.add_parser("fit", help="the warp that gives a wanted contrast", description=run.__doc__)
    parser.set_defaults(run=run)
    scene.add_arguments(parser)
    add = parser.add_argument
    add("-o", "--output", required=True, metavar="OUT", help="picture to write: the original beside the fitted one")
    add("--target-contrast", type=values.number, required=True, metavar="C", help="contrast wanted, > 0")
    add("--measure", choices=MEASURES, default="rms", help="of luminance under the mask (default: rms)")
    add("--fit", choices=(*NAMES, "both"), default="both", help="what may change (default: both)")
    add("--alpha", type=values.number, default=30.0, help="where alpha starts, or stays (default: 30)")
    add("--gamma", type=values.number, default=0.0, help="where gamma starts, or stays (default: 0)")
    add("--max-alpha", type=values.number, default=200.0, help="upper bound of alpha; the lower is 0 (default: 200)")
    add("--sigma", type=values.number, default=2.0, help="scale of the features, px at 600 px height (default: 2)")
    add(
        "--background", type=values.color, default="grey", metavar="NAME|#RRGGBB", help="white, black, grey or a colour"
    )
    add("--json", action="store_true", help="print what was found as JSON")


def run(arguments) -> None:
    """Find the warp that gives the picture a wanted contrast; print it, and draw the original beside the result.

    The contrast is that of linear luminance, before the tone curve, at one sample per pixel.
    """
    _check(arguments)
    clock = Stopwatch(repeat=False)
    loaded = scene.load(arguments, clock)
    gbuffer, picture = _prepare(loaded, arguments, clock, 1)
    mask = np.asarray(gbuffer.mask)
    if not mask.any():
        raise UsageError("nothing is seen: the picture is empty; accepted is an input that covers at least one pixel")
    bounds = {"alpha": (0.0, arguments.max_alpha), "gamma": (-1.0, 1.0)}
    found = clock.once(
        "fit",
        lambda: fit_contrast(
            picture,
            arguments.target_contrast,
            LightWarp(alpha=arguments.alpha, gamma=arguments.gamma),
            mask=mask,
            bounds={name: bounds[name] for name in (NAMES if arguments.fit == "both" else (arguments.fit,))},
            measure=arguments.measure,
        ),
    )
    original = float(contrast(picture(None), mask, measure=arguments.measure))
    samples = loaded.samples
    if samples > 1:
        gbuffer, picture = _prepare(loaded, arguments, clock, samples)
    plain, warped = picture(None), picture(found.parameters)
    exposure = tone.auto_exposure(plain, gbuffer.mask)
    coverage = loaded.coverage and clock.stage("coverage", lambda: loaded.coverage(gbuffer))
    shown = render.side_by_side([plain, warped], exposure, gbuffer.mask, arguments, samples, coverage=coverage)
    clock.once("save", lambda: io.save_image(arguments.output, shown))
    report(arguments, found, original)


def _prepare(loaded, arguments, clock, samples: int):
    """(G-buffer, warp -> picture): what does not depend on the warp is computed once."""
    gbuffer = clock.stage("G-buffer", lambda: loaded.gbuffer(samples))
    descriptor = clock.stage("descriptor", lambda: render.described(gbuffer, arguments))
    return gbuffer, lambda warp: pipeline.illuminate(gbuffer, descriptor, loaded.lights, loaded.material, warp)


def _check(arguments) -> None:
    values.check_between("--max-alpha", arguments.max_alpha, 1e-3, 1e6)
    values.check_between("--alpha", arguments.alpha, 0, arguments.max_alpha)
    values.check_between("--gamma", arguments.gamma, -1, 1)
    values.check_between("--sigma", arguments.sigma, 0, 10)
    if not arguments.target_contrast > 0:
        raise UsageError(f"--target-contrast is {arguments.target_contrast:g}; accepted are numbers > 0")
    io.check_picture_path(arguments.output)


def report(arguments, found, original: float) -> None:
    """Print what was found, as a sentence or as JSON."""
    record = {
        "alpha": float(found.parameters.alpha),
        "gamma": float(found.parameters.gamma),
        "contrast": float(found.value),
        "original": original,
        "measure": arguments.measure,
        "renders": found.renders,
        "converged": found.converged,
        "reason": found.reason,
    }
    if arguments.json:
        print(json.dumps(record, indent=2))
        return
    ended = "" if found.converged else f" (not converged: {found.reason})"
    print(
        f"alpha {record['alpha']:.4g}, gamma {record['gamma']:.4g}: {arguments.measure} contrast "
        f"{record['contrast']:.4g}{ended}, originally {original:.4g}; {found.renders} pictures rendered"
    )
