"""How exact float32 is, stage by stage: `python -m benchmarks.precision [MESH ...] [--size WxH] [--lights N]`.

Every stage of the frame in float32 against the same stage in float64: `own`, fed with the float64 result of the stages
before it (rounded to float32), and `cumulative`, fed with the float32 result. Visibility is compared apart: a vertex
that snaps to another 1/256 px shows another face at a handful of pixels; these, and what diffusion mixes with them, are
left out. Errors are relative to the size of the value: a vector's length, a tensor's norm, but never less than 1e-3 of
the image's own rms, so that zeros do not count as infinitely wrong. Half an ulp of float32 is 6e-8. Last, the lights'
colours rounded to bfloat16, and the normals and Hessians that light reads; and the time of the whole chain in each.
Without meshes: bunny, armadillo and fandisk of the folder SHAPEENH_DATA where there is one, and the embedded knot.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness

ALPHA, GAMMA, SIGMA = 40.0, 0.2, 2.0
LIGHTS16, BUFFERS16 = "lights in bfloat16", "lights, normals, Hessians in bfloat16"
LIMITS = {
    "position": "rounding of the coordinates",
    "normal": "barycentric weights: a face one pixel large has corners whose differences keep few of their digits",
    "depth": "rounding of the coordinates",
    "gradient": "the normals: at outlines g = -n_xy/n_z amplifies their error by 1/n_z, up to a hundred times",
    "hessian": "the slopes: their differences cancel where the surface is flat",
    "warp tensor": "the Hessian; the tensor itself is bounded and does not cancel",
    "radiance, scaled": "as radiance; curvature moves the gain, which is bounded",
    "ridge height": "the Hessian, smoothed once more; where the height nears 0 its own size does",
    "radiance": "the warp tensor and the normals; a Phong exponent of 300 multiplies the rounding of n.h",
}


def cast(tree, dtype):
    """Floats of a record in another precision."""
    change = lambda a: jnp.asarray(a, dtype) if jnp.issubdtype(a.dtype, jnp.floating) else jnp.asarray(a)  # noqa: E731
    return jax.tree.map(change, tree)


@dataclasses.dataclass
class Chain:
    """The stages, each a function of the results before it."""

    mesh: se.Mesh
    camera: se.Camera
    lights: se.Lights
    size: dict

    def gbuffer(self):
        return se.render_gbuffer(self.mesh, self.camera, **self.size)

    def describe(self, gbuffer):
        return se.describe(gbuffer, sigma=SIGMA * self.size["height"] / 600)

    @property
    def alpha(self):
        return ALPHA * self.size["height"] / 600

    def tensor(self, descriptor):
        return se.warp_tensor(descriptor.hessian, self.alpha)

    def picture(self):
        gbuffer = self.gbuffer()
        return self.shade(gbuffer, self.describe(gbuffer))

    def scale(self, gbuffer, descriptor):
        strengths = {"invariant": 0.3, "gamma_diffuse": 8.0, "gamma_specular": 8.0}
        return se.shade_scaled(gbuffer, descriptor, self.lights, se.named_material("porcelain"), **strengths)

    def heights(self, gbuffer, descriptor):
        return se.line_field("ridge", gbuffer, descriptor).height[..., None]

    def shade(self, gbuffer, descriptor):
        material = se.named_material("porcelain")
        return se.shade_warped(gbuffer, descriptor, self.lights, material, alpha=self.alpha, gamma=GAMMA)


def errors(got, wanted, mask) -> dict:
    """Median, 99 % and largest error relative to the value's size, over the mask."""
    got, wanted = (np.asarray(a, np.float64)[mask].reshape(int(mask.sum()), -1) for a in (got, wanted))
    size = np.linalg.norm(wanted, axis=1)
    size = np.maximum(size, 1e-3 * np.sqrt(np.mean(size * size)))
    relative = np.linalg.norm(got - wanted, axis=1) / size
    return {
        "median": float(np.median(relative)),
        "99 %": float(np.quantile(relative, 0.99)),
        "max": float(relative.max()),
        "pixels > 1e-2": int(np.sum(relative > 1e-2)),
    }


def around(flags, reach: int):
    """Pixels within `reach` of a true one."""
    out = flags.copy()
    for row, column in np.argwhere(flags):
        out[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] = True
    return out


def halved(a):
    """Stored in bfloat16; a stage makes float32 of it."""
    return a.astype(jnp.bfloat16).astype(jnp.float32)


