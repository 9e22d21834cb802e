"""Visibility: which face each pixel centre sees (SPEC 11). Integers, no gradient.

In order: `project` the vertices, `classify` the faces, draw each class of small faces through dense windows, then
the large ones tile by tile. Every loop takes as many steps as there is work: nothing has a capacity, nothing is
dropped.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks
from shapeenh.buffers.bins import WINDOWS, bit_counts, class_words, classify
from shapeenh.buffers.inputs import check_camera, check_mesh
from shapeenh.buffers.project import clip_matrix, nearness_shift, project
from shapeenh.buffers.tiles import FACES, TILE, draw_large
from shapeenh.buffers.windows import draw_small
from shapeenh.buffers.xla import stored, take
from shapeenh.types import Camera, Mesh, Visibility

SLOTS = 65536  # candidate pixels per step of a small class
CULL = {False: "none", None: "none", "none": "none", True: "back", "back": "back", "front": "front"}


def rasterize(mesh: Mesh, camera: Camera, *, height: int, width: int, cull: bool | str = False) -> Visibility:
    """The face nearest to the camera at every pixel centre: an exact z-buffer.

    Source: SPEC 11. Vertices are snapped to 1/256 pixel; coverage is decided by exact integers with the top-left
    rule, so that a tessellation covers every pixel exactly once, in every precision, compiled or not. The nearest face
    wins, ties go to the lowest index. Faces without area are skipped. Faces that cross the near plane or the eye
    plane are cut there. The far plane does not cut: it only scales z, and what lies beyond it is drawn.

    mesh: V vertices, F faces; F = 0 gives background everywhere. camera: perspective, off-centre or orthographic.
    *Static*: height, width: pixels, 1 to 32768. cull: False or "none" draws both sides; True or "back" drops faces
    seen from behind (clockwise); "front" drops the others.
    Returns triangle [height, width] int32, -1 for background.
    *Gradient*: none; `interpolate` has the gradients of what is seen.
    *Errors*: ValueError for NaN or infinite vertices (how many), a face index out of range, a wrong shape or option.
    Under jit, where values cannot be looked at, faces with such vertices are not drawn. Recompiles for a new V, F,
    height, width or cull only. `vmap` is correct and takes one view after the other.
    """
    checks.check_type("mesh", mesh, Mesh)
    checks.check_type("camera", camera, Camera)
    height, width = checks.check_size("height", height), checks.check_size("width", width)
    if not isinstance(cull, bool | str) or cull not in CULL:
        raise ValueError(f"cull is {cull!r}; accepted are False, True, 'none', 'back', 'front'")
    check_mesh(mesh)
    check_camera(camera)
    dtype = checks.float_dtype(mesh.vertices, camera.view, camera.projection)
    vertices, view, projection = (jnp.asarray(a, dtype) for a in (mesh.vertices, camera.view, camera.projection))
    faces = jnp.asarray(mesh.faces, jnp.int32)
    triangle = visible_triangles(vertices, faces, view, projection, height=height, width=width, cull=CULL[cull])
    return Visibility(triangle=triangle)


@functools.partial(jax.jit, static_argnames=("height", "width", "cull"))
def visible_triangles(vertices, faces, view, projection, *, height, width, cull):
    """The jitted body of `rasterize`, of checked arrays."""
    if faces.shape[0] == 0 or vertices.shape[0] == 0:
        return jnp.full((height, width), -1, jnp.int32)

    @jax.custom_batching.sequential_vmap  # a batched loop would drag every view along until the last one is done
    def one_view(vertices, faces, view, projection):
        m, near = clip_matrix(view, projection)
        return draw(vertices, faces, m, near, height, width, cull)

    vertices, view, projection = jax.tree.map(lax.stop_gradient, (vertices, view, projection))
    return one_view(vertices, faces, view, projection)


def draw(vertices, faces, m, near, height, width, cull):
    count = faces.shape[0]
    classes = len(WINDOWS) + 1
    planes = [faces[:, k] for k in range(3)]
    with jax.enable_x64(True):  # 64-bit keys, whatever the caller's precision
        always = planes[0][0] >= np.iinfo(np.int32).min
        x, y, r, seen = stored(always, lambda v, m: project(v, m, near, height, width), vertices, m)
        shift = nearness_shift(r, seen)

        def kinds(x, y, planes):
            tx, ty = ([take(t, i) for i in planes] for t in (x, y))
            return classify(tx, ty, height, width, cull)

        kind = stored(always, kinds, x, y, planes)
        words = stored(always, lambda kind: class_words(kind, classes), kind)
        ends = bit_counts(words)
        totals = ends[:, -1]

        border = max(
            [TILE] + [k for window in WINDOWS for k in window]
        )  # windows may hang over the right and lower edge
        stride = width + border
        keys = jnp.zeros(((height + border) * stride,), jnp.uint64)

        for k, window in enumerate(WINDOWS):
            chunk = min(int(np.clip(SLOTS // (window[0] * window[1]), 1024, 8192)), -(-count // 256) * 256)

            def small(state, k=k, window=window, chunk=chunk):
                i, keys = state
                rank = i * chunk + lax.iota(jnp.int32, chunk)
                corners = (x, y, r)
                return i + 1, draw_small(
                    keys, rank, totals[k], words[k], ends[k], corners, shift, planes,
                    height=height, width=width, window=window, stride=stride,
                )  # fmt: skip

            def more(state, k=k, chunk=chunk):
                return state[0] * chunk < totals[k]

            keys = lax.while_loop(more, small, (jnp.int32(0), keys))[1]

        step = max(1, min(FACES, (2**31 - 1) // (-(-height // TILE) * -(-width // TILE))))  # tile counts fit int32
        total = totals[-1]

        def large(state):
            i, keys = state
            rank = i * step + lax.iota(jnp.int32, step)
            return i + 1, draw_large(
                keys, rank, total, words[-1], ends[-1], (x, y, r), planes, vertices, m, near, shift,
                height=height, width=width, cull=cull, stride=stride,
            )  # fmt: skip

        keys = lax.while_loop(lambda state: state[0] * step < total, large, (jnp.int32(0), keys))[1]

        keys = keys.reshape(height + border, stride)[:height, :width]
        face = lax.bitcast_convert_type(~lax.convert_element_type(keys, jnp.uint32), jnp.int32)
        return jnp.where(keys == 0, jnp.int32(-1), face)
