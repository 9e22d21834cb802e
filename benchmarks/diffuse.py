"""Diffuse environment light two ways, error and time: `python -m benchmarks.diffuse`.

Nine spherical harmonics against a cosine-convolved map of several heights, looked up at 480,000 normals. The error is
relative to the irradiance summed over every pixel of the map, root mean square and largest.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness
from shapeenh.scene.environment import map_directions, map_solid_angles


def exact(radiance, normal):
    """Float64: integral L <n.l> dl / pi by every pixel."""
    height, width = radiance.shape[:2]
    direction = np.asarray(map_directions(height=height, width=width), np.float64).reshape(-1, 3)
    weight = np.asarray(radiance, np.float64) * np.asarray(map_solid_angles(height=height, width=width))[..., None]
    return np.stack([np.maximum(direction @ n, 0) @ weight.reshape(-1, 3) for n in normal]) / np.pi


def main() -> None:
    rng = np.random.default_rng(0)
    few = rng.normal(size=(300, 3))
    few /= np.linalg.norm(few, axis=-1, keepdims=True)
    many = rng.normal(size=(600, 800, 3))
    many = jnp.asarray(many / np.linalg.norm(many, axis=-1, keepdims=True), jnp.float32)
    maps = {"studio": se.procedural_studio(), "sky": se.procedural_sky()}
    for name in ("studio", "venice"):
        path = harness.data(f"{name}.exr")
        if path:
            maps[f"{name}.exr"] = jnp.maximum(se.load_environment(path), 0)
    rows = []
    for name, radiance in maps.items():
        reference = exact(radiance, few)
        harmonic = jax.jit(se.harmonic_radiance)
        lookup = jax.jit(se.environment_radiance)
        tables = {"harmonics": (se.spherical_harmonics(radiance), harmonic)}
        tables |= {f"map, {h} rows": (se.prefilter_map(radiance, height=h), lookup) for h in (8, 16, 32, 64)}
        times = harness.measure({k: lambda t=t, f=f: f(t, many) for k, (t, f) in tables.items()})
        for kind, (table, function) in tables.items():
            error = np.abs(np.asarray(function(table, jnp.asarray(few, jnp.float32))) / reference - 1)
            rows.append(
                {"map": name, "kind": kind, "rms": round(float(np.sqrt(np.mean(error**2))), 5)}
                | {"largest": round(float(error.max()), 4), "lookup_ms": times[kind]["median_ms"]}
            )
    print(harness.table(rows))
    kinds = {r["kind"]: [] for r in rows}
    for r in rows:
        kinds[r["kind"]].append((r["lookup_ms"], r["rms"]))
    mean = {kind: np.exp(np.mean(np.log(found), axis=0)) for kind, found in kinds.items()}
    series = {
        "harmonics": [("9", *mean["harmonics"])],
        "map": [(kind.split()[1], *values) for kind, values in mean.items() if kind != "harmonics"],
    }
    harness.pareto("diffuse", series, default="map 32", title="Prefiltered diffuse light", error="relative rms error")
    said = (
        f"Default: a cosine-convolved map of 32 rows, error {mean['map, 32 rows'][1]:.4f}. Nine harmonics take "
        f"{mean['harmonics'][0] / mean['map, 32 rows'][0]:.2f} of its time: {mean['harmonics'][1]:.4f}."
    )
    print(harness.write("diffuse", rows, answer=said))
    print(said)


if __name__ == "__main__":
    main()
