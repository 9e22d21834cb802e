"""Other people's rasterisers and ray casters as calls of no arguments, for those that are installed.

Every peer gets the same mesh and camera. What it answers: `ids` the nearest face per pixel, `G-buffer` what the peer's
docstring says. Not timed: uploads, the BVH of the ray casters, and what `read_ids` does.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np

import shapeenh as se

KEPT = "G-buffer, kept memory"  # into the memory of the frame before


def calls(mesh: se.Mesh, camera: se.Camera, height: int, width: int) -> tuple[dict, dict]:
    """(row name -> call, peer -> why it is not here)."""
    found, missing = {}, {}
    arrays = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces), np.asarray(mesh.normals, np.float32)
    for name, peer in PEERS.items():
        try:
            found |= {f"{row}: {name}": call for row, call in peer(*arrays, camera, height, width).items()}
        except ImportError as error:
            missing[name] = str(error)
        except Exception as error:  # a peer that fails on this machine must not stop the others
            missing[name] = f"{type(error).__name__}: {error}"[:200]
    return found, missing


def rays(camera, height: int, width: int):
    """Origins and directions [H * W, 3] float32 through the pixel centres."""
    inverse = np.linalg.inv(np.asarray(camera.projection, np.float64) @ np.asarray(camera.view, np.float64))
    x, y = np.meshgrid((np.arange(width) + 0.5) * 2 / width - 1, 1 - (np.arange(height) + 0.5) * 2 / height)
    ends = [np.stack([x, y, np.full_like(x, z), np.ones_like(x)], -1) @ inverse.T for z in (-1.0, 0.5)]
    start, end = ((e[..., :3] / e[..., 3:]).reshape(-1, 3) for e in ends)
    return start.astype(np.float32), (end - start).astype(np.float32)


def llvmpipe(vertices, faces, normals, camera, height, width) -> dict:
    """OpenGL through EGL, into the framebuffer of the frame before, until `finish`; nothing is read back.

    G-buffer: world position and window depth, unit normal and 1, id, and the depth buffer, 40 bytes per pixel.
    """
    import moderngl

    context = moderngl.create_context(standalone=True, backend="egl")
    m = np.asarray(camera.projection, np.float64) @ np.asarray(camera.view, np.float64)
    flip = m * np.array([1, -1, 1, 1])[:, None]  # row 0 at the top
    buffers = [
        (context.buffer(vertices.tobytes()), "3f", "vertex"),
        (context.buffer(np.ascontiguousarray(normals).tobytes()), "3f", "normal"),
    ]
    index = context.buffer(faces.astype(np.int32).tobytes())
    shader = """
        #version 330
        uniform mat4 m; in vec3 vertex; in vec3 normal; out vec3 p; out vec3 n;
        void main() { p = vertex; n = normal; gl_Position = m * vec4(vertex, 1); }"""
    outputs = {
        "ids": "out int id; void main() { id = gl_PrimitiveID + 1; }",
        "G-buffer": """out vec4 at; out vec4 up; out int id;
        void main() { at = vec4(p, gl_FragCoord.z); up = vec4(normalize(n), 1); id = gl_PrimitiveID + 1; }""",
    }
    made = {}
    for row, text in outputs.items():
        program = context.program(shader, f"#version 330\nin vec3 p; in vec3 n; {text}")
        program["m"].write(flip.T.astype("f4").tobytes())
        names = [b for b in buffers if b[2] in program]
        array = context.vertex_array(program, names, index, skip_errors=True)
        colors = [context.texture((width, height), 4, dtype="f4") for _ in range(2 if row == "G-buffer" else 0)]
        colors.append(context.texture((width, height), 1, dtype="i4"))
        target = context.framebuffer(colors, context.depth_renderbuffer((width, height)))

        def draw(target=target, array=array):
            target.use()
            context.enable_only(moderngl.DEPTH_TEST)
            target.clear()
            array.render()
            context.finish()
            return target

        draw()
        made[row] = draw
    return made | {KEPT: made["G-buffer"]}


def llvmpipe_read(vertices, faces, normals, camera, height, width) -> dict:
    """The same G-buffer read back: into new arrays, as ours are new arrays at every call, or into those of before."""
    draw = llvmpipe(vertices, faces, normals, camera, height, width)["G-buffer"]
    kinds = [(4, "f4"), (4, "f4"), (1, "i4")]

    def read():
        target = draw()
        data = (target.read(components=n, attachment=k, dtype=kind) for k, (n, kind) in enumerate(kinds))
        return [np.frombuffer(d, kind).reshape(height, width, n) for d, (n, kind) in zip(data, kinds, strict=True)]

    kept = [np.zeros((height, width, n), kind) for n, kind in kinds]

    def read_over():
        target = draw()
        for k, (n, kind) in enumerate(kinds):
            target.read_into(kept[k], components=n, attachment=k, dtype=kind)
        return kept

    return {"G-buffer": read, KEPT: read_over}


def mitsuba(vertices, faces, normals, camera, height, width) -> dict:
    """G-buffer: world position, shading normal and id in planes, 28 bytes per pixel, in memory that Dr.Jit keeps."""
    import drjit
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    solid = mitsuba.Mesh("solid", len(vertices), len(faces), has_vertex_normals=True)
    parameters = mitsuba.traverse(solid)
    parameters["vertex_positions"], parameters["faces"] = vertices.ravel(), faces.ravel()
    parameters["vertex_normals"] = normals.ravel()
    parameters.update()
    world = mitsuba.load_dict({"type": "scene", "solid": solid})
    start, along = rays(camera, height, width)
    ray = mitsuba.Ray3f(mitsuba.Point3f(start.T), mitsuba.Vector3f(along.T))

    def gbuffer():
        hit = world.ray_intersect(ray)
        drjit.eval(hit.p, hit.sh_frame.n, hit.prim_index)
        drjit.sync_thread()

    def ids():
        hit = world.ray_intersect_preliminary(ray)
        return np.asarray(drjit.select(hit.is_valid(), hit.prim_index, 0xFFFFFFFF))

    return {"ids": ids, "G-buffer": gbuffer}


def open3d(vertices, faces, normals, camera, height, width) -> dict:
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(faces.astype(np.uint32)))
    tensor = open3d.core.Tensor(np.concatenate(rays(camera, height, width), -1))
    return {"ids": lambda: scene.cast_rays(tensor)["primitive_ids"].numpy()}


def deodr(vertices, faces, normals, camera, height, width) -> dict:
    """Its 2.5D scene, with the normals as colours and no antialiased edges: depth and normal, no ids."""
    from deodr.differentiable_renderer import Scene2D

    m = np.asarray(camera.projection, np.float64) @ np.asarray(camera.view, np.float64)
    clip = np.concatenate([vertices, np.ones_like(vertices[:, :1])], 1).astype(np.float64) @ m.T
    x, y = (clip[:, 0] / clip[:, 3] + 1) * width / 2, (1 - clip[:, 1] / clip[:, 3]) * height / 2
    count, triangles = len(vertices), len(faces)
    scene = Scene2D(
        faces=faces.astype(np.uint32), faces_uv=faces.astype(np.uint32), ij=np.ascontiguousarray(np.stack([x, y], 1)),
        depths=clip[:, 3].copy(), textured=np.zeros(triangles, bool), uv=np.zeros((count, 2)), shade=np.ones(count),
        colors=np.ascontiguousarray(normals, np.float64), shaded=np.zeros(triangles, bool),
        edgeflags=np.zeros((triangles, 3), bool), height=height, width=width, nb_colors=3, texture=np.zeros((2, 2, 3)),
        background_color=np.zeros(3), backface_culling=False, perspective_correct=True, integer_pixel_centers=False,
    )  # fmt: skip
    return {"G-buffer": lambda: scene.render(0.0)}


def read_ids(answer, height: int, width: int):
    """[H, W] int32, -1 for none, of what a call of ids returned: an array (all bits set for none) or a framebuffer."""
    if hasattr(answer, "read"):
        return np.frombuffer(answer.read(components=1, dtype="i4"), np.int32).reshape(height, width) - 1
    return np.asarray(answer).astype(np.int32).reshape(height, width)


PEERS = {"llvmpipe": llvmpipe, "llvmpipe read": llvmpipe_read, "Mitsuba 3": mitsuba, "Open3D": open3d, "DEODR": deodr}


def prototype(folder: Path, mesh: se.Mesh, camera: se.Camera, height: int, width: int) -> dict:
    """`rasterizer.py` and `resolve.py` of a folder: ids; position and normal, world space, in planes; and the gradient
    of a loss of them. The same culling (none) and the same arrays."""
    import jax
    import jax.numpy as jnp

    modules = []
    for name in ("rasterizer", "resolve"):
        spec = importlib.util.spec_from_file_location(f"prototype_{name}", folder / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        modules.append(module)
    raster, resolve = modules
    vertices, normals = mesh.vertices, mesh.normals
    faces = jnp.asarray(mesh.faces, jnp.int32)
    columns = jnp.asarray(np.ascontiguousarray(np.asarray(faces).T))
    m = jnp.asarray(np.asarray(camera.projection, np.float64) @ np.asarray(camera.view, np.float64), jnp.float32)

    def ids(vertices, columns, m):
        return raster.raster_ids(vertices, columns, m, H=height, W=width, cull="none")[0]

    resolved = jax.jit(resolve.gbuffer)

    @jax.jit
    def step(vertices, normals, m, faces, columns):  # all are arguments: what is closed over would be a constant
        def loss(vertices, normals, m):
            seen = ids(*jax.tree.map(jax.lax.stop_gradient, (vertices, columns, m)))
            _, position, normal = resolve.gbuffer(vertices, normals, m, faces, seen)
            return jnp.sum(normal[2] * position[2]) + jnp.sum(position[0])

        return jax.value_and_grad(loss, (0, 1, 2))(vertices, normals, m)

    return {
        "ids: prototype": lambda: ids(vertices, columns, m),
        "G-buffer: prototype": lambda: resolved(vertices, normals, m, faces, ids(vertices, columns, m)),
        "forward + backward: prototype": lambda: step(vertices, normals, m, faces, columns),
    }
