"""How many pictures a fit costs, by solver: `python -m benchmarks.fit [--size WxH] [--starts N] [--all-solvers]`.

Contrast: every scene x parameter set x target x start. `renders` counts pictures, `gradients` those with their gradient
(each costs about three), `met` the share of fits that end within 1e-4 of the target. Pictures: hidden parameters, and a
strength per pixel, from the picture they make. Scenes: the meshes and maps of the folder SHAPEENH_DATA where there is
one, and the embedded knot under the procedural studio.
"""

from __future__ import annotations

import argparse
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness
from shapeenh.pipeline import illuminate

WARP = {"alpha": (0.0, 100.0), "gamma": (-1.0, 1.0)}
SCALING = {
    "invariant": (0.1, 0.9),
    "gamma_diffuse": (0.0, 20.0),
    "gamma_specular": (0.0, 20.0),
    "anisotropy": (-1.0, 1.0),
}


class Scene:
    """A prepared picture: only the light is computed again."""

    def __init__(self, name, mesh, radiance_map, height, width):
        self.name = name
        camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=width / height)
        self.gbuffer = se.render_gbuffer(mesh, camera, height=height, width=width)
        self.descriptor = se.describe(self.gbuffer, sigma=2.0 * height / 600)
        self.lights = se.rotate_lights(se.sample_environment(radiance_map, 54), camera)
        self.material = se.named_material("stone")
        self.mask = np.asarray(self.gbuffer.mask)
        self.plain = self.gradients = 0

    def __call__(self, enhancement, lights=None):
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(enhancement)):
            self.gradients += 1
        return illuminate(self.gbuffer, self.descriptor, lights or self.lights, self.material, enhancement)


def scenes(height, width):
    meshes = {name: harness.data(f"{name}.obj") for name in ("bunny", "armadillo", "fandisk")}
    maps = {name: harness.data(f"{name}.exr") for name in ("studio", "venice")}
    yield Scene("knot, procedural", se.carved_knot(), se.procedural_studio(), height, width)
    for mesh, path in meshes.items():
        for sky, map_path in maps.items():
            if path and map_path:
                yield Scene(f"{mesh}, {sky}", se.load_mesh(path), se.load_environment(map_path), height, width)


def starts(bounds, count, rng):
    """The middle, both ends, then points at random."""
    low, high = (np.array([b[k] for b in bounds.values()]) for k in (0, 1))
    places = [0.5 * (low + high), low, high, *(low + rng.random((max(count - 3, 0), len(low))) * (high - low))]
    return [dict(zip(bounds, map(float, place), strict=True)) for place in places[:count]]


def contrast_fits(scene, record, bounds, solver, measure, count, seed=1):
    """One row per fit; targets at 20, 50 and 80 % of the contrasts seen at random points."""
    rng = np.random.default_rng(seed)
    render = lambda p: scene(record(**p))  # noqa: E731
    seen = [float(se.contrast(render(p), scene.mask, measure=measure)) for p in starts(bounds, 12, rng)]
    rows = []
    for share in (0.2, 0.5, 0.8):
        target = min(seen) + share * (max(seen) - min(seen))
        for start in starts(bounds, count, rng):
            scene.gradients, begin = 0, time.perf_counter()
            try:
                fit = se.fit_contrast(
                    render, target, start, mask=scene.mask, bounds=bounds, measure=measure, solver=solver
                )
                rows.append((fit.converged, fit.renders, scene.gradients, time.perf_counter() - begin))
            except ValueError as error:  # calls a target out of reach that is not
                print(f"{scene.name}, {measure}, {solver} from {start}: {error}", flush=True)
                rows.append((False, np.nan, scene.gradients, time.perf_counter() - begin))
    return rows


def summary(solver, what, rows):
    met, renders, gradients, seconds = (np.array(column, float) for column in zip(*rows, strict=True))
    return {
        "parameters": what,
        "solver": solver,
        "fits": len(rows),
        "met": round(float(np.mean(met)), 4),
        "renders_median": float(np.nanmedian(renders)),
        "renders_p90": float(np.nanpercentile(renders, 90)),
        "renders_max": float(np.nanmax(renders)),
        "gradients_median": float(np.median(gradients)),
        "cost_median": float(np.nanmedian(renders + 2 * gradients)),
        "seconds_median": round(float(np.median(seconds)), 3),
    }


