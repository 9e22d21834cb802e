"""What skipping saves: `python -m benchmarks.skipping`; docs/skipping.md is its table.

Each row compares the general variant, which a caller gets whose values are traced, with the one that is chosen from
concrete inputs: their times, and how far the pictures differ relative to the brightest pixel. armadillo.obj where
SHAPEENH_DATA names a folder that has it, else the embedded object; 800 x 600, 54 lights.
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness
from shapeenh.wide import jit_wide

SIZE = {"height": 600, "width": 800}


def pairs() -> dict[str, tuple]:
    """Name -> (general call, call that skips)."""
    mesh = next(iter(harness.meshes(names=("armadillo",)).values()))
    camera = se.frame_mesh(mesh, direction=(0.3, 0.2, 1), aspect=4 / 3)
    g = se.render_gbuffer(mesh, camera, **SIZE)
    d = se.describe(g, sigma=2.0)
    stone = se.named_material("stone")
    lights = se.rotate_lights(se.sample_environment(se.procedural_studio(), 54), camera)
    behind = lights.direction[:, 2:] < 0

    def shade(gbuffer=g, material=stone, radiance=lights.radiance):
        return se.shade(gbuffer, se.Lights(lights.direction, radiance), material)

    def tint(specular, scene=(g, d, lights, stone)):
        g, _, lights, stone = scene
        return se.shade(g, lights, se.Material(stone.diffuse, specular, stone.shininess))

    def warp(alpha, scene=(g, d, lights, stone)):
        return se.shade_warped(*scene, alpha=alpha)

    def scale(gamma=2.0, anisotropy=0.0, scene=(g, d, lights, stone)):
        strengths = {"gamma_diffuse": gamma, "gamma_specular": gamma, "anisotropy": anisotropy}
        return se.shade_scaled(*scene, invariant=0.4, **strengths)

    def traced(function):
        """Whose scene is an argument, too: what is closed over would be a constant, and folded."""
        compiled = jit_wide(function)
        return lambda **strengths: compiled(scene=(g, d, lights, stone), **strengths)

    def describe(sigma=2.0, creases=False):
        return se.describe(g, sigma=sigma, creases=creases).hessian

    def render(enhancement):
        return se.render(mesh, camera, lights, stone, enhancement, sigma=2.0, **SIZE)

    normal = jnp.where(g.mask[..., None], g.normal, jnp.asarray([0.0, 0.0, 1.0]))
    full = se.GBuffer(jnp.ones_like(g.mask), g.depth, normal, g.position)
    some = lights.radiance.at[::2].set(0)
    general_tint, general_warp, general_scale = map(traced, (tint, warp, scale))
    general_describe = jax.jit(lambda g, sigma: se.describe(g, sigma=sigma).hessian)
    plain_describe = jax.jit(lambda g: se.describe(g, sigma=0.0).hessian)
    return {
        "no warp (alpha = 0)": (lambda: general_warp(alpha=0.0), lambda: warp(0.0)),
        "no scaling (gamma = 0)": (lambda: general_scale(gamma=0.0), lambda: scale(0.0)),
        "no anisotropy": (lambda: general_scale(anisotropy=0.0), scale),
        "no colour in R_s": (lambda: general_tint(specular=stone.specular), shade),
        "no specular lobe": (shade, lambda: shade(material=se.Material(stone.diffuse))),
        "every other light dark": (lambda: shade(radiance=jnp.maximum(some, 1e-30)), lambda: shade(radiance=some)),
        "lights behind the object": (shade, lambda: shade(radiance=jnp.where(behind, lights.radiance, 0))),
        "background": (lambda: shade(gbuffer=full), shade),
        "no diffusion (sigma = 0)": (lambda: general_describe(g, 0.0), lambda: plain_describe(g)),
        "no creases": (lambda: describe(creases=True), describe),
        "fields but the Hessian": (
            lambda: jax.block_until_ready(se.describe(g, sigma=2.0)).hessian,
            lambda: se.describe(g, sigma=2.0, fields=("hessian",)).hessian,
        ),
        "no enhancement, so no descriptor": (lambda: render(se.LightWarp(1e-30)), lambda: render(None)),
    }


# What is skipped was visible.
OTHER_PICTURES = ("no specular lobe", "lights behind the object", "background", "no creases")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=9)
    repeats = parser.parse_args().repeats
    rows = []
    for name, (general, skipping) in pairs().items():
        times = harness.measure({"general": general, "skipping": skipping}, repeats=repeats)
        pictures = [np.asarray(call(), np.float64) for call in (general, skipping)]
        slow, fast = times["general"]["median_ms"], times["skipping"]["median_ms"]
        same = name not in OTHER_PICTURES
        difference = float(np.abs(pictures[1] - pictures[0]).max() / np.abs(pictures[0]).max()) if same else None
        rows.append(
            {"skipped": name, "general_ms": slow, "skipping_ms": fast, "saved": round(1 - fast / slow, 2)}
            | {"difference": difference}
        )
    print(harness.table(rows))
    same = max(row["difference"] for row in rows if row["difference"] is not None)
    most = max(rows, key=lambda row: row["saved"])
    said = (
        f"Skipping saves up to {100 * most['saved']:.0f} % ({most['skipped']}); where the picture is to stay the same, "
        f"it differs by {same:.1e} of its brightest pixel at most."
    )
    print(harness.write("skipping", rows, answer=said))
    print(said)


if __name__ == "__main__":
    main()
