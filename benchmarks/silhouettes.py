"""Silhouettes counted on analytic scenes: false and missed ones of the plain Sobel filter on log depth, and of ours.

    python -m benchmarks.silhouettes [--quick]

Sobel filters need a threshold: three are shown. Per scene, the pixels that a filter marks without a step beside them
(false: within one pixel of a step nothing counts as false for Sobel, which marks both sides), and the pixels on the far
side of a step that nothing within one pixel marks (missed).
"""

from __future__ import annotations

import sys

import jax.numpy as jnp
import numpy as np
from tests.reference import silhouettes as scenes

import shapeenh as se
from benchmarks.harness import table, write

SOBEL = (0.003, 0.01, 0.03)
SIZE = (150, 200)


def cases(quick: bool) -> dict:
    """name -> scenes that are counted together."""
    fovs, factors = ((0, 45), (1.0,)) if quick else ((0, 10, 45, 90), (1e-3, 1.0, 1e4))

    def family(make, slopes):
        return [scenes.scaled(make(slope, fov), f) for slope in slopes for fov in fovs for f in factors]

    def steps(size):
        return family(lambda slope, fov: scenes.planes(*SIZE, slope, size, fov), (0.0, 0.5, -0.5))

    out = {
        "planes of slope 0 to 1.5": family(
            lambda slope, fov: scenes.planes(*SIZE, slope, 0, fov), (0.0, 0.5, -0.5) if quick else (0.0, 0.5, 1.0, -0.6)
        ),
        "spheres": family(lambda _, fov: scenes.ball(*SIZE, fov), (0,)),
        "waves of slope 1 to 6": [scenes.scaled(scenes.wavy(*SIZE, s), f) for s in (1.0, 3.0, 6.0) for f in factors],
        "sphere before sphere": [scenes.scaled(scenes.balls(*SIZE, fov), f) for fov in fovs if fov for f in factors],
    }
    for size in (1.0, 2.0, 10.0) if quick else (0.5, 1.0, 2.0, 4.0, 10.0, 100.0):
        out[f"steps of {size:g} px"] = steps(size)
    for relative in (1e-3, 3e-3, 1e-2, 1e-1):
        size = relative / scenes.pitch(SIZE[0], 45)
        out[f"steps of {relative:g} of the distance ({size:.2g} px)"] = [
            scenes.planes(*SIZE, slope, size, 45) for slope in (0.0, 0.5, -0.5)
        ]
    return out


def near(marks):
    """Marks and their eight neighbours."""
    wide = np.pad(marks, 1)
    return np.any([wide[r : r + marks.shape[0], c : c + marks.shape[1]] for r, c in np.ndindex(3, 3)], axis=0)


def ours(fields):
    floats = {k: jnp.asarray(v, jnp.float32) for k, v in fields.items() if k != "mask"}
    gbuffer = se.GBuffer(mask=jnp.asarray(fields["mask"]), **floats)
    return np.asarray(se.describe(gbuffer).silhouette) > 0.5


def main(quick: bool) -> None:
    filters = {f"Sobel > {t:g}": (lambda fields, t=t: scenes.sobel_of_log_depth(fields) > t) for t in SOBEL}
    filters["ours"] = ours
    rows = []
    for name, family in cases(quick).items():
        row: dict = {"scenes": f"{name}, {len(family)}", "far pixels": sum(int(far.sum()) for _, far in family)}
        for label, marked in filters.items():
            marks = [marked(fields) for fields, _ in family]
            pairs = list(zip(marks, family, strict=True))
            false = sum(int((m & ~(near(far) if label != "ours" else far)).sum()) for m, (_, far) in pairs)
            missed = sum(int((far & ~(near(m) if label != "ours" else m)).sum()) for m, (_, far) in pairs)
            row[label] = f"{false} / {missed}"
        rows.append(row)
    print(table(rows))
    write("silhouettes", rows, unit="false / missed pixels")


if __name__ == "__main__":
    main("--quick" in sys.argv)