def budget(mesh, environment, *, width: int, height: int, count: int) -> tuple[list[dict], dict, dict]:
    """Rows per stage; facts: pixels compared, pixels that see another face; calls of the chain by precision."""
    size = {"height": height, "width": width}
    camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=width / height)
    lights = se.rotate_lights(se.sample_environment(environment, count), camera)
    single = Chain(cast(mesh, jnp.float32), cast(camera, jnp.float32), cast(lights, jnp.float32), size)
    rough = single.gbuffer()
    seen = np.asarray(se.rasterize(single.mesh, single.camera, **size).triangle)
    with jax.enable_x64(True):
        double = Chain(*(cast(record, jnp.float64) for record in (single.mesh, single.camera, single.lights)), size)
        fine = double.gbuffer()
        also = np.asarray(se.rasterize(double.mesh, double.camera, **size).triangle)
        form = double.describe(fine)
        warp, image = double.tensor(form), double.shade(fine, form)
        scaled, ridges = double.scale(fine, form), double.heights(fine, form)
        fine32, form32 = cast(fine, jnp.float32), cast(form, jnp.float32)
        fine32, form32 = jax.tree.map(np.asarray, (fine32, form32))
        truth = jax.tree.map(np.asarray, (fine, form, warp, image, scaled, ridges))
    fine, form, warp, image, scaled, ridges = truth
    mask = np.asarray(rough.mask) & ~around(seen != also, int(np.ceil(4 * SIGMA * height / 600)) + 3)

    own = single.describe(jax.tree.map(jnp.asarray, fine32))
    exact_shape = jax.tree.map(jnp.asarray, form32)
    rough_form = single.describe(rough)
    pairs = {
        "position": (rough.position, rough.position, fine.position),
        "normal": (rough.normal, rough.normal, fine.normal),
        "depth": (rough.depth, rough.depth, fine.depth),
        "gradient": (own.gradient, rough_form.gradient, form.gradient),
        "hessian": (own.hessian, rough_form.hessian, form.hessian),
        "warp tensor": (single.tensor(exact_shape), single.tensor(rough_form), warp),
    }
    exact = jax.tree.map(jnp.asarray, fine32), exact_shape
    for stage, function, wanted in (
        ("radiance", single.shade, image),
        ("radiance, scaled", single.scale, scaled),
        ("ridge height", single.heights, ridges),
    ):
        pairs[stage] = function(*exact), function(rough, rough_form), wanted
    rows = []
    for stage, (alone, after, wanted) in pairs.items():
        for kind, got in (("own", alone), ("cumulative", after)):
            rows.append({"stage": stage, "error": kind, **errors(got, wanted, mask)})
    low = dataclasses.replace(single, lights=se.Lights(single.lights.direction, halved(single.lights.radiance)))

    def stored():
        gbuffer = single.gbuffer()
        form = single.describe(gbuffer)
        gbuffer = dataclasses.replace(gbuffer, normal=halved(gbuffer.normal))
        return low.shade(gbuffer, dataclasses.replace(form, hessian=halved(form.hessian)))

    def wide():
        with jax.enable_x64(True):
            return double.picture()

    for kind, coarse in ((LIGHTS16, low.shade(rough, rough_form)), (BUFFERS16, stored())):
        rows.append({"stage": "radiance", "error": kind, **errors(coarse, image, mask)})
    facts = {"pixels": int(mask.sum()), "other face": int((seen != also).sum())}
    return rows, facts, {"float64": wide, "float32": single.picture, LIGHTS16: low.picture, BUFFERS16: stored}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--lights", type=int, default=54)
    arguments = parser.parse_args()
    width, height = (int(n) for n in arguments.size.split("x"))
    meshes = harness.meshes(arguments.meshes, ("bunny", "armadillo", "fandisk"), knot=True)
    rows, facts, times = [], {}, []
    for name, mesh in meshes.items():
        made, facts[name], calls = budget(
            mesh, se.procedural_studio(), width=width, height=height, count=arguments.lights
        )
        rows += [{"mesh": name, **row} for row in made]
        last = {r["error"]: r["99 %"] for r in made if r["stage"] == "radiance"} | {"float64": 0.0}
        last["float32"] = last["cumulative"]
        for kind, found in harness.measure(calls).items():
            times.append({"mesh": name, "precision": kind, "99 %": last[kind], **found})
    print(harness.table(rows))
    print(harness.table(times))
    for name, fact in facts.items():
        print(name, fact)
    of = lambda stage, kind: [r for r in rows if (r["stage"], r["error"]) == (stage, kind)]  # noqa: E731
    whole, bf16 = of("radiance", "cumulative"), of("radiance", LIGHTS16)
    ms = {kind: np.array([t["median_ms"] for t in times if t["precision"] == kind]) for kind in ("float64", "float32")}
    answer = (
        f"The default is float32: the picture is {max(r['median'] for r in whole):.1g} off in the median and "
        f"{max(r['99 %'] for r in whole):.1g} at 99 % of the pixels, a display step being 4e-3; lights in bfloat16 "
        f"would cost {max(r['median'] for r in bf16):.1g} in the median for 6 bytes per light. float64 "
        f"takes {np.median(ms['float64'] / ms['float32']):.1f} times as long."
    )
    series: dict[str, list] = {}
    for t in times:
        series.setdefault(t["mesh"], []).append((t["precision"], t["median_ms"], t["99 %"]))
    harness.pareto(
        "precision", series, default="float32", title="Precision of the chain", error="relative error at 99 % of pixels"
    )
    print(answer)
    options = {"size": arguments.size, "lights": arguments.lights}
    print(harness.write("precision", rows, facts=facts, times=times, limits=LIMITS, answer=answer, **options))


if __name__ == "__main__":
    main()
