"""Derivative stencils, time against error: `python -m benchmarks.stencils`.

The Hessian of z = 8 sin(2 pi x / 64) sin(2 pi y / 64) px from its exact slopes, inside a disc whose outside is not to
be read. Errors are relative to the largest curvature, root mean square, more than three pixels inside the outline and
within three pixels of it, at 320 x 240; times are of two planes at 800 x 600. The others read what lies off the mask
(0 there), as stencils on images do; "masked" is the package's.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from shapeenh import stencils

WAVE, HEIGHT_PX = 64.0, 8.0
CENTRAL = {1: 1 / 2}
FIFTH = {1: 2 / 3, 2: -1 / 12}  # fourth order on five points
SMOOTHED = {"central": (CENTRAL, (1.0,)), "five points": (FIFTH, (1.0,)), "Sobel": (CENTRAL, (0.25, 0.5, 0.25)),
            "Scharr": (CENTRAL, (3 / 16, 10 / 16, 3 / 16))}  # fmt: skip


def waves(height: int, width: int):
    """(slopes [2, H, W], Hessian [H, W, 3], mask), y up."""
    row, column = np.mgrid[:height, :width]
    x, y = (column - width / 2 + 0.5), (height / 2 - row - 0.5)
    k = 2 * np.pi / WAVE
    sx, cx, sy, cy = np.sin(k * x), np.cos(k * x), np.sin(k * y), np.cos(k * y)
    slopes = HEIGHT_PX * k * np.stack([cx * sy, sx * cy])
    hessian = HEIGHT_PX * k * k * np.stack([-sx * sy, cx * cy, -sx * sy], axis=-1)
    return slopes, hessian, np.hypot(x, y) < 0.45 * height


def separable(first: dict, smooth: tuple):
    """A derivative by plain slices: differences along one axis, weights along the other."""

    def along(planes, axis, sign):
        at = lambda k, axis: jnp.roll(planes, -k, axis)  # noqa: E731
        d = sum(w * (at(k, axis) - at(-k, axis)) for k, w in first.items())
        other, half = -1 if axis == -2 else -2, len(smooth) // 2
        return sign * sum(w * jnp.roll(d, i - half, other) for i, w in enumerate(smooth))

    return jax.jit(lambda planes, mask: (along(planes * mask, -1, 1), along(planes * mask, -2, -1)))


@jax.jit
def masked(planes, mask):
    link_x, link_y = stencils.links(mask.astype(planes.dtype))
    return stencils.derivatives(planes, link_x, link_y, jnp.sum(mask) >= 0)


def main() -> None:
    schemes = {name: separable(*how) for name, how in SMOOTHED.items()} | {"masked": masked}
    slopes, hessian, mask = waves(240, 320)
    rim = mask & ~np.all([np.roll(mask, (a, b), (0, 1)) for a in (-3, 0, 3) for b in (-3, 0, 3)], axis=0)
    large, _, large_mask = (jnp.asarray(a, jnp.float32) if a.dtype != bool else jnp.asarray(a) for a in waves(600, 800))
    times = harness.measure({name: lambda f=f: f(large, large_mask) for name, f in schemes.items()}, repeats=25)
    rows = []
    for name, scheme in schemes.items():
        d_x, d_y = (np.asarray(a, np.float64) for a in scheme(jnp.asarray(slopes, jnp.float32), jnp.asarray(mask)))
        found = np.stack([d_x[0], 0.5 * (d_x[1] + d_y[0]), d_y[1]], axis=-1)
        error = np.linalg.norm(found - hessian, axis=-1) / np.abs(hessian).max()
        rms = lambda where, e=error: round(float(np.sqrt(np.mean(e[where] ** 2))), 5)  # noqa: E731
        rows.append({"stencil": name, "inside": rms(mask & ~rim), "outline": rms(rim), "all": rms(mask)} | times[name])
    print(harness.table(rows))
    by = {r["stencil"]: r for r in rows}
    ratio = by["central"]["median_ms"] / by["masked"]["median_ms"]
    said = (
        f"Default: masked, {by['masked']['inside']:.4f} inside and {by['masked']['outline']:.4f} at the outline. Plain "
        f"central differences take {ratio:.2f} of its time and miss the outline by {by['central']['outline']:.1f} "
        "times the largest curvature."
    )
    series = {r["stencil"]: [("", r["median_ms"], r["all"])] for r in rows}
    harness.pareto("stencils", series, default="masked ", title="Derivative stencils", error="rms error, with outline")
    print(harness.write("stencils", rows, answer=said))
    print(said)


if __name__ == "__main__":
    main()
