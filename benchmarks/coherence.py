"""Temporal coherence of lines: `python -m benchmarks.coherence [MESH] [--frames 12] [--height 400]`.

A slow turntable and a slow zoom, of the mesh and of the mesh with noise. Each picture of lines is warped to the next
frame by the exact motion of the surface (positions of the G-buffer, reprojected; pixels that were hidden do not count),
and compared with what is drawn there. Popping is the ink that appeared or vanished, as a fraction of all ink; `change`
counts all of it (a part of which is the bilinear warp of lines two pixels wide), `pops` what changed by more than half.
Beside our lines (TH10 7.2, 8.1) stand the pixels whose curvature exceeds a threshold (as much ink in the first frame),
hard and soft. Then the noisy mesh from farther and farther away (TH10 fig. 7.4), seen from all around: how many strokes
there are, how much of the ink is specks, how much of the clean mesh's ink is found where it was, and how much of the
noisy mesh's is where the clean mesh has some. Thresholds are set in every picture to make as much ink of the clean
mesh: a method that inks more finds more again.
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

import shapeenh as se
from benchmarks import harness

KINDS = ("valley", "ridge")
DIRECTION = np.array([0.34, 0.26, 0.90])
VIEWS = (0, 60, 120, 180, 240, 300)  # degrees; one view from afar has but a handful of strokes
STYLES = ("lines, ink", "lines, pencil", "thresholded curvature", "softly thresholded curvature")

# ------------------------------------------------------------------------------------------- motion


def turned(mesh, degrees: float, aspect: float, *, away: float = 1.0):
    """A camera that sees the whole mesh, turned around it, that many times as far away."""
    low, high = np.asarray(mesh.vertices.min(axis=0)), np.asarray(mesh.vertices.max(axis=0))
    centre, radius = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low)
    a, (x, y, z) = np.deg2rad(degrees), DIRECTION
    direction = np.array([np.cos(a) * x + np.sin(a) * z, y, np.cos(a) * z - np.sin(a) * x])
    eye = centre + 3.6 * radius * away * direction / np.linalg.norm(direction)
    return se.perspective_camera(eye, centre, fov_degrees=30.0, aspect=aspect)


def cameras(mesh, motion: str, frames: int, aspect: float) -> list:
    """A turntable of half a degree per frame, or a zoom of 1.5 % per frame."""
    if motion == "turntable":
        return [turned(mesh, 0.5 * k, aspect) for k in range(frames)]
    return [turned(mesh, 0.0, aspect, away=1.015**-k) for k in range(frames)]


@jax.jit
def warp(ink, before, after, camera_before, camera_after):
    """(ink of the frame before as seen in the frame after, where that is known)."""
    h, w = ink.shape
    view, back = camera_before.view, camera_after.view
    world = (after.position - back[:3, 3]) @ back[:3, :3]
    there = world @ view[:3, :3].T + view[:3, 3]
    clip = there @ camera_before.projection[:, :3].T + camera_before.projection[:, 3]
    places = [0.5 * (1 - clip[..., 1] / clip[..., 3]) * h - 0.5, 0.5 * (1 + clip[..., 0] / clip[..., 3]) * w - 0.5]
    read = lambda plane: jax.scipy.ndimage.map_coordinates(plane, places, order=1)  # noqa: E731
    same = jnp.abs(read(before.depth) + there[..., 2]) < 2e-3 * jnp.abs(there[..., 2])
    return read(ink), after.mask & (read(before.mask.astype(ink.dtype)) > 0.999) & same


# ------------------------------------------------------------------------------------------- what is compared


def curvatures(descriptor):
    k1, k2 = se.principal_curvatures(descriptor.hessian)
    return {"valley": k1, "ridge": -k2}


def ours(gbuffer, descriptor, camera, style: str):
    """Opacity [H, W] of valleys and ridges together."""
    height = gbuffer.mask.shape[0]
    clear = jnp.ones(gbuffer.mask.shape)
    noise = se.surface_noise(gbuffer, camera, size=3.0)
    for kind in KINDS:
        brush = se.style_brush(style, kind, height=height)
        field = se.line_field(kind, gbuffer, descriptor)
        profile = se.fit_profile(field, least=float(brush.low))
        strokes = se.draw_lines(profile, field, brush, noise=noise, gbuffer=gbuffer, descriptor=descriptor)
        clear = clear * (1 - strokes[..., 3])
    return 1 - clear


def thresholded(descriptor, levels, soft: float):
    """Where a curvature is above its threshold; softly, from (1 - soft) to (1 + soft) times it."""
    ink = jnp.zeros(descriptor.silhouette.shape)
    for kind, curvature in curvatures(descriptor).items():
        t = jnp.clip((curvature / levels[kind] - 1 + soft) / (2 * soft), 0, 1)
        ink = jnp.maximum(ink, t * t * (3 - 2 * t))
    return ink


def level_of_same_ink(gbuffer, descriptor, camera) -> dict:
    """Thresholds at which either kind covers as much as our ink lines of that kind."""
    mask = np.asarray(gbuffer.mask)
    share = float(np.mean(np.asarray(ours(gbuffer, descriptor, camera, "ink"))[mask])) / len(KINDS)
    return {k: float(np.quantile(np.asarray(c)[mask], 1 - share)) for k, c in curvatures(descriptor).items()}


def popping(mesh, motion: str, frames: int, height: int) -> dict[str, list[dict]]:
    """Per method and frame: ink that changed (mean), and that changed by more than half (pops), over the mean ink."""
    width = height * 4 // 3
    scale = height / 600
    rows: dict[str, list[dict]] = {name: [] for name in STYLES}
    last, levels = None, None
    for camera in cameras(mesh, motion, frames, width / height):
        gbuffer = se.render_gbuffer(mesh, camera, height=height, width=width)
        descriptor = se.describe(gbuffer, sigma=2.0 * scale)
        levels = levels or level_of_same_ink(gbuffer, descriptor, camera)
        inks = {
            "lines, ink": ours(gbuffer, descriptor, camera, "ink"),
            "lines, pencil": ours(gbuffer, descriptor, camera, "pencil"),
            "thresholded curvature": thresholded(descriptor, levels, 1e-3),
            "softly thresholded curvature": thresholded(descriptor, levels, 0.5),
        }
        if last is not None:
            for name, ink in inks.items():
                warped, known = warp(last[0][name], last[1], gbuffer, last[2], camera)
                known, change = np.asarray(known), np.abs(np.asarray(ink - warped))
                total = float(np.mean(np.asarray(ink)[known]))
                rows[name].append(
                    {
                        "change": float(np.mean(change[known])) / total,
                        "pops": float(np.mean(change[known] > 0.5)) / total,
                        "ink": total,
                        "known": float(known.mean()),
                    }
                )
        last = inks, gbuffer, camera
    return rows


# ------------------------------------------------------------------------------------------- noise on the mesh


def roughened(mesh, share: float = 0.001):
    """The mesh with its vertices moved along their normals at random, by this share of its size (one sigma)."""
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.normals)
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    moved = vertices + share * size * np.random.default_rng(0).normal(size=(len(vertices), 1)) * normals
    return se.make_mesh(np.float32(moved), np.asarray(mesh.faces))


def agglomeration(mesh, noisy, height: int) -> list[dict]:
    """From 1 to 8 times the distance, over views from all around: strokes, specks and agreement of the noisy mesh's
    lines, ours and thresholded at the level that makes as much ink of the clean mesh in the same picture."""
    width, rows = height * 4 // 3, []
    brush = se.style_brush("ink", "valley", height=600)
    for times in (1, 2, 4, 8):
        counts: dict[str, list[dict]] = {"lines, ink": [], "thresholded curvature": []}
        for degrees in VIEWS:
            inks, curved = [], []
            for m in (mesh, noisy):
                camera = turned(mesh, degrees, width / height, away=times)
                gbuffer = se.render_gbuffer(m, camera, height=height, width=width)
                descriptor = se.describe(gbuffer, sigma=2.0)
                field = se.line_field("valley", gbuffer, descriptor)
                profile = se.fit_profile(field, least=float(brush.low))
                strokes = se.draw_lines(profile, field, brush, gbuffer=gbuffer, descriptor=descriptor)
                inks.append(np.asarray(strokes[..., 3]) > 0.5)
                curved.append(np.where(gbuffer.mask, curvatures(descriptor)["valley"], -np.inf))
            level = np.sort(curved[0], axis=None)[-1 - int(inks[0].sum())]
            counts["lines, ink"].append(compared(*inks))
            counts["thresholded curvature"].append(compared(*(c > level for c in curved)))
        for name, found in counts.items():
            n = {key: sum(f[key] for f in found) for key in found[0]}
            row = {"distance": times, "method": name, "strokes": n["strokes"], "strokes, clean": n["strokes, clean"]}
            row["in specks"] = n["specks"] / max(n["ink"], 1)
            row["found again"] = n["found"] / max(n["clean"], 1)
            row["right"] = n["right"] / max(n["ink"], 1)
            rows.append(row | {"ink": n["ink"]})
    return rows


def compared(clean, rough) -> dict[str, int]:
    """Pixels and strokes of the noisy mesh's ink beside that of the clean one; a pixel off is the same place."""
    eight = np.ones((3, 3))
    labels, count = ndimage.label(rough, eight)
    area = np.bincount(labels.ravel())[1:]
    return {
        "strokes": int(count),
        "strokes, clean": int(ndimage.label(clean, eight)[1]),
        "ink": int(rough.sum()),
        "clean": int(clean.sum()),
        "specks": int(area[area < 12].sum()),
        "found": int((clean & ndimage.binary_dilation(rough, eight)).sum()),
        "right": int((rough & ndimage.binary_dilation(clean, eight)).sum()),
    }


