"""Diffuse environment light, prefiltered and sampled, error and time: `python -m benchmarks.diffuse`.

Nine spherical harmonics, cosine-convolved maps of several heights, and sums over lights sampled by median cut, at
480,000 normals. The error is relative to the irradiance summed over every pixel of the map, root mean square (relative
to the mean irradiance) and largest. Lights: Lambert's sum has the error, `shade` of a matt material the time.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness
from shapeenh.scene.environment import map_directions, map_solid_angles

HEIGHTS, COUNTS = (8, 16, 32, 64), (16, 54, 256, 1024)


def exact(radiance, normal):
    """Float64: integral L <n.l> dl / pi by every pixel."""
    height, width = radiance.shape[:2]
    direction = np.asarray(map_directions(height=height, width=width), np.float64).reshape(-1, 3)
    weight = np.asarray(radiance, np.float64) * np.asarray(map_solid_angles(height=height, width=width))[..., None]
    return np.stack([np.maximum(direction @ n, 0) @ weight.reshape(-1, 3) for n in normal]) / np.pi


def pixels(normal) -> se.GBuffer:
    """A G-buffer of these normals, [H, W, 3], n_z > 0."""
    one = jnp.ones(normal.shape[:2], jnp.float32)
    return se.GBuffer(one > 0, one, normal, normal)


def lambert(lights, normal):
    """Float64: the sum over lights of L max(n.l, 0) / pi."""
    direction, radiance = (np.asarray(a, np.float64) for a in (lights.direction, lights.radiance))
    return np.maximum(np.asarray(normal, np.float64) @ direction.T, 0) @ radiance / np.pi


def main() -> None:
    rng = np.random.default_rng(0)

    def normals(*shape):
        n = rng.normal(size=(*shape, 3))
        n[..., 2] = np.abs(n[..., 2]) + 0.02
        return n / np.linalg.norm(n, axis=-1, keepdims=True)

    few, many = normals(1, 300), jnp.asarray(normals(600, 800), jnp.float32)
    harmonic, lookup = jax.jit(se.harmonic_radiance), jax.jit(se.environment_radiance)
    white = se.Material(jnp.ones(3))
    rows = []
    for name, radiance in harness.maps().items():
        reference = exact(radiance, few[0])
        ways = {"harmonics, 9": (partial(se.spherical_harmonics, radiance), harmonic)}
        ways |= {f"map, {h} rows": (partial(se.prefilter_map, radiance, height=h), lookup) for h in HEIGHTS}
        ways |= {
            f"lights, {n}": (
                partial(se.sample_environment, radiance, n),
                lambda lights, n: se.shade(pixels(n), lights, white),
            )
            for n in COUNTS
        }
        once = harness.measure({k: make for k, (make, _) in ways.items()}, repeats=5, seconds=10)
        tables = {k: make() for k, (make, _) in ways.items()}
        times = harness.measure({k: partial(function, tables[k], many) for k, (_, function) in ways.items()})
        for kind, (_, function) in ways.items():
            found = (lambert if kind.startswith("lights") else function)(tables[kind], jnp.asarray(few, jnp.float32))
            error = np.abs(np.asarray(found)[0] - reference)
            rms = float(np.sqrt(np.mean(error**2)) / np.mean(reference))
            largest = float(np.max(error / reference))
            row = {"map": name, "kind": kind, "rms": round(rms, 5), "largest": round(largest, 4)}
            rows.append(row | {"lookup_ms": times[kind]["median_ms"], "once_ms": once[kind]["median_ms"]})
    print(harness.table(rows))
    kinds: dict[str, list] = {r["kind"]: [] for r in rows}
    for r in rows:
        kinds[r["kind"]].append((r["lookup_ms"], r["rms"]))
    mean = {kind: np.exp(np.mean(np.log(found), axis=0)) for kind, found in kinds.items()}
    series: dict[str, list] = {}
    for kind, values in mean.items():
        which, size = kind.removesuffix(" rows").split(", ")
        series.setdefault(which, []).append((size, *values))
    harness.pareto("diffuse", series, default="map 32", title="Diffuse light of a map", error="relative rms error")
    default, nine, lights = (mean[k] for k in ("map, 32 rows", "harmonics, 9", "lights, 54"))
    wait = {k: np.median([r["once_ms"] for r in rows if r["kind"] == f"map, {k} rows"]) for k in (32, 64)}
    finer = mean["map, 64 rows"]
    said = (
        f"Default: a cosine-convolved map of 32 rows, error {default[1]:.4f}. Nine harmonics take "
        f"{nine[0] / default[0]:.2f} of its time: {nine[1]:.4f}; 54 sampled lights, which can be warped and reflect "
        f"highlights too, {lights[0] / default[0]:.1f} times its time: {lights[1]:.4f}. 64 rows are looked up as fast "
        f"and are {default[1] / finer[1]:.0f} times as exact, for {wait[64]:.0f} ms per map in place of {wait[32]:.0f}."
    )
    print(harness.write("diffuse", rows, answer=said))
    print(said)


if __name__ == "__main__":
    main()
