"""Diffusion: error against the exact heat flow beside time, explicit steps and the fast scheme.

    python -m benchmarks.diffusion [--quick]

Two scenes of 800 x 600: an open rectangle, and the same crossed by insulated lines. The exact semi-discrete flow is a
converged Chebyshev expansion in float64; errors are rms, as a fraction of the input's.
"""

from __future__ import annotations

import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from tests.reference import diffusion as reference

from benchmarks.harness import measure, table, write
from shapeenh.descriptor.diffusion import diffuse_stacks, levels_for
from shapeenh.stencils import links


@partial(jax.jit, static_argnames="levels")
def run(u, c, time, levels):
    return diffuse_stacks((u,), *links(c), time, c > 0, time[0, 0] < 1e9, levels=levels, sure=True)[0]


def scenes(height, width):
    y, x = np.mgrid[:height, :width]
    rng = np.random.default_rng(0)
    u = np.sin(x / 9) * np.cos(y / 11) + 0.5 * np.cos(x / 4 + y / 5) + 0.2 * rng.standard_normal((height, width))
    u = np.stack([u, u[::-1]])
    cut = np.ones((height, width))
    for angle in (0.2, 0.7, 1.3, 2.1):
        cut[np.abs(((x - width / 2) * np.sin(angle) - (y - height / 2) * np.cos(angle)) % 90 - 45) < 0.75] = 0
    return {"open": (u, np.ones((height, width))), "lines": (u * (cut > 0), cut)}


def main(quick: bool) -> None:
    rows = []
    for scene, (u, c) in scenes(600, 800).items():
        on = c > 0
        scale = np.sqrt(np.mean(u[:, on] ** 2))
        plane, conductance = jnp.asarray(u, jnp.float32), jnp.asarray(c, jnp.float32)
        for sigma in (2.0, 8.0) if quick else (1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
            exact = reference.heat_flow(u, *reference.links(c), 0.5 * sigma**2)
            time = jnp.full((1, 1), 0.5 * sigma**2, jnp.float32)
            schemes = {"explicit": -5, "fast": levels_for(sigma)}
            calls = {name: partial(run, plane, conductance, time, n) for name, n in schemes.items()}
            times = measure(calls, repeats=5)
            row = {"scene": scene, "sigma": sigma, "steps": int(np.ceil(sigma**2 / 0.4))}
            for name, call in calls.items():
                error = np.asarray(call(), np.float64) - exact
                row[f"{name}_error"] = f"{np.sqrt(np.mean(error[:, on] ** 2)) / scale:.1e}"
                row[f"{name}_ms"] = times[name]["median_ms"]
            row["speedup"] = round(row["explicit_ms"] / row["fast_ms"], 1)
            rows.append(row)
            print(row, flush=True)
    print(table(rows))
    write("diffusion", rows)


if __name__ == "__main__":
    main("--quick" in sys.argv)
