"""What a gradient costs, stage by stage: `python -m benchmarks.gradients [MESH] [--size WxH] [--lights N]`.

Each stage on the finished results of those before it, under `jit`: the value of a loss (the mean square of what the
stage makes), and that value together with its gradient in what is named. Both are the general variants, which a
derivative needs; called directly, a stage may skip more (docs/skipping.md). Memory is kept (`shapeenh.keep_memory`),
but with --fresh. Without a mesh: armadillo.obj of the folder SHAPEENH_DATA where there is one, else the embedded knot.
The goal is a ratio of 3.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp

import shapeenh as se
from benchmarks import harness
from shapeenh.types import replace

ALPHA, SIGMA, LEAST = 40.0, 2.0, 0.05
REACH = 8  # px, of a brush whose radius is not known
GOAL = 3.0


def stages(mesh, *, width: int, height: int, count: int) -> tuple[dict, list[tuple]]:
    """(the scene; (stage, in what, function of the scene and a dict of arguments, these arguments), ...)."""
    camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=width / height)
    size = {"height": height, "width": width}
    world = se.sample_environment(se.procedural_studio(), count)
    lights = se.rotate_lights(world, camera)
    material = se.Material(jnp.full(3, 0.6), jnp.full(3, 0.05), jnp.asarray(50.0))
    gbuffer = se.render_gbuffer(mesh, camera, **size)
    scale = height / 600
    descriptor = se.describe(gbuffer, sigma=SIGMA * scale)
    field = se.line_field("valley", gbuffer, descriptor, sigma=SIGMA)
    profile = se.fit_profile(field, least=LEAST)
    image = se.shade_warped(gbuffer, descriptor, lights, material, alpha=ALPHA * scale)
    style = se.style_brush("ink", "valley", height=height)
    number = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    scene = {"mesh": mesh, "camera": camera, "world": world, "material": material, "gbuffer": gbuffer}
    scene |= {"descriptor": descriptor, "light": lights.direction, "field": field, "profile": profile}

    def solid(s, v):
        mesh = s["mesh"]
        return replace(mesh, vertices=v.get("vertices", mesh.vertices), normals=v.get("normals", mesh.normals))

    def described(s, v):
        gbuffer = s["gbuffer"]
        return se.describe(replace(gbuffer, normal=v.get("normal", gbuffer.normal)), sigma=v["sigma"]).hessian

    def shaded(s, v):
        gbuffer, descriptor = s["gbuffer"], s["descriptor"]
        g = replace(gbuffer, normal=v.get("normal", gbuffer.normal))
        d = replace(descriptor, hessian=v.get("hessian", descriptor.hessian))
        return g, d, se.Lights(s["light"], v["radiance"]), v["material"]

    def warped(s, v):
        return se.shade_warped(*shaded(s, v), alpha=v["alpha"], gamma=v["gamma"])

    def scaled(s, v):
        gammas = {"gamma_diffuse": v["gamma"], "gamma_specular": v["gamma"]}
        return se.shade_scaled(*shaded(s, v), invariant=v["invariant"], anisotropy=v["anisotropy"], **gammas)

    def framed(s, v):
        light = se.Lights(s["world"].direction, v["radiance"])
        warp = se.LightWarp(v["alpha"])
        return se.render(solid(s, v), s["camera"], light, s["material"], warp, sigma=SIGMA, **size)

    def resolved(s, v):
        g = se.render_gbuffer(solid(s, v), v["camera"], **size)
        return g.normal, g.position

    def plain(s, v):
        g, _, light, stuff = shaded(s, v)
        return se.shade(g, light, stuff)

    def lined(s, v):
        bent = replace(s["descriptor"], hessian=v["hessian"], gradient=v["slope"])
        f = se.line_field("valley", s["gbuffer"], bent, sigma=v["sigma"])
        return f.height, f.direction

    def fitted(s, v):
        return se.fit_profile(replace(s["field"], height=v["height"], direction=v["direction"]), least=LEAST).distance

    def drawn(s, v):
        profile, brush = replace(s["profile"], distance=v["distance"]), replace(style, radius=v["radius"])
        return se.draw_lines(profile, s["field"], brush, reach=REACH)

    def shown(s, v):
        return se.tone_map(v["image"], exposure=v["exposure"], white=v["white"])

    def measured(s, v):
        return se.contrast(v["image"], s["gbuffer"].mask)

    look = {"alpha": number(ALPHA * scale), "gamma": number(0.2), "radiance": lights.radiance, "material": material}
    tuned = {k: look[k] for k in ("radiance", "material")}
    matt = dict(tuned)
    tuned |= {"invariant": number(0.4), "gamma": number(2.0), "anisotropy": number(0.5)}
    bent = {"normal": gbuffer.normal, "hessian": descriptor.hessian}
    smooth, slope = {"sigma": number(SIGMA * scale)}, {"slope": descriptor.gradient, "sigma": number(SIGMA)}
    profiled = {"height": field.height, "direction": field.direction}
    inked = {"distance": profile.distance, "radius": number(style.radius)}
    display = {"image": image, "exposure": number(1.0), "white": number(4.0)}
    lit = {"alpha": number(ALPHA), "radiance": world.radiance}
    solids = {"vertices": mesh.vertices, "normals": mesh.normals}
    return scene, [
        ("rasterise and resolve", "vertices, normals, camera", resolved, solids | {"camera": camera}),
        ("describe", "sigma", described, smooth),
        ("describe", "normals, sigma", described, smooth | {"normal": gbuffer.normal}),
        ("shade", "lights, material", plain, matt),
        ("shade_warped", "alpha, gamma, lights, material", warped, look),
        ("shade_warped", "also normals, Hessian", warped, look | bent),
        ("shade_scaled", "strengths, lights, material", scaled, tuned),
        ("shade_scaled", "also normals, Hessian", scaled, tuned | bent),
        ("line_field", "Hessian, slopes, sigma", lined, slope | {"hessian": descriptor.hessian}),
        ("fit_profile", "height, direction", fitted, profiled),
        ("draw_lines", "distance, radius", drawn, inked),
        ("tone_map", "radiance, exposure, white", shown, display),
        ("contrast", "radiance", measured, {"image": image}),
        ("frame", "alpha, lights", framed, lit),
        ("frame", "also vertices, normals", framed, lit | solids),
    ]


def loss(function, scene, values):
    parts = jax.tree.leaves(function(scene, values))
    return sum(jnp.mean(jnp.square(part)) for part in parts)


def compiled(function):
    """(the loss, the loss with its gradient), of the scene and the arguments.

    The scene is an argument, too: what is closed over would be a constant, and XLA folds that where it can, in a value
    more than in its gradient.
    """
    value = partial(loss, function)
    return jax.jit(value), jax.jit(jax.value_and_grad(value, argnums=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", nargs="?", type=Path)
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--lights", type=int, default=54)
    parser.add_argument("--fresh", action="store_true", help="every call in new memory")
    arguments = parser.parse_args()
    kept = not arguments.fresh and se.keep_memory()
    width, height = (int(n) for n in arguments.size.split("x"))
    paths = [arguments.mesh] if arguments.mesh else []
    name, mesh = next(iter(harness.meshes(paths, ("armadillo",)).items()))
    rows = []
    scene, found = stages(mesh, width=width, height=height, count=arguments.lights)
    for stage, what, function, given in found:
        value, both = compiled(function)
        calls = {
            "value": lambda f=value, v=given: f(scene, v),
            "with gradient": lambda f=both, v=given: f(scene, v),
        }
        times = harness.measure(calls, seconds=4)
        ms = {call: found["median_ms"] for call, found in times.items()}
        row = {"stage": stage, "in": what, "value_ms": ms["value"], "with_gradient_ms": ms["with gradient"]}
        row |= {"ratio": round(ms["with gradient"] / ms["value"], 2)}
        rows.append(row | {"compile_s": round(times["with gradient"]["first_ms"] / 1e3, 1)})
        print(rows[-1], flush=True)
    print(harness.table(rows))
    frames = {r["in"]: r["ratio"] for r in rows if r["stage"] == "frame"}
    over = [f"{r['stage']} ({r['in']}) {r['ratio']:.1f}" for r in rows if r["ratio"] > GOAL and r["stage"] != "frame"]
    said = (
        f"A frame with its gradient takes {frames['alpha, lights']:.1f} times the value's time in alpha and lights, "
        f"{frames['also vertices, normals']:.1f} times in vertices and normals too. "
        + (f"More than {GOAL:g} times: {', '.join(over)}." if over else f"No stage takes more than {GOAL:g} times.")
    )
    facts = {"mesh": name, "size": arguments.size, "lights": arguments.lights, "memory": "kept" if kept else "fresh"}
    print(harness.write("gradients", rows, answer=said, **facts))
    print(said)


if __name__ == "__main__":
    main()
