"""Visibility, barycentrics, G-buffer, gradients and multisampling, beside the peers that are installed.

    python -m benchmarks.raster [MESH ...] [--sizes 800x600 ...] [--subdivide 0 1 ...] [--zoom 1 3] [--cores 2 1]
                                [--prototype FOLDER] [--all] [--add]

Without MESH: the embedded object, or bunny.obj (with --all armadillo.obj too) where SHAPEENH_DATA names a folder that
has them. By default each mesh and its first subdivision, the latter at the first size only. `--all` takes subdivisions
up to 6 million triangles and sizes up to 3840x2160, and two hours or more; in pieces, `--add` keeps the rows of other
scenes in the results that are there.

All calls of a scene are timed in turns, so that a slow phase of the machine hits all alike; `first_ms` is compiling and
running. One process per number of cores: the second finds what the first compiled in a temporary cache, so its
`first_ms` says little. `zoom` looks closer, until the frame is covered. Memory is that of the compiled visibility
program, as XLA states it; `peak_MiB` is what the process has held at most so far, of which about 300 is JAX.

Rows of ours: `ids` (rasterize); `barycentrics + depth` (of given ids); `G-buffer` (ids, depth, position and normal in
camera space); `G-buffer, kept memory` (jitted, with the last one as a donated argument); `forward + backward` (the
G-buffer, a loss, and its gradient with respect to vertices, normals and camera); `G-buffer samples=2` (and whose
shading 2 x 2 samples borrow).

Peers: llvmpipe (`pip install moderngl`, and a Mesa with EGL), Mitsuba 3 (`mitsuba`, and an LLVM library), Open3D
(`open3d`, and libusb-1.0), DEODR (`deodr`). The ray casters are given their BVH. jaxrenderer 0.3.2 is not here: it
wants jax < 0.5 and NumPy 1, and cannot be installed beside this package.

What a G-buffer is. Ours: mask, depth, position and normal in camera space, float32, 29 bytes per pixel, in new arrays
at every call. llvmpipe's: 40 bytes per pixel, in the framebuffer of the frame before, and left there; `llvmpipe read`
is the same and 36 bytes of it read, into new arrays or, in the row `G-buffer, kept memory`, into those of the frame
before. Mitsuba's: 28 bytes per pixel. DEODR's: depth and normal in float64, 32 bytes. The system hands out new memory
page by page, which is a third of our time at 3840x2160. Like for like, arrays in the hands of the caller, are
therefore ours and `llvmpipe read`, in either row; `llvmpipe` alone tells what drawing takes.

`--prototype FOLDER` adds a `rasterizer.py` and a `resolve.py` with `raster_ids` and `gbuffer`.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

import shapeenh as se
from benchmarks.harness import RESULTS, data, machine, measure, table, write
from benchmarks.peers import raster as peers
from shapeenh.buffers.visibility import visible_triangles
from shapeenh.types import replace

LARGEST = 7_000_000  # triangles
OURS = "shapeenh"
SCENE = ("cores", "mesh", "triangles", "size", "covered")

# ------------------------------------------------------------------------------------------- scenes


def meshes(options):
    """(Name, mesh) of every input, also subdivided 4^level-fold; made one after the other, they are large."""
    names = ("bunny.obj", "armadillo.obj") if options.all else ("bunny.obj",)
    paths = options.mesh or [str(p) for p in map(data, names) if p]
    base = {Path(p).stem: se.load_mesh(p) for p in paths} or {"knot": se.carved_knot()}
    for name, mesh in base.items():
        solid = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
        for level in range(max(options.subdivide) + 1):
            if level in options.subdivide and len(solid.faces) <= LARGEST:
                yield name, se.make_mesh(solid.vertices, solid.faces)
            if level < max(options.subdivide):
                solid = solid.subdivide()


def look(mesh: se.Mesh, height: int, width: int, zoom: float) -> se.Camera:
    camera = se.frame_mesh(mesh, direction=(0.3, 0.2, 1), aspect=width / height)
    return replace(camera, projection=camera.projection * jnp.asarray([zoom, zoom, 1, 1])[:, None])


def our_calls(mesh: se.Mesh, camera: se.Camera, height: int, width: int) -> dict:
    size = {"height": height, "width": width}
    seen = se.rasterize(mesh, camera, **size)
    distance = -(mesh.vertices @ camera.view[2, :3] + camera.view[2, 3])[:, None]

    @jax.jit
    def step(vertices, normals, camera, faces):  # all are arguments: what is closed over would be a constant
        def loss(vertices, normals, camera):
            g = se.render_gbuffer(se.Mesh(vertices, faces, normals), camera, **size)
            return jnp.sum(g.normal[..., 2] * g.depth) + jnp.sum(g.position[..., 0])

        return jax.value_and_grad(loss, (0, 1, 2))(vertices, normals, camera)

    @functools.partial(jax.jit, donate_argnames="last", keep_unused=True)
    def over(mesh, camera, last):
        return se.render_gbuffer(mesh, camera, **size)

    last = [se.render_gbuffer(mesh, camera, **size)]

    def kept():
        last[0] = over(mesh, camera, last[0])
        return last[0]

    def sampled():
        g = se.render_gbuffer(mesh, camera, **size)
        return g, se.sample_coverage(mesh, camera, g, samples=2)

    def of_ids():
        return se.barycentrics(mesh, camera, seen), se.interpolate(distance, mesh, camera, seen)

    calls = {
        "ids": lambda: se.rasterize(mesh, camera, **size),
        "barycentrics + depth": of_ids,
        "G-buffer": lambda: se.render_gbuffer(mesh, camera, **size),
        peers.KEPT: kept,
        "forward + backward": lambda: step(mesh.vertices, mesh.normals, camera, mesh.faces),
        "G-buffer samples=2": sampled,
    }
    return {f"{row}: {OURS}": call for row, call in calls.items()}


# ------------------------------------------------------------------------------------------- memory


def program(vertices: int, faces: int, height: int, width: int) -> tuple[float, float]:
    """Bytes of temporaries and output of the visibility program, and the seconds that compiling it takes."""
    f32, i32 = jnp.float32, jnp.int32
    shapes = [((vertices, 3), f32), ((faces, 3), i32), ((4, 4), f32), ((4, 4), f32)]
    lowered = visible_triangles.lower(
        *(jax.ShapeDtypeStruct(*s) for s in shapes), height=height, width=width, cull="none"
    )
    start = time.perf_counter()
    compiled = lowered.compile()
    seconds = time.perf_counter() - start
    stats = compiled.memory_analysis()
    return stats.temp_size_in_bytes + stats.output_size_in_bytes, seconds


def slopes() -> dict:
    """What a face and a pixel more cost the visibility program."""
    faces, height, width = 1 << 20, 1024, 1024
    small, _ = program(faces // 2, faces, height, width)
    more_faces, _ = program(faces, 2 * faces, height, width)
    more_pixels, _ = program(faces // 2, faces, 2 * height, width)
    return {
        "bytes_per_triangle": round((more_faces - small) / faces, 1),
        "bytes_per_pixel": round((more_pixels - small) / (height * width), 1),
        "note": "temporaries and output of the visibility program, two triangles per vertex",
    }


def peak() -> float:
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


# ------------------------------------------------------------------------------------------- one process per core count


def worker(options) -> None:
    """Everything on one number of cores; rows as JSON into a file."""
    rows: list[dict] = []
    missing: dict[str, str] = {}
    least = 0
    for name, mesh in meshes(options):
        triangles = mesh.faces.shape[0]
        least = min(least, triangles) or triangles
        for size in options.sizes[: 1 if options.brief and triangles > least else None]:
            for zoom in options.zoom:
                width, height = map(int, size.split("x"))
                rows += scene_rows(options, name, mesh, height, width, zoom, missing)
    found = {"rows": rows, "missing": missing, "memory": slopes() if options.worker == max(options.cores) else {}}
    Path(options.file).write_text(json.dumps(found))


def scene_rows(options, name, mesh, height, width, zoom, missing) -> list[dict]:
    camera = look(mesh, height, width, zoom)
    triangles = int(mesh.faces.shape[0])
    held, seconds = program(mesh.vertices.shape[0], triangles, height, width)
    covered = float(jnp.mean(se.rasterize(mesh, camera, height=height, width=width).triangle >= 0))
    calls = our_calls(mesh, camera, height, width)
    if options.prototype:
        calls |= peers.prototype(Path(options.prototype), mesh, camera, height, width)
    others, absent = peers.calls(mesh, camera, height, width) if not options.no_peers else ({}, {})
    missing |= absent
    about = {"cores": options.worker, "mesh": name, "triangles": triangles, "size": f"{width}x{height}"}
    about |= {"covered": round(covered, 2)}
    rows = []
    for call, times in measure({**calls, **others}, repeats=options.repeats, seconds=options.seconds).items():
        row, who = call.split(": ")
        rows.append({**about, "call": row, "by": who, **times})
        if row == "ids" and who == OURS:
            rows[-1] |= {"compile_s": round(seconds, 2), "program_MiB": round(held / 2**20, 1), "peak_MiB": peak()}
    print(table(rows), flush=True)
    return rows


def run_workers(options) -> dict:
    found: dict = {"rows": [], "missing": {}, "memory": {}}
    with tempfile.TemporaryDirectory() as folder:
        for cores in options.cores:
            file = Path(folder) / f"{cores}.json"
            command = [sys.executable, "-m", "benchmarks.raster", *sys.argv[1:], "--worker", str(cores)]
            environment = os.environ | {
                "JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "cache"),
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            }
            subprocess.run([*command, "--file", str(file)], check=True, env=environment)
            part = json.loads(file.read_text())
            found["rows"] += part["rows"]
            found["missing"] |= part["missing"]
            found["memory"] |= part["memory"]
    return found


def add(found: dict, file: Path) -> dict:
    """What was found, and what the file has of other scenes, calls and peers, measured on the same machine."""
    keys = (*SCENE, "call", "by")
    there = json.loads(file.read_text()) if file.exists() else {}
    if there and there["machine"] != machine():
        print(f"nothing of {file.name} stays: it is from another machine or other versions")
        there = {}
    new = {tuple(row[k] for k in keys) for row in found["rows"]}
    kept = [row for row in there.get("rows", []) if tuple(row[k] for k in keys) not in new]
    return {
        "rows": sorted(kept + found["rows"], key=lambda row: (-row["cores"], row["mesh"], row["triangles"])),
        "missing": found["missing"],
        "memory": found["memory"] or there.get("memory", {}),
    }


# ------------------------------------------------------------------------------------------- what is told


def plot(rows: list[dict]) -> Path | None:
    """`results/raster.png`: milliseconds against triangles per peer, ids and G-buffer, at the size with most scenes."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print("no plot: matplotlib is missing (pip install shapeenh[bench])")
        return None
    scenes = Counter((r["size"], r["cores"]) for r in rows if r["call"] == "ids" and r["by"] == OURS)
    (size, cores), _ = scenes.most_common(1)[0]
    kinds = ("ids", "G-buffer")
    figure = Figure(figsize=(10, 4.5), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, kind in zip(panels, kinds, strict=True):
        chosen = [r for r in rows if (r["call"], r["size"], r["cores"]) == (kind, size, cores)]
        for who in dict.fromkeys(r["by"] for r in chosen):
            points = sorted((r["triangles"], r["median_ms"]) for r in chosen if r["by"] == who)
            axes.plot(*zip(*points, strict=True), "o-", label=who, linewidth=3 if who == OURS else 1)
        axes.set(xscale="log", yscale="log", xlabel="triangles", title=f"{kind}, {size}, {cores} cores")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    panels[0].set_ylabel("milliseconds")
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / "raster.png"
    figure.savefig(path, dpi=100)
    return path


def ratios(rows: list[dict]) -> list[dict]:
    """Per scene and call: a peer's time over ours, of the same run."""
    keys = (*SCENE, "call")
    ours = {tuple(r[k] for k in keys): r["median_ms"] for r in rows if r["by"] == OURS}
    out: dict[tuple, dict] = {}
    for r in rows:
        key = tuple(r[k] for k in keys)
        if r["by"] != OURS and key in ours:
            line = out.setdefault(key, dict(zip(keys, key, strict=True)) | {"ours_ms": ours[key]})
            line[f"{r['by']} / ours"] = round(r["median_ms"] / ours[key], 2)
    names = list(dict.fromkeys(k for line in out.values() for k in line))
    return [{k: line.get(k) for k in names} for line in out.values()]


def conclude(lines: list[dict]) -> str:
    """The default, and in how many scenes the G-buffer is ahead of each peer's."""
    default = (
        "Default: visibility in integers; there is no coarser, faster mode (`visibility` has its error and the peers')."
    )
    return " ".join([default, *filter(None, (conclusion(lines, call) for call in ("G-buffer", peers.KEPT)))])


def conclusion(lines: list[dict], call: str) -> str:
    scenes = [line for line in lines if line["call"] == call]
    said = [f"{call}: {min(t)} to {max(t)} ms" for t in [[line["ours_ms"] for line in scenes]] if t]
    for name in dict.fromkeys(k for line in scenes for k in line if k.endswith("/ ours")):
        found = [line[name] for line in scenes if line[name] is not None]
        if found:
            ahead = f"ahead in {sum(r > 1 for r in found)} of {len(found)} scenes"
            said.append(f"{name.removesuffix(' / ours')} {min(found)} to {max(found)} times as long, ours {ahead}")
    return "; ".join(said) + "." if said else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", nargs="*")
    parser.add_argument("--sizes", nargs="+")
    parser.add_argument("--subdivide", nargs="+", type=int)
    parser.add_argument("--zoom", nargs="+", type=float)
    parser.add_argument("--cores", nargs="+", type=int)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=6.0, help="at most, per scene")
    parser.add_argument("--prototype", metavar="FOLDER")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--add", action="store_true", help="to this machine's results that are there")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--file", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.brief = not (options.all or options.sizes or options.subdivide)
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    sizes = ["800x600", "1920x1080"]
    options.sizes = options.sizes or (["256x256", *sizes, "3840x2160"] if options.all else sizes)
    options.subdivide = options.subdivide or ([0, 1, 2, 3] if options.all else [0, 1])
    options.zoom = options.zoom or ([1.0, 3.0] if options.all else [1.0])
    options.cores = options.cores or ([2, 1] if available >= 2 else [1])
    if options.worker:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.worker])
        worker(options)
        return
    found = run_workers(options)
    if options.add:
        found = add(found, RESULTS / "raster.json")
    print(table(ratios(found["rows"])))
    for name, why in found["missing"].items():
        print(f"not here: {name} ({why})")
    print(found["memory"])
    print(plot(found["rows"]))
    said = conclude(ratios(found["rows"]))
    print(write("raster", found["rows"], memory=found["memory"], missing=found["missing"], answer=said))
    print(said)


if __name__ == "__main__":
    main()
