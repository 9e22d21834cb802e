"""Diffusion: error against the exact heat flow beside time, explicit steps and the fast scheme.

    python -m benchmarks.diffusion [--quick]

Scenes of 800 x 600: an open rectangle, the same crossed by insulated lines, and, where SHAPEENH_DATA says where it is,
the depth gradient of the armadillo and its silhouettes. `explicit` and `fast` errors: against the exact semi-discrete
flow (a converged Chebyshev expansion in float64), those `to a Gaussian` against the continuous heat flow on the open
rectangle (spectrally); all rms, as a fraction of the input's. The plot: milliseconds against error, a point per sigma.
`reverse`: value and gradient of a scalar, as multiples of the value's time; with respect to the conductance of all
pixels, and of those on the flanks of silhouettes, where it is neither 0 nor 1, as `describe` does it. Memory is kept
(`shapeenh.keep_memory`).
"""

from __future__ import annotations

import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from tests.reference import diffusion as reference

import shapeenh as se
from benchmarks.harness import data, measure, pareto, table, write
from shapeenh.descriptor.diffusion import diffuse_stacks, flank, levels_for, most_links
from shapeenh.stencils import links


@partial(jax.jit, static_argnames=("levels", "flanks"))
def run(u, c, time, levels, flanks=False):
    marks = flank(c) if flanks else None
    return diffuse_stacks((u,), c, links(c), time, marks, time[0, 0] < 1e9, levels, True, most_links(c.size, False))[0]


def scenes(height, width):
    y, x = np.mgrid[:height, :width]
    rng = np.random.default_rng(0)
    u = np.sin(x / 9) * np.cos(y / 11) + 0.5 * np.cos(x / 4 + y / 5) + 0.2 * rng.standard_normal((height, width))
    u = np.stack([u, u[::-1]])
    cut = np.ones((height, width))
    for angle in (0.2, 0.7, 1.3, 2.1):
        cut[np.abs(((x - width / 2) * np.sin(angle) - (y - height / 2) * np.cos(angle)) % 90 - 45) < 0.75] = 0
    found = {"open": (u, np.ones((height, width))), "lines": (u * (cut > 0), cut)}
    path = data("armadillo.obj")
    if path:
        mesh = se.load_mesh(path)
        camera = se.frame_mesh(mesh, aspect=width / height)
        d = se.describe(se.render_gbuffer(mesh, camera, height=height, width=width), foreshortening=0.5)
        g, c = np.moveaxis(np.asarray(d.gradient, np.float64), -1, 0), np.asarray(d.conductance, np.float64)
        found["armadillo"] = g * (c > 0), c
    return found


def rms(error, on) -> float:
    return float(np.sqrt(np.mean(error[:, on] ** 2)))


WANTED = {  # in what, and whether in flanks
    "by planes": (0, False),
    "by sigma": (2, False),
    "by flanks": (1, True),
    "by flanks, planes, sigma": ((0, 1, 2), True),
    "by conductance": (1, False),
}


def reverse(scene: str, plane, conductance, sigma: float) -> list[dict]:
    """Per scheme: how many times as long as the value the value takes together with each gradient."""
    rows = []
    time = jnp.full((1, 1), 0.5 * sigma**2, jnp.float32)
    for name, levels in (("explicit", -2), ("fast", levels_for(sigma))):

        def value(u, c, t, levels=levels, flanks=False):
            out = run(u, c, t, levels, flanks)
            return jnp.vdot(out, jnp.flip(plane, 1)) + jnp.vdot(out, out)

        functions = {"value": jax.jit(value)}
        for what, (at, flanks) in WANTED.items():
            functions[what] = jax.jit(jax.value_and_grad(partial(value, flanks=flanks), at))
        times = measure({what: partial(f, plane, conductance, time) for what, f in functions.items()}, repeats=5)
        row = {"scene": scene, "sigma": sigma, "scheme": name, "value ms": times["value"]["median_ms"]}
        rows.append(row | {w: round(times[w]["median_ms"] / times["value"]["median_ms"], 2) for w in WANTED})
    return rows


def main(quick: bool) -> None:
    kept = se.keep_memory()
    rows: list[dict] = []
    backward: list[dict] = []
    for scene, (u, c) in scenes(600, 800).items():
        on = c > 0
        scale = rms(u, on)
        plane, conductance = jnp.asarray(u, jnp.float32), jnp.asarray(c, jnp.float32)
        for sigma in (2.0, 8.0) if quick else (1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
            exact = reference.heat_flow(u, *reference.links(c), 0.5 * sigma**2)
            time = jnp.full((1, 1), 0.5 * sigma**2, jnp.float32)
            schemes = {"explicit": -4, "fast": levels_for(sigma)}
            calls = {name: partial(run, plane, conductance, time, n) for name, n in schemes.items()}
            times = measure(calls, repeats=3 if sigma > 8 else 5, seconds=6)
            row: dict = {"scene": scene, "sigma": sigma, "steps": int(np.ceil(sigma**2 / 0.4))}
            for name, call in calls.items():
                out = np.asarray(call(), np.float64)
                row[f"{name} error"] = float(f"{rms(out - exact, on) / scale:.2g}")
                row[f"{name} ms"] = times[name]["median_ms"]
                if scene == "open":
                    away = rms(out - np.stack([reference.gaussian(v, sigma) for v in u]), on) / scale
                    row[f"{name} to a Gaussian"] = float(f"{away:.2g}")
            row["speedup"] = round(row["explicit ms"] / row["fast ms"], 1)
            rows.append(row)
            print(row, flush=True)
            if scene != "lines" and sigma in (2.0, 8.0):
                backward += reverse(scene, plane, conductance, sigma)
    keys = list(rows[0])
    print(table([{key: row.get(key) for key in keys} for row in rows]))
    print(table(backward))
    at = {row["scene"]: row for row in rows if row["sigma"] == 8}
    speed, error = min(r["speedup"] for r in at.values()), max(r["fast error"] for r in at.values())
    said = (
        f"Default: the fast scheme. At sigma 8 it takes 1/{speed:g} of the time of explicit steps or less, at an error "
        f"of {100 * error:.2g} % of the input or less; below sigma 2 steps are as fast and exact."
    )
    write("diffusion", rows, reverse=backward, answer=said, memory="kept" if kept else "fresh")
    print(said)
    series: dict[str, list[tuple]] = {}
    for row in rows:
        for name in ("explicit", "fast"):
            point = f"{row['sigma']:g}", row[f"{name} ms"], row[f"{name} error"]
            series.setdefault(f"{name}, {row['scene']}", []).append(point)
    title = "Diffusion, 800 x 600, two planes; a point per sigma"
    pareto("diffusion", series, default="fast, open 2", title=title, error="rms error / rms input")


if __name__ == "__main__":
    main("--quick" in sys.argv)
