"""Error of N lights against 65,536, by sampling strategy: `python -m benchmarks.sampling`.

A ball under the embedded maps (and those of the folder SHAPEENH_DATA), matt and glossy, plain and warped; the map
turned to four azimuths, because a single one flatters whichever strategy puts a light in the right place. The error is
the root mean square of the difference over the root mean square of the reference.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness
from benchmarks import light as sums

COUNTS = (16, 32, 54, 128, 256, 512, 1024)
METHODS = ("uniform", "importance", "median_cut")
REFERENCE = 4096 if harness.QUICK else 65_536
TURNS = np.arange(1 if harness.QUICK else 4) * np.pi / 2 + 0.3
SIZE = 64


def ball():
    """A small ball with waves; its Hessian is random, of the size that a warp of 30 px shows."""
    row, column = np.mgrid[:SIZE, :SIZE]
    x, y = (column + 0.5) / (SIZE / 2) - 1, 1 - (row + 0.5) / (SIZE / 2)
    mask = x * x + y * y < 1
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 1e-4))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    hessian = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)) * 0.02
    normal, hessian, plane = (jnp.asarray(a, jnp.float32) for a in (normal, hessian, np.ones((SIZE, SIZE))))
    return se.GBuffer(jnp.asarray(mask), plane, normal, normal), se.Descriptor(hessian, normal[..., :2], *[plane] * 3)


def main() -> None:
    gbuffer, descriptor = ball()
    looks = {
        "matt": (se.Material(0.7, 0.02, 10.0), 0.0),
        "glossy": (se.Material(0.3, 0.3, 100.0), 0.0),
        "matt, warped": (se.Material(0.7, 0.02, 10.0), 30.0),
        "glossy, warped": (se.Material(0.3, 0.3, 100.0), 30.0),
    }
    rows = []
    for name, radiance in harness.maps().items():
        errors = {(look, method, n): [] for look in looks for method in METHODS for n in COUNTS}
        for turn in TURNS:
            world = se.sample_environment(radiance, REFERENCE, rotation=turn, method="median_cut")
            images = {look: se.shade_warped(gbuffer, descriptor, world, m, alpha=a) for look, (m, a) in looks.items()}
            for method in METHODS:
                for n in COUNTS:
                    few = se.sample_environment(radiance, n, rotation=turn, method=method)
                    for look, (m, a) in looks.items():
                        got = se.shade_warped(gbuffer, descriptor, few, m, alpha=a)
                        error = jnp.sqrt(jnp.mean((got - images[look]) ** 2) / jnp.mean(images[look] ** 2))
                        errors[look, method, n].append(float(error))
        for look in looks:
            for method in METHODS:
                found = {f"N={n}": round(float(np.mean(errors[look, method, n])), 4) for n in COUNTS}
                rows.append({"map": name, "look": look, "method": method, **found})
    print(harness.table(rows))
    means = {}
    for method in METHODS:
        of = [r for r in rows if r["method"] == method]
        means[method] = {n: round(float(np.exp(np.mean([np.log(r[f"N={n}"]) for r in of]))), 4) for n in COUNTS}
    print("geometric mean over all:", means)
    times = milliseconds()
    said = conclude(means, times)
    print(harness.write("sampling", rows, reference=REFERENCE, mean=means, milliseconds=times, answer=said))
    print(said)


def milliseconds() -> dict:
    """By method and number of lights, the median of warped shading of a large ball."""
    scene, material = sums.ball(sums.COVERED), sums.material()
    ms = {}
    for method in METHODS:
        lights = {n: se.sample_environment(se.procedural_studio(), n, method=method) for n in COUNTS}
        shade = {n: lambda l=l: se.shade_warped(*scene, l, material, alpha=30.0) for n, l in lights.items()}
        ms[method] = {n: times["median_ms"] for n, times in harness.measure(shade, repeats=5).items()}
    return ms


def conclude(means, ms) -> str:
    """The plot, and the sentence."""
    series = {m: [(str(n), ms[m][n], means[m][n]) for n in COUNTS] for m in METHODS}
    harness.pareto("sampling", series, default="median_cut 54", title="Lights", error="relative rms error")
    default, fewer = means["median_cut"][54], means["median_cut"][16]
    return (
        f"Default: median cut, 54 lights, error {default:.3f}; importance {means['importance'][54]:.3f}, uniform "
        f"{means['uniform'][54]:.3f}. With 16 lights shading takes {ms['median_cut'][16] / ms['median_cut'][54]:.2f} "
        f"of the time and the error is {fewer:.3f}."
    )


if __name__ == "__main__":
    main()
