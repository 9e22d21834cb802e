"""Visibility, barycentrics, G-buffer, and forward + backward, beside the peers that are installed.

    python -m benchmarks.raster [MESH ...] [--sizes 800x600 1920x1080] [--subdivide 0 1 2] [--repeats 9]

Without MESH: the embedded default object, and bunny.obj and armadillo.obj where SHAPEENH_DATA names a folder that has
them. All calls of a scene are timed in turns, compile apart. Peers: Open3D (`pip install open3d`) and Mitsuba 3
(`pip install mitsuba`) answer which face each pixel sees from a BVH that is built beforehand and not timed. Memory: of
the compiled visibility program, temporaries and output, as XLA states them; `ids_compile_s` is its compile time.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

import shapeenh as se
from benchmarks.harness import data, measure, table, write
from shapeenh.buffers.visibility import visible_triangles


def meshes(paths: list[str], levels: list[int]) -> dict[str, se.Mesh]:
    """Name -> mesh; each also subdivided 4^level-fold."""
    paths = paths or [str(p) for p in map(data, ("bunny.obj", "armadillo.obj")) if p]
    base = {Path(p).stem: se.load_mesh(p) for p in paths} or {"knot": se.carved_knot()}
    found = {}
    for name, mesh in base.items():
        solid = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
        for level in range(max(levels) + 1):
            if level in levels:
                found[f"{name}/{len(solid.faces)}"] = se.make_mesh(solid.vertices, solid.faces)
            solid = solid.subdivide()
    return found


def peers(mesh: se.Mesh, camera: se.Camera, height: int, width: int) -> dict:
    """Calls that find the nearest face per pixel with other people's programs."""
    calls = {}
    inverse = np.linalg.inv(np.asarray(camera.projection, np.float64) @ np.asarray(camera.view, np.float64))
    x, y = np.meshgrid((np.arange(width) + 0.5) * 2 / width - 1, 1 - (np.arange(height) + 0.5) * 2 / height)
    ends = [np.stack([x, y, np.full_like(x, z), np.ones_like(x)], -1) @ inverse.T for z in (-1.0, 0.5)]
    start, end = (e[..., :3] / e[..., 3:] for e in ends)
    rays = np.concatenate([start, end - start], -1).astype(np.float32).reshape(-1, 6)
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)
    try:
        import open3d
    except ImportError:
        pass
    else:
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(faces.astype(np.uint32)))
        tensor = open3d.core.Tensor(rays)
        calls["ids: Open3D"] = lambda: scene.cast_rays(tensor)["primitive_ids"].numpy()
    try:
        import mitsuba
    except ImportError:
        pass
    else:
        mitsuba.set_variant("llvm_ad_rgb")
        solid = mitsuba.Mesh("solid", len(vertices), len(faces))
        parameters = mitsuba.traverse(solid)
        parameters["vertex_positions"], parameters["faces"] = vertices.ravel(), faces.ravel()
        parameters.update()
        world = mitsuba.load_dict({"type": "scene", "solid": solid})
        ray = mitsuba.Ray3f(mitsuba.Point3f(rays[:, :3].T), mitsuba.Vector3f(rays[:, 3:].T))
        calls["ids: Mitsuba 3"] = lambda: np.asarray(world.ray_intersect_preliminary(ray).prim_index)
    return calls


def scene_calls(mesh: se.Mesh, camera: se.Camera, height: int, width: int) -> dict:
    size = {"height": height, "width": width}
    seen = se.rasterize(mesh, camera, **size)

    @jax.jit
    def step(vertices, normals, camera):
        def loss(vertices, normals, camera):
            moved = se.Mesh(vertices, mesh.faces, normals)
            g = se.render_gbuffer(moved, camera, **size)
            return jnp.sum(g.normal[..., 2] * g.depth) + jnp.sum(g.position[..., 0])

        return jax.value_and_grad(loss, (0, 1, 2))(vertices, normals, camera)

    return {
        "ids": lambda: se.rasterize(mesh, camera, **size),
        "barycentrics": lambda: se.barycentrics(mesh, camera, seen),
        "G-buffer with ids": lambda: se.render_gbuffer(mesh, camera, **size),
        "forward + backward": lambda: step(mesh.vertices, mesh.normals, camera),
    }


def program(mesh: se.Mesh, camera: se.Camera, height: int, width: int) -> tuple[float, float]:
    """MiB of temporaries and output of the visibility program, and the seconds that compiling it takes."""
    arrays = (mesh.vertices, mesh.faces, camera.view, camera.projection)
    start = time.perf_counter()
    compiled = visible_triangles.lower(*arrays, height=height, width=width, cull="none").compile()
    seconds = time.perf_counter() - start
    stats = compiled.memory_analysis()
    return (stats.temp_size_in_bytes + stats.output_size_in_bytes) / 2**20, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", nargs="*")
    parser.add_argument("--sizes", nargs="+", default=["800x600", "1920x1080"])
    parser.add_argument("--subdivide", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    rows = []
    for name, mesh in meshes(options.mesh, options.subdivide).items():
        for size in options.sizes:
            width, height = map(int, size.split("x"))
            camera = se.frame_mesh(mesh, direction=(0.3, 0.2, 1), aspect=width / height)
            mib, seconds = program(mesh, camera, height, width)
            covered = float(jnp.mean(se.rasterize(mesh, camera, height=height, width=width).triangle >= 0))
            calls = {**scene_calls(mesh, camera, height, width), **peers(mesh, camera, height, width)}
            for call, times in measure(calls, repeats=options.repeats).items():
                about = {"mesh": name, "size": size, "covered": round(covered, 2), "call": call}
                rows.append({**about, **times, "ids_compile_s": round(seconds, 2), "ids_MiB": round(mib, 1)})
            print(table(rows[-len(calls) :]), flush=True)
    print(table(rows))
    print(write("raster", rows))


if __name__ == "__main__":
    main()
