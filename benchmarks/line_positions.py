"""Where lines lie on real meshes: `python -m benchmarks.line_positions [MESH ...]`.

Shares, over two views and two scales: of strong ridge pixels that are convex and of strong valley pixels that are
concave (mean curvature of the descriptor; a skeleton pixel is one within half a pixel of its line), of points of
occlusion lines (sub-pixel) within half a pixel and a pixel of a step of depth, of steps with a line within a pixel,
and of the ink of wide brushes that spills from one surface onto another, with and without ending footprints at
silhouettes. A step is where neighbouring pixels lie more than a pixel of depth off each other's tangent planes.
Without arguments: the bunny and the armadillo of the folder SHAPEENH_DATA, and the embedded knot.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from tests.reference.lines import distance_to_borders, line_points, step_borders

import shapeenh as se
from benchmarks import harness

DIRECTIONS = ((0.34, 0.26, 0.90), (-1.0, 0.2, 0.4))


def skeleton(profile):
    return np.asarray(profile.valid) & (np.abs(profile.distance) <= 0.5)


def curved(kind: str, gbuffer, descriptor) -> tuple[int, int]:
    """(strong skeleton pixels, those of them on their side of flat)."""
    strong = float(se.style_brush("ink", kind, height=gbuffer.mask.shape[0]).high)
    on = skeleton(se.fit_profile(se.line_field(kind, gbuffer, descriptor), least=strong))
    sign = -1 if kind == "ridge" else 1
    return int(on.sum()), int((sign * np.asarray(se.mean_curvature(descriptor.hessian))[on] > 0).sum())


def occluding(gbuffer, descriptor, camera) -> dict:
    """How far the points of occlusion lines are from steps of depth of more than a pixel, and those of more than five
    from the lines."""
    field = se.line_field("occlusion", gbuffer, descriptor)
    least = float(se.style_brush("ink", "occlusion").low)
    profile = se.fit_profile(field, radius=se.fit_radius("occlusion"), least=least)
    points = line_points(profile, field)
    off = distance_to_borders(points, step_borders(gbuffer, camera, 1.0))
    missed = KDTree(points).query(step_borders(gbuffer, camera, 5.0).mean(axis=1))[0]
    return {
        "occlusion px": len(points),
        "within 0.5 px": float(np.mean(off <= 0.5)),
        "within 1 px": float(np.mean(off <= 1)),
        "farthest": float(off.max()),
        "steps drawn": float(np.mean(missed <= 1)),
    }


def spilled(gbuffer, descriptor) -> tuple[float, float]:
    """Ink off the mask as a share of all ink of valleys drawn with a brush of 6 px: (ending at silhouettes, not)."""
    field = se.line_field("valley", gbuffer, descriptor)
    brush = se.Brush(radius=6.0, low=0.03, high=0.1)
    profile = se.fit_profile(field, least=0.03)
    held = np.asarray(se.draw_lines(profile, field, brush, gbuffer=gbuffer, descriptor=descriptor))[..., 3]
    free = np.asarray(se.draw_lines(profile, field, brush))[..., 3]
    off = ~np.asarray(gbuffer.mask)
    return float(held[off].sum() / held.sum()), float(free[off].sum() / free.sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--height", type=int, default=600)
    arguments = parser.parse_args()
    meshes = harness.meshes(arguments.meshes) | {"knot": se.carved_knot()}
    rows = []
    for name, mesh in meshes.items():
        for direction in DIRECTIONS:
            camera = se.frame_mesh(mesh, direction=direction, aspect=4 / 3)
            gbuffer = se.render_gbuffer(mesh, camera, height=arguments.height, width=arguments.height * 4 // 3)
            for sigma in (0.0, 2.0):
                descriptor = se.describe(gbuffer, sigma=sigma * arguments.height / 600)
                row = {"mesh": name, "view": direction[0], "sigma": sigma}
                for kind in ("ridge", "valley"):
                    total, right = curved(kind, gbuffer, descriptor)
                    row |= {f"{kind} px": total, f"{kind} right": right / max(total, 1)}
                row |= occluding(gbuffer, descriptor, camera)
                row["spilled"], row["spilled, TH10"] = spilled(gbuffer, descriptor)
                rows.append(row)
    print(harness.table(rows))
    least = {what: 100 * min(row[f"{what} right"] for row in rows) for what in ("ridge", "valley")}
    least |= {what: 100 * min(row[what] for row in rows) for what in ("within 1 px", "steps drawn")}
    said = (
        f"In every scene at least {least['ridge']:.1f} % of the pixels of strong ridges are convex, and "
        f"{least['valley']:.1f} % of those of strong valleys concave; {least['within 1 px']:.2f} % of the points of "
        f"occlusion lines lie within a pixel of a step of depth, and {least['steps drawn']:.1f} % of steps have one."
    )
    print(harness.write("line_positions", rows, height=arguments.height, answer=said))
    print(said)


if __name__ == "__main__":
    main()