def picture_fits(scene, solver):
    """Hidden alpha and gamma; the lights' colours; a strength per pixel."""
    height = scene.mask.shape[0]
    hidden = se.LightWarp(37.0, 0.25)
    rows = []

    def row(what, found, error, seconds):
        rows.append(
            {"hidden": what, "solver": solver, "renders": found.renders, "residual": float(found.value), "error": error,
             "converged": found.converged, "seconds": round(seconds, 2)}
        )  # fmt: skip

    begin = time.perf_counter()
    found = se.fit_image(scene, scene(hidden), se.LightWarp(5.0, 0.0), mask=scene.mask, bounds=WARP, solver=solver)
    error = max(abs(found.parameters.alpha / 37 - 1), abs(found.parameters.gamma / 0.25 - 1))
    row("alpha, gamma", found, float(error), time.perf_counter() - begin)

    begin, top = time.perf_counter(), float(scene.lights.radiance.max())
    render = lambda lights: scene(hidden, lights)  # noqa: E731
    start = se.Lights(scene.lights.direction, jnp.full_like(scene.lights.radiance, 0.1 * top))
    bounds = {"radiance": (0.0, 1.2 * top)}
    found = se.fit_image(render, scene(hidden), start, mask=scene.mask, bounds=bounds, solver=solver)
    error = jnp.linalg.norm(found.parameters.radiance - scene.lights.radiance) / jnp.linalg.norm(scene.lights.radiance)
    row("radiance of 54 lights", found, float(error), time.perf_counter() - begin)

    begin = time.perf_counter()
    truth = 20 + 40 * jnp.linspace(0, 1, height)[:, None] * jnp.ones((1, scene.mask.shape[1]))
    render = lambda strength: se.shade_warped(  # noqa: E731
        scene.gbuffer, scene.descriptor, scene.lights, scene.material, alpha=strength
    )
    found = se.fit_image(
        render, render(truth), jnp.full_like(truth, 40.0), mask=scene.mask, bounds=(0, 100), solver=solver
    )
    curved = scene.mask & (np.abs(np.asarray(se.mean_curvature(scene.descriptor.hessian))) > 0.02)
    row(
        "strength per pixel",
        found,
        float(np.median(np.abs(found.parameters - truth)[curved])),
        time.perf_counter() - begin,
    )
    return rows


def conclude(rows) -> str:
    """The sentence: the default solver beside scipy's bounded one, over all scenes and sets of parameters."""
    of = {solver: [r for r in rows if r["solver"] == solver and r["fits"] > 10] for solver in ("newton", "scipy")}
    cost = {solver: np.median([r["cost_median"] for r in found]) for solver, found in of.items()}
    met = min(r["met"] for r in of["newton"])
    return (
        f"Default: Newton steps inside the box; {100 * met:.0f} % of the fits meet their target. In plain "
        f"pictures a fit costs {cost['newton']:.0f}, with scipy's L-BFGS-B {cost['scipy']:.0f} (a gradient counts as "
        "two more)."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="96x72")
    parser.add_argument("--starts", type=int, default=4)
    parser.add_argument(
        "--all-solvers", action="store_true", help="also those that compile anew for every fit: minutes"
    )
    arguments = parser.parse_args()
    width, height = (int(n) for n in arguments.size.split("x"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # maps that hold negative pixels say so
        prepared = list(scenes(height, width))
    sets = {
        "alpha": (se.LightWarp, {"alpha": WARP["alpha"]}),
        "alpha, gamma": (se.LightWarp, WARP),
        "radiance scaling, 4": (se.RadianceScaling, SCALING),
    }
    rows = []
    for what, (record, bounds) in sets.items():
        for solver in ("newton", "scipy"):
            fits = []
            for scene in prepared:
                for measure in ("rms", "michelson", "band") if scene is prepared[0] else ("rms",):
                    fits += contrast_fits(scene, record, bounds, solver, measure, arguments.starts)
            rows.append(summary(solver, what, fits))
            print(harness.table(rows[-1:]), flush=True)
    if arguments.all_solvers:
        for solver in ("newton", "scipy", "adam", "projected", "lbfgsb"):
            what, bounds = "alpha; " + prepared[0].name, {"alpha": WARP["alpha"]}
            fits = contrast_fits(prepared[0], se.LightWarp, bounds, solver, "rms", 1)
            rows.append(summary(solver, what, fits))
            print(harness.table(rows[-1:]), flush=True)
    pictures = [row for solver in ("scipy", "adam") for row in picture_fits(prepared[-1], solver)]
    print(harness.table(rows), "", harness.table(pictures), sep="\n")
    said = conclude(rows)
    facts = {"size": arguments.size, "scenes": [s.name for s in prepared], "answer": said}
    print(harness.write("fit", rows, pictures=pictures, **facts))
    print(said)


if __name__ == "__main__":
    main()
