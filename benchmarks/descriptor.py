"""The whole descriptor, forward and gradient, per option: what is not asked for is not computed, as the time says.

    python -m benchmarks.descriptor [--quick]

`gradient, normals`: value and gradient of a scalar with respect to the normals, silhouettes too; `gradient, sigma`:
with respect to sigma. `times`: over the time of the same scalar's value alone.
"""

from __future__ import annotations

import sys
from functools import partial

import jax
import jax.numpy as jnp

import shapeenh as se
from benchmarks.harness import data, measure, table, write
from shapeenh.types import replace

OPTIONS = {
    "sigma 0": {},
    "sigma 1.4": {"sigma": 1.4},
    "sigma 2.5": {"sigma": 2.5},
    "sigma 8": {"sigma": 8.0},
    "sigma 8, explicit": {"sigma": 8.0, "scheme": "explicit"},
    "creases": {"creases": True},
    "foreshortening 0.5": {"foreshortening": 0.5},
}


SIGMAS = (0.0, 2.5)  # of the gradients


def loss(normal, sigma, gbuffer, fixed):
    """A scalar; `fixed` None: sigma is an argument, else that number."""
    d = se.describe(replace(gbuffer, normal=normal), sigma=sigma if fixed is None else fixed)
    return jnp.sum(d.hessian**2)


def gradients(gbuffer) -> dict:
    """name -> call, for every sigma of SIGMAS the value, then the gradients."""
    calls = {}
    for s in SIGMAS:
        at = gbuffer.normal, jnp.asarray(s, gbuffer.normal.dtype)
        value = partial(loss, gbuffer=gbuffer, fixed=s)
        calls[f"value, sigma {s:g}"] = partial(jax.jit(value), *at)
        calls[f"gradient, normals, sigma {s:g}"] = partial(jax.jit(jax.value_and_grad(value)), *at)
    general = partial(loss, gbuffer=gbuffer, fixed=None)
    calls["value, any sigma"] = partial(jax.jit(general), *at)
    calls["gradient, sigma, any sigma"] = partial(jax.jit(jax.value_and_grad(general, 1)), *at)
    return calls


def main(quick: bool) -> None:
    path = data("armadillo.obj")
    mesh = se.load_mesh(path) if path else se.carved_knot()
    rows = []
    for height, width in ((600, 800),) if quick else ((600, 800), (1080, 1920)):
        camera = se.frame_mesh(mesh, aspect=width / height)
        gbuffer = se.render_gbuffer(mesh, camera, height=height, width=width)
        calls = {name: partial(se.describe, gbuffer, **options) for name, options in OPTIONS.items()}
        if not quick:
            calls |= gradients(gbuffer)
        times = measure(calls, repeats=5, seconds=12)
        value = None
        for name in calls:
            row = {"image": f"{width}x{height}", "option": name, **times[name]}
            value = times[name]["median_ms"] if name.startswith("value") else value
            if name.startswith("gradient") and value:
                row["times"] = round(times[name]["median_ms"] / value, 1)
            rows.append({**row, "times": row.get("times")})
    print(table(rows))
    write("descriptor", rows, mesh=path.name if path else "carved_knot")


if __name__ == "__main__":
    main("--quick" in sys.argv)
