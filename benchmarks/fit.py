"""How many pictures a fit costs, by solver: `python -m benchmarks.fit [--size WxH] [--starts N] [--all-solvers]`.

Contrast: every scene x parameter set x target x start. `renders` counts pictures, `gradients` those with their gradient
(each costs about three), `met` the share of fits that end within 1e-4 of the target; `missed` are the others, with the
reason that they give. Pictures: hidden parameters, and a strength per pixel, from the picture they make. Scenes: the
meshes and maps of the folder SHAPEENH_DATA where there is one, and the embedded knot under the procedural studio.
"""

from __future__ import annotations

import argparse
import importlib.metadata
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
        self.gradients = 0

    def __call__(self, enhancement, lights=None, descriptor=None):
        return illuminate(
            self.gbuffer, descriptor or self.descriptor, lights or self.lights, self.material, enhancement
        )

    def counted(self, picture):
        """p -> picture(scene, **p), whose gradients are counted."""

        def render(p):
            self.gradients += any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(p))
            return picture(self, **p)

        return render


# ------------------------------------------------------------------------------------------- what is fitted


def smoothed(scene, sigma):
    return scene(se.LightWarp(40.0), descriptor=se.describe(scene.gbuffer, sigma=sigma))


def turned(scene, angle):
    """Lights turned about the vertical."""
    x, y, z = scene.lights.direction.T
    c, s = jnp.cos(angle), jnp.sin(angle)
    direction = jnp.stack([c * x + s * z, y, c * z - s * x], axis=-1)
    return scene(se.LightWarp(40.0), se.Lights(direction, scene.lights.radiance))


def brightened(scene, key, rest):
    """The three strongest lights by one factor, all others by another."""
    strength = jnp.sum(scene.lights.radiance, axis=-1)
    strong = strength >= jnp.sort(strength)[-3]
    radiance = scene.lights.radiance * jnp.where(strong, key, rest)[:, None]
    return scene(se.LightWarp(40.0), se.Lights(scene.lights.direction, radiance))


SETS = {
    "alpha": (lambda scene, **p: scene(se.LightWarp(**p)), {"alpha": WARP["alpha"]}),
    "alpha, gamma": (lambda scene, **p: scene(se.LightWarp(**p)), WARP),
    "radiance scaling, 4": (lambda scene, **p: scene(se.RadianceScaling(**p)), SCALING),
    "sigma": (smoothed, {"sigma": (0.0, 4.0)}),
    "light rotation": (turned, {"angle": (-np.pi, np.pi)}),
    "light intensities, 2": (brightened, {"key": (0.05, 4.0), "rest": (0.05, 4.0)}),  # a black picture has no contrast
}
COMPARED = ("alpha", "alpha, gamma", "radiance scaling, 4")  # with scipy's minimiser


def scenes(height, width):
    yield Scene("knot, procedural", se.carved_knot(), se.procedural_studio(), height, width)
    meshes = harness.meshes(names=("bunny", "armadillo", "fandisk"))
    for name, mesh in meshes.items() if "knot" not in meshes else ():
        for sky, radiance in harness.maps(embedded=False).items():
            yield Scene(f"{name}, {sky}", mesh, radiance, height, width)


def starts(bounds, count, rng):
    """The middle, both ends, then points at random."""
    low, high = (np.array([b[k] for b in bounds.values()]) for k in (0, 1))
    places = [0.5 * (low + high), low, high, *(low + rng.random((max(count - 3, 0), len(low))) * (high - low))]
    return [dict(zip(bounds, map(float, place), strict=True)) for place in places[:count]]


