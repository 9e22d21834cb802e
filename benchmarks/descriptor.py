"""The whole descriptor, forward and gradient, per option: what is not asked for is not computed, as the time says.

python -m benchmarks.descriptor [--quick]
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


def loss(normal, gbuffer, options):
    return jnp.sum(se.describe(replace(gbuffer, normal=normal), **options).hessian ** 2)


def main(quick: bool) -> None:
    path = data("armadillo.obj")
    mesh = se.load_mesh(path) if path else se.carved_knot()
    rows = []
    for height, width in ((600, 800),) if quick else ((600, 800), (1080, 1920)):
        camera = se.frame_mesh(mesh, aspect=width / height)
        gbuffer = se.render_gbuffer(mesh, camera, height=height, width=width)
        calls = {name: partial(se.describe, gbuffer, **options) for name, options in OPTIONS.items()}
        if not quick:
            for name in ("sigma 0", "sigma 2.5"):
                grad = jax.jit(jax.grad(partial(loss, gbuffer=gbuffer, options=OPTIONS[name])))
                calls[f"gradient, {name}"] = partial(grad, gbuffer.normal)
        times = measure(calls, repeats=5)
        rows += [{"image": f"{width}x{height}", "option": name, **times[name]} for name in calls]
    print(table(rows))
    write("descriptor", rows, mesh=path.name if path else "carved_knot")


if __name__ == "__main__":
    main("--quick" in sys.argv)
