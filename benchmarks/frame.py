"""The whole frame, stage by stage: `python -m benchmarks.frame [MESH ...] [--size WxH] [--lights N]`.

Warm medians, compile apart. LW09 reports 37 frames per second (27 ms) at 800 x 600 with 54 lights on its GPU.
Without meshes: bunny.obj and armadillo.obj of the folder SHAPEENH_DATA where there is one, else the embedded knot.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp

import shapeenh as se
from benchmarks import harness

ALPHA, GAMMA, SIGMA = 40.0, 0.0, 2.0


def stages(mesh, environment, *, width: int, height: int, count: int) -> dict:
    """The calls that make one frame, each on the finished results of those before it."""
    camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=width / height)
    world = se.sample_environment(environment, count)
    material = se.named_material("stone")
    lights = se.rotate_lights(world, camera)
    size = {"height": height, "width": width}
    seen = se.rasterize(mesh, camera, **size)
    gbuffer = se.render_gbuffer(mesh, camera, **size)
    scale = height / 600
    descriptor = se.describe(gbuffer, sigma=SIGMA * scale)
    warp = se.LightWarp(ALPHA, GAMMA)

    def loss(alpha, radiance):
        enhancement = se.LightWarp(alpha, GAMMA)
        image = se.render(
            mesh, camera, se.Lights(world.direction, radiance), material, enhancement, sigma=SIGMA, **size
        )
        return jnp.mean(image * image)

    gradient = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    return {
        "rasterize": lambda: se.rasterize(mesh, camera, **size).triangle,
        "G-buffer (with rasterize)": lambda: se.render_gbuffer(mesh, camera, **size).normal,
        "descriptor, sigma 2": lambda: se.describe(gbuffer, sigma=SIGMA * scale).hessian,
        "shade": lambda: se.shade(gbuffer, lights, material),
        "shade warped": lambda: se.shade_warped(gbuffer, descriptor, lights, material, alpha=ALPHA * scale),
        "frame": lambda: se.render(mesh, camera, world, material, warp, sigma=SIGMA, **size),
        "frame, value and gradient": lambda: gradient(ALPHA, world.radiance),
    }, {"triangles": int(mesh.faces.shape[0]), "covered": int((seen.triangle >= 0).sum())}


def conclude(name: str, rows: list[dict]) -> str:
    ms = {r["stage"]: r["median_ms"] for r in rows if r["mesh"] == name}
    frame, gradient = ms["frame"], ms["frame, value and gradient"]
    return f"{name}: {frame:.0f} ms a frame; with a gradient {gradient / frame:.1f} times that."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--lights", type=int, default=54)
    arguments = parser.parse_args()
    width, height = (int(n) for n in arguments.size.split("x"))
    meshes = harness.meshes(arguments.meshes, knot=True)
    rows = []
    for name, mesh in meshes.items():
        calls, facts = stages(mesh, se.procedural_studio(), width=width, height=height, count=arguments.lights)
        for stage, times in harness.measure(calls, repeats=15).items():
            rows.append({"mesh": name, "stage": stage, **facts, **times})
    print(harness.table(rows))
    said = " ".join(conclude(name, rows) for name in meshes) + " LW09 reports 27 ms on its GPU."
    print(harness.write("frame", rows, size=arguments.size, lights=arguments.lights, answer=said))
    print(said)


if __name__ == "__main__":
    main()
