"""Enhancing at a lower resolution than the picture's: `python -m benchmarks.resolution`.

The plain picture is shaded at full size; the ratio of the warped to the plain one is made at 1/k of it, enlarged, and
multiplied on. Error: root mean square of the difference to the picture made at full size, over the root mean square of
what the warp changes. Time: of G-buffer, descriptor and light, at whatever sizes they are made.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness

HEIGHT, WIDTH = (240, 320) if harness.QUICK else (600, 800)
FACTORS = (1, 2) if harness.QUICK else (1, 2, 3, 4, 6)
WARP, SIGMA = se.LightWarp(40.0), 2.0


def enlarged(ratio, mask, shape):
    """Bilinear, by covered pixels alone."""
    weight = mask[..., None].astype(ratio.dtype)
    size = (*shape, 3)
    total = jax.image.resize(weight * ratio, size, "linear")
    return total / jnp.maximum(jax.image.resize(weight, (*shape, 1), "linear"), 1e-3)


@jax.jit
def recombined(plain, small_plain, small_warped, mask):
    level = 1e-3 * jnp.max(plain)
    return plain * enlarged((small_warped + level) / (small_plain + level), mask, plain.shape[:2])


def main() -> None:
    meshes = harness.meshes()
    world, material = se.sample_environment(se.procedural_studio(), 54), se.named_material("stone")
    rows = []
    for name, mesh in meshes.items():
        camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=WIDTH / HEIGHT)
        lights = se.rotate_lights(world, camera)

        def frame(k, mesh=mesh, camera=camera, lights=lights):
            full = se.render_gbuffer(mesh, camera, height=HEIGHT, width=WIDTH)
            if k == 1:
                return se.enhance(full, lights, material, WARP, sigma=SIGMA)
            small = se.render_gbuffer(mesh, camera, height=HEIGHT // k, width=WIDTH // k)
            pictures = [se.enhance(small, lights, material, e, sigma=SIGMA) for e in (None, WARP)]
            return recombined(se.shade(full, lights, material), *pictures, small.mask)

        exact = np.asarray(frame(1), np.float64)
        plain = np.asarray(se.render(mesh, camera, world, material, height=HEIGHT, width=WIDTH), np.float64)
        change = np.sqrt(np.mean((exact - plain) ** 2))
        times = harness.measure({k: lambda k=k: frame(k) for k in FACTORS})
        for k in FACTORS:
            error = float(np.sqrt(np.mean((np.asarray(frame(k)) - exact) ** 2)) / change)
            rows.append({"mesh": name, "enhanced at": f"1/{k}", "error": round(error, 4), **times[k]})
    print(harness.table(rows))
    worst = {k: max(r["error"] for r in rows if r["enhanced at"] == f"1/{k}") for k in FACTORS}
    longer = {
        k: np.median([r["median_ms"] / m["median_ms"] for m in rows for r in rows
                      if m["mesh"] == r["mesh"] and m["enhanced at"] == "1/1" and r["enhanced at"] == f"1/{k}"])
        for k in FACTORS
    }  # fmt: skip
    said = (
        f"Default: enhance at full size. Enhanced at half size a frame takes {longer[2]:.2f} times as long, "
        f"and {100 * worst[2]:.0f} % of what the warp adds is lost or misplaced."
    )
    series = {m: [(r["enhanced at"], r["median_ms"], r["error"]) for r in rows if r["mesh"] == m] for m in meshes}
    harness.pareto("resolution", series, default="1/1", title="Enhancement at a lower resolution", error="error")
    print(harness.write("resolution", rows, answer=said))
    print(said)


if __name__ == "__main__":
    main()
