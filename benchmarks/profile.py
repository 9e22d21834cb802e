"""Samples and radius of a line's profile, time against error: `python -m benchmarks.profile`.

Ripples h = cos r / (1 + 0.2 r) about a point (TH10 fig. 7.2), whose skeletons are circles of known radius: the 99th
percentile of the error of the distance, over pixels up to 3 px from the first circle, at 512 x 512.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness

SIZE, UNIT, CENTRE = 512, 4.0, (0.3, -0.2)
RADII, SAMPLES = (2.0, 3.0, 4.0, 6.0, 8.0), (5, 9, 17, 33)
DEFAULT = (4.0, 9)


def ripples():
    """(field, distance to the skeleton nearest to the first crest, px)."""
    row, column = np.mgrid[:SIZE, :SIZE]
    x, y = column + 0.5 - SIZE / 2 - CENTRE[0], SIZE / 2 - row - 0.5 - CENTRE[1]
    r = np.hypot(x, y)
    crest = np.linspace(5, 7, 200001)
    crest = crest[np.argmax(np.cos(crest) / (1 + 0.2 * crest))] * UNIT
    height = np.cos(r / UNIT) / (1 + 0.2 * r / UNIT)
    direction = np.stack([x, y], axis=-1) / r[..., None]
    field = se.LineField(*(jnp.asarray(a, jnp.float32) for a in (height, direction, np.zeros_like(r))))
    return field, crest - r


def main() -> None:
    field, expected = ripples()
    near = np.abs(expected) <= 3
    calls = {
        (radius, samples): lambda r=radius, s=samples: se.fit_profile(field, radius=r, samples=s)
        for radius in RADII
        for samples in SAMPLES
        if samples > 2 * radius / 4
    }
    times = harness.measure(calls)
    rows = []
    for (radius, samples), call in calls.items():
        found = call()
        valid = np.asarray(found.valid) & near
        error = np.abs(np.asarray(found.distance) - expected)[valid]
        rows.append(
            {"radius": radius, "samples": samples, "found": round(float(valid.sum() / near.sum()), 4)}
            | {"error_px": round(float(np.percentile(error, 99)), 4) if error.size else None}
            | times[radius, samples]
        )
    print(harness.table(rows))
    usable = [r for r in rows if r["found"] > 0.95 and r["error_px"]]
    series: dict[str, list] = {}
    for r in usable:
        point = str(r["samples"]), r["median_ms"], r["error_px"]
        series.setdefault(f"radius {r['radius']:g} px", []).append(point)
    default = next(r for r in rows if (r["radius"], r["samples"]) == DEFAULT)
    fastest = min(usable, key=lambda r: r["median_ms"])
    ratio = fastest["median_ms"] / default["median_ms"]
    said = (
        f"Default: radius 4 px, 9 samples: {default['error_px']} px at the 99th percentile. Radius "
        f"{fastest['radius']:g} px with {fastest['samples']} samples takes {ratio:.2f} of the time: "
        f"{fastest['error_px']} px."
    )
    harness.pareto(
        "profile", series, default="radius 4 px 9", title="Profile: samples and radius", error="99 % of distances, px"
    )
    print(harness.write("profile", rows, answer=said))
    print(said)


if __name__ == "__main__":
    main()
