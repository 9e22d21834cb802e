"""The rasteriser beside its peers, time against error: `python -m benchmarks.visibility [MESH ...] [--sizes WxH ...]`.

Error: the share of the covered pixels that see another face than a brute force in float64, every face against every
pixel centre in its bounding box, without any rounding of coordinates. GPUs' way, and ours, is to round corners to
1/256 px first, so that neighbours meet without cracks; the second column takes the corners so rounded, in float64: what
is left of ours there are corners that float32 rounds the other way. Time: of the ids, as in `benchmarks.raster`, where
the peers are described. Without MESH: bunny.obj and armadillo.obj of the folder SHAPEENH_DATA where there is one, else
the embedded knot.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import shapeenh as se
from benchmarks import harness
from benchmarks.peers import raster as peers

OURS = "shapeenh"
SUB = 256


def brute_force(mesh: se.Mesh, camera: se.Camera, height: int, width: int, *, snap: bool):
    """[H, W] int32: the nearest face by float64, -1 for none. Every corner must lie in front of the near plane."""
    m = np.asarray(camera.projection, np.float64) @ np.asarray(camera.view, np.float64)
    clip = np.c_[np.asarray(mesh.vertices, np.float64), np.ones(len(mesh.vertices))] @ m.T
    x, y = (clip[:, 0] / clip[:, 3] + 1) * width / 2 - 0.5, (1 - clip[:, 1] / clip[:, 3]) * height / 2 - 0.5
    x, y = (np.rint(a * SUB) if snap else a * SUB for a in (x, y))
    faces = np.asarray(mesh.faces)
    x, y, z = x[faces], y[faces], (clip[:, 2] / clip[:, 3])[faces]
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    back = area < 0  # turned round, so that the inside is where all edge functions are positive
    for a in (x, y, z):
        a[back] = a[back][:, [0, 2, 1]]
    # All pixels of all bounding boxes, as (face, column, row).
    left, right = (np.clip(f(a(x, axis=1) / SUB), 0, width).astype(int) for f, a in BOX)
    top, bottom = (np.clip(f(a(y, axis=1) / SUB), 0, height).astype(int) for f, a in BOX)
    across, count = right - left, np.where(area != 0, np.maximum(right - left, 0) * np.maximum(bottom - top, 0), 0)
    face = np.repeat(np.arange(len(faces)), count)
    k = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    column, row = left[face] + k % across[face], top[face] + k // across[face]
    inside, depth = np.ones(len(face), bool), 0.0
    for a, b, corner in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        dx, dy = (x[:, b] - x[:, a])[face], (y[:, b] - y[:, a])[face]
        edge = dx * (row * SUB - y[face, a]) - dy * (column * SUB - x[face, a])
        keeps = (dy < 0) | ((dy == 0) & (dx > 0))  # left, or horizontal top
        inside &= (edge > 0) | (keeps & (edge == 0))
        depth = depth + edge * z[face, corner]
    depth = depth / np.abs(area)[face]
    face, pixel, depth = face[inside], (row * width + column)[inside], depth[inside]
    order = np.lexsort((face, depth, pixel))
    pixel, first = np.unique(pixel[order], return_index=True)
    out = np.full(height * width, -1, np.int32)
    out[pixel] = face[order][first]
    return out.reshape(height, width)


BOX = (np.ceil, np.min), (lambda a: np.floor(a) + 1, np.max)


def rows_of(name: str, mesh: se.Mesh, size: str, absent: dict[str, str]) -> list[dict]:
    """Ours and the peers that are here; `absent` gets the others, with the reason."""
    width, height = (int(n) for n in size.split("x"))
    camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=width / height)
    exact, snapped = (brute_force(mesh, camera, height, width, snap=snap) for snap in (False, True))
    calls = {OURS: lambda: se.rasterize(mesh, camera, height=height, width=width).triangle}
    others, missing = peers.calls(mesh, camera, height, width)
    calls |= {row.split(": ")[1]: call for row, call in others.items() if row.startswith("ids")}
    absent |= missing
    rows = []
    for who, times in harness.measure(calls).items():
        found = peers.read_ids(calls[who](), height, width)
        share = lambda wanted, found=found: float(np.sum(found != wanted) / np.sum(exact >= 0))  # noqa: E731
        about = {"mesh": name, "size": size, "covered": int(np.sum(exact >= 0)), "by": who}
        rows.append(about | {"wrong": share(exact), "wrong, corners rounded": share(snapped)} | times)
    return rows


def conclude(rows: list[dict]) -> str:
    ours = [r for r in rows if r["by"] == OURS]
    off, off_rounded = (100 * max(r[key] for r in ours) for key in ("wrong", "wrong, corners rounded"))
    said = (
        f"Default: ours. At {off:.2g} % of the pixels another face is seen than by exact geometry, because corners are "
        f"rounded to 1/{SUB} px; at {off_rounded:.2g} % another one than with corners so rounded, as they are made "
        "in float32."
    )
    for who in dict.fromkeys(r["by"] for r in rows if r["by"] != OURS):
        theirs = [r for r in rows if r["by"] == who]
        ratio = np.median([t["median_ms"] / o["median_ms"] for t, o in zip(theirs, ours, strict=True)])
        said += f" {who} takes {ratio:.2g} times as long; {100 * max(r['wrong'] for r in theirs):.2g} % are off."
    return said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--sizes", nargs="+", default=["400x300", "800x600", "1600x1200"])
    arguments = parser.parse_args()
    rows: list[dict] = []
    missing: dict[str, str] = {}
    for name, mesh in harness.meshes(arguments.meshes).items():
        for size in arguments.sizes:
            rows += rows_of(name, mesh, size, missing)
    print(harness.table(rows))
    for who, why in missing.items():
        print(f"not here: {who} ({why})")
    said = conclude(rows)
    series: dict[str, list] = {}
    first = rows[0]["mesh"]
    for r in rows:
        if r["mesh"] == first:
            series.setdefault(r["by"], []).append((r["size"], r["median_ms"], r["wrong"]))
    title, error = f"Visibility of {first}, beside peers", "share of pixels with another face than exact"
    default = f"{OURS} {arguments.sizes[min(1, len(arguments.sizes) - 1)]}"
    harness.pareto("visibility", series, default=default, title=title, error=error)
    print(harness.write("visibility", rows, missing=missing, answer=said))
    print(said)


if __name__ == "__main__":
    main()