def plot(results: dict, path) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print("no plot: matplotlib is missing (pip install shapeenh[bench])")
        return
    figure = Figure(figsize=(3.6 * len(results), 3.6), layout="constrained")
    for axes, (motion, rows) in zip(figure.subplots(1, len(results), sharey=True), results.items(), strict=True):
        for name, frames in rows.items():
            axes.plot(range(1, len(frames) + 1), [100 * f["change"] for f in frames], "o-", markersize=3, label=name)
        axes.set(title=motion, xlabel="frame", ylim=(0, None))
    figure.axes[0].set_ylabel("ink that changed, % of all ink")
    figure.axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--height", type=int, default=400)
    arguments = parser.parse_args()
    paths = [arguments.mesh] if arguments.mesh else []
    name, mesh = next(iter(harness.meshes(paths, ("armadillo",)).items()))
    noisy = roughened(mesh)
    results = {
        motion + suffix: popping(m, motion, arguments.frames, arguments.height)
        for m, suffix in ((mesh, ""), (noisy, ", noise"))
        for motion in ("turntable", "zoom")
    }
    rows = []
    for motion, methods in results.items():
        for method, frames in methods.items():
            found = {key: [f[key] for f in frames] for key in ("change", "pops", "ink", "known")}
            mean = {key: float(np.mean(numbers)) for key, numbers in found.items()}
            rows.append({"motion": motion, "method": method, **mean, "worst change": max(found["change"])})
    print(harness.table(rows))
    far = agglomeration(mesh, noisy, arguments.height)
    print(harness.table(far))
    facts = {"mesh": name, "frames": arguments.frames}
    least = [min((r for r in rows if r["motion"] == motion), key=lambda r: r["change"]) for motion in results]
    said = "Least ink changes from frame to frame: " + "; ".join(
        f"{r['motion']}, {r['method']} ({100 * r['change']:.0f} %)" for r in least
    )
    at = {r["method"]: 100 * r["found again"] for r in far if r["distance"] == 4}
    said += f". At 4 times the distance {at['lines, ink']:.0f} % of the lines are found again on the mesh with noise, "
    said += f"{at['thresholded curvature']:.0f} % of as much thresholded curvature."
    print(harness.write("coherence", rows, **facts, per_frame=results, distances=far, answer=said))
    plot(results, harness.RESULTS / "coherence.png")


if __name__ == "__main__":
    main()