def contrast_fits(scene, picture, bounds, solver, measure, count, missed, seed=1):
    """One row per fit, and a line in `missed` for each that did not meet its target; targets at 20, 50 and 80 % of the
    contrasts seen at random points."""
    rng = np.random.default_rng(seed)
    render = scene.counted(picture)
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
                why = fit.reason
            except ValueError as error:  # calls a target out of reach that is not
                why = str(error)
                rows.append((False, np.nan, scene.gradients, time.perf_counter() - begin))
            if why:
                missed.append(f"{scene.name}, {measure}, {solver} from {start} to {target:.4g}: {why}")
                print(missed[-1], flush=True)
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
        "seconds_first": round(float(seconds[0]), 3),
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
    options = {"mask": scene.mask, "solver": solver, "max_renders": 20 if harness.QUICK else 300}
    found = se.fit_image(scene, scene(hidden), se.LightWarp(5.0, 0.0), bounds=WARP, **options)
    error = max(abs(found.parameters.alpha / 37 - 1), abs(found.parameters.gamma / 0.25 - 1))
    row("alpha, gamma", found, float(error), time.perf_counter() - begin)

    begin, top = time.perf_counter(), float(scene.lights.radiance.max())
    render = lambda lights: scene(hidden, lights)  # noqa: E731
    start = se.Lights(scene.lights.direction, jnp.full_like(scene.lights.radiance, 0.1 * top))
    bounds = {"radiance": (0.0, 1.2 * top)}
    found = se.fit_image(render, scene(hidden), start, bounds=bounds, **options)
    error = jnp.linalg.norm(found.parameters.radiance - scene.lights.radiance) / jnp.linalg.norm(scene.lights.radiance)
    row("radiance of 54 lights", found, float(error), time.perf_counter() - begin)

    begin = time.perf_counter()
    truth = 20 + 40 * jnp.linspace(0, 1, height)[:, None] * jnp.ones((1, scene.mask.shape[1]))
    render = lambda strength: se.shade_warped(  # noqa: E731
        scene.gbuffer, scene.descriptor, scene.lights, scene.material, alpha=strength
    )
    found = se.fit_image(render, render(truth), jnp.full_like(truth, 40.0), bounds=(0, 100), **options)
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
    newton = [r for r in rows if r["solver"] == "newton" and r["parameters"] in SETS]
    cost = {
        solver: np.median([r["cost_median"] for r in rows if r["solver"] == solver and r["parameters"] in COMPARED])
        for solver in ("newton", "scipy")
    }
    compiled = [r for r in rows if r["solver"] == "lbfgsb"]
    other = f", with jaxopt's LBFGSB {compiled[0]['cost_median']:.0f} and its compilation" if compiled else ""
    fits, met = sum(r["fits"] for r in newton), sum(r["met"] * r["fits"] for r in newton)
    return (
        f"Default: Newton steps inside the box; {met:.0f} of {fits} fits meet their target, from the middle, both ends "
        f"and points at random. In plain pictures a fit costs {cost['newton']:.0f}, with scipy's L-BFGS-B "
        f"{cost['scipy']:.0f}{other} (a gradient counts as two more)."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="96x72")
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument(
        "--all-solvers", action="store_true", help="also those that compile anew for every fit: minutes"
    )
    arguments = parser.parse_args()
    width, height = (int(n) for n in arguments.size.split("x"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # maps that hold negative pixels say so
        prepared = list(scenes(height, width))[: 2 if harness.QUICK else None]
    rows: list[dict] = []
    missed: list[str] = []
    for what, (picture, bounds) in list(SETS.items())[:: 4 if harness.QUICK else 1]:
        for solver in ("newton", "scipy") if what in COMPARED else ("newton",):
            fits = []
            for scene in prepared:
                for measure in ("rms", "michelson", "band") if scene is prepared[0] else ("rms",):
                    fits += contrast_fits(scene, picture, bounds, solver, measure, arguments.starts, missed)
            rows.append(summary(solver, what, fits))
            print(harness.table(rows[-1:]), flush=True)
    if arguments.all_solvers:
        for solver in ("newton", "scipy", "adam", "projected", "lbfgsb"):
            what, (picture, bounds) = "alpha; " + prepared[0].name, SETS["alpha"]
            fits = contrast_fits(prepared[0], picture, bounds, solver, "rms", 1, missed)
            rows.append(summary(solver, what, fits))
            print(harness.table(rows[-1:]), flush=True)
    pictures = [
        row for solver in ("scipy", "adam")[: 1 if harness.QUICK else 2] for row in picture_fits(prepared[-1], solver)
    ]
    print(harness.table(rows), "", harness.table(pictures), sep="\n")
    said = conclude(rows)
    solvers = {name: importlib.metadata.version(name) for name in ("scipy", "jaxopt", "optax")}
    facts = {"size": arguments.size, "solvers": solvers, "scenes": [s.name for s in prepared], "answer": said}
    print(harness.write("fit", rows, pictures=pictures, missed=missed, **facts))
    print(said)


if __name__ == "__main__":
    main()
