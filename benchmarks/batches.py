"""What `vmap` costs beside a loop: `python -m benchmarks.batches [MESH] [--size WxH] [--lights N] [--count N]`.

Each stage of `benchmarks.gradients`, its value and its value together with its gradient, of several sets of arguments
in one scene: at once under `jit(vmap)`, and one after the other in a Python loop over calls of one compiled function.
A ratio below 1: the batch takes less. Memory is kept.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp

import shapeenh as se
from benchmarks import gradients, harness


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", nargs="?", type=Path)
    parser.add_argument("--size", default="400x300")
    parser.add_argument("--lights", type=int, default=54)
    parser.add_argument("--count", type=int, default=3)
    arguments = parser.parse_args()
    se.keep_memory()
    width, height = (int(n) for n in arguments.size.split("x"))
    paths = [arguments.mesh] if arguments.mesh else []
    name, mesh = next(iter(harness.meshes(paths, ("armadillo",)).items()))
    scene, stages = gradients.stages(mesh, width=width, height=height, count=arguments.lights)
    members = range(arguments.count)
    rows = []
    for stage, what, function, given in stages:
        several = jax.tree.map(lambda a: jnp.stack([a for _ in members]), given)
        calls = {}
        for kind, single in zip(("value", "with gradient"), gradients.compiled(function), strict=True):
            batch = jax.jit(jax.vmap(single, (None, 0)))
            calls[f"{kind}, loop"] = partial(lambda f, v: [f(scene, v) for _ in members], single, given)
            calls[f"{kind}, batch"] = partial(batch, scene, several)
        times = {call: found["median_ms"] for call, found in harness.measure(calls, repeats=5, seconds=6).items()}
        row = {"stage": stage, "in": what} | {f"{call}, ms": round(ms, 1) for call, ms in times.items()}
        for kind in ("value", "with gradient"):
            row[f"{kind}, ratio"] = round(times[f"{kind}, batch"] / times[f"{kind}, loop"], 2)
        rows.append(row)
        print(row, flush=True)
    print(harness.table(rows))
    value, both = ([row[f"{kind}, ratio"] for row in rows] for kind in ("value", "with gradient"))
    most = max(rows, key=lambda row: row["with gradient, ratio"])
    said = (
        f"A batch of {arguments.count} takes {min(value)} to {max(value)} times as long as a loop, "
        f"{min(both)} to {max(both)} times with gradients (most: {most['stage']}, {most['in']})."
    )
    facts = {"mesh": name, "size": arguments.size, "lights": arguments.lights, "count": arguments.count}
    print(harness.write("batches", rows, answer=said, **facts))
    print(said)


if __name__ == "__main__":
    main()
