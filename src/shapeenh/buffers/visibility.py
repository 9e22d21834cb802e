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
from shapeenh.buffers.bins import LARGE, WINDOWS, ascending, ascends, bin_faces, corner_indices, list_faces
from shapeenh.buffers.inputs import check_camera, check_mesh
from shapeenh.buffers.project import SUB, clip_matrix, nearness, nearness_shift, project
from shapeenh.buffers.tiles import FACES, TILE, draw_tiles, tile_count
from shapeenh.buffers.windows import (
    NEVER,
    WINDOW,
    edge_functions,
    merge,
    move_window,
    nearness_plane,
    pixel_keys,
    window_box,
    window_keys,
)
from shapeenh.buffers.xla import apart, take
from shapeenh.fusion import unknown_truth
from shapeenh.types import Camera, Mesh, Visibility

CHUNK = 8192  # faces per step
SLOTS = 65536  # candidate pixels per step
PAIRS = 2048  # (face, window) pairs per step: small kernels run on one core, so few of them
BORDER = max(TILE, WINDOW, *(k for window in WINDOWS for k in window))  # windows may hang over the right and lower edge
NO_PAIR = np.int32(2**31 - 1)
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
    Returns triangle [height, width] int32, -1 for background. Beside that and the mesh, memory for about 8 bytes per
    pixel and 11 per face is taken for the while.
    *Gradient*: none; `interpolate` has the gradients of what is seen.
    *Errors*: ValueError for NaN or infinite vertices (how many), a face index out of range, a wrong shape or option.
    Under jit, where values cannot be looked at, faces with such vertices are not drawn. Recompiles for a new V, F,
    height, width or cull only; `pad_mesh` keeps V and F on a ladder. `vmap` is correct and takes one view after the
    other.
    """
    checks.check_type("mesh", mesh, Mesh)
    checks.check_type("camera", camera, Camera)
    height, width = checks.check_size("height", height), checks.check_size("width", width)
    check_cull(cull)
    check_mesh(mesh)
    check_camera(camera)
    dtype = checks.float_dtype(mesh.vertices, camera.view, camera.projection)
    vertices, view, projection = (jnp.asarray(a, dtype) for a in (mesh.vertices, camera.view, camera.projection))
    faces = jnp.asarray(mesh.faces, jnp.int32)
    triangle = visible_triangles(vertices, faces, view, projection, height=height, width=width, cull=CULL[cull])
    return Visibility(triangle=triangle)


def check_cull(cull) -> None:
    if not isinstance(cull, bool | str) or cull not in CULL:
        raise ValueError(f"cull is {cull!r}; accepted are False, True, 'none', 'back', 'front'")


@functools.partial(jax.jit, static_argnames=("height", "width", "cull", "side"))
def visible_triangles(vertices, faces, view, projection, cells=None, *, height, width, cull, side=1):
    """The jitted body of `rasterize`, of checked arrays.

    With `cells`, a summed-area table of wanted cells of side x side pixels (`bins.touches`), only wanted cells are
    whole: faces that touch none are left out.
    """
    if faces.shape[0] == 0 or vertices.shape[0] == 0:
        return jnp.full((height, width), -1, jnp.int32)

    @jax.custom_batching.sequential_vmap  # a batched loop would drag every view along until the last one is done
    def one_view(vertices, faces, view, projection, cells):
        m, near = clip_matrix(view, projection)
        return draw(vertices, faces, m, near, height, width, cull, cells, side)

    vertices, view, projection = jax.tree.map(lax.stop_gradient, (vertices, view, projection))
    return one_view(vertices, faces, view, projection, cells)


def draw(vertices, faces, m, near, height, width, cull, cells, side):
    """triangle [height, width]: the whole rasteriser, for at least one face."""
    count = faces.shape[0]
    always = unknown_truth(vertices, m, faces)
    with jax.enable_x64(True):  # 64-bit keys, whatever the caller's precision
        corners = apart(always, lambda v, m, near: project(v, m, near, height, width), vertices, m, near)
        shift = nearness_shift(corners)
        words, ends = bin_faces(always, faces, corners, height, width, cull, cells, side)
        totals = ends[:, -1]
        flat_corners, flat_faces = corners.reshape(-1), faces.reshape(-1)

        stride = width + BORDER
        chunk = min(CHUNK, -(-count // 256) * 256)
        listed, begins = list_faces(always, words, ends, count, chunk)
        steps = jnp.cumsum((totals + (chunk - 1)) // chunk, dtype=jnp.int32)  # of all classes up to this one

        def fetched(i):
            """Chunk i: class, faces [n], how many of them there are, corner indices in the faces' and in ascending
            order, and corners x, y, nearness, three [3, n]."""
            row = jnp.sum(i >= steps, dtype=jnp.int32)
            first_rank = (i - jnp.where(row > 0, steps[row - 1], 0)) * chunk

            def fetch(index, plane):
                return take(flat_corners, index.reshape(-1) + np.int32(plane * vertices.shape[0]))

            face = lax.dynamic_slice_in_dim(listed, begins[row] + first_rank, chunk)
            own = apart(always, corner_indices, flat_faces, face)
            index = apart(always, ascending, own)
            xyr = [apart(always, functools.partial(fetch, plane=k), index).reshape(index.shape) for k in range(3)]
            return row, face, jnp.minimum(totals[row] - first_rank, chunk), own, index, xyr

        def draw_narrow(i, keys):
            _, face, there, _, _, xyr = fetched(i)
            valid = lax.iota(jnp.int32, chunk) < there
            return draw_pixels(always, keys, face, xyr, valid, shift, height, width)

        def draw_wide(i, keys):
            row, face, there, own, index, xyr = fetched(i)
            valid = lax.iota(jnp.int32, chunk) < there
            # one loop per class, of which all but one take no step: unlike a conditional, a loop updates in place
            sizes = [jnp.where(row == k, there, 0) for k in range(1, LARGE)]
            keys = draw_windows(always, keys, face, xyr, valid, shift, sizes[:-1], height, width)

            part = max(1, min(chunk // 2, FACES, (2**31 - 1) // tile_count(height, width)))  # so that counts fit int32

            def draw_large(j, keys):
                some, order, corner, some_valid, *at = cut(j * part, part, face, own, index, valid, *xyr)
                image = {"height": height, "width": width, "cull": cull, "stride": stride}
                return draw_tiles(keys, vertices, some, corner, at, ascends(order), some_valid, m, near, shift, **image)

            return lax.fori_loop(jnp.int32(0), (sizes[-1] + (part - 1)) // part, draw_large, keys)

        keys = jnp.zeros(((height + BORDER) * stride,), jnp.uint64)
        keys = lax.fori_loop(jnp.int32(0), steps[0], draw_narrow, keys)
        keys = lax.fori_loop(steps[0], steps[-1], draw_wide, keys)
        return faces_of(keys.reshape(-1, stride)[:height, :width])


def faces_of(keys):
    """The faces whose keys won, -1 where there is none."""
    face = lax.bitcast_convert_type(~lax.convert_element_type(keys, jnp.uint32), jnp.int32)
    return jnp.where(keys == 0, jnp.int32(-1), face)


def cut(start, size, *tables):
    return [lax.dynamic_slice_in_dim(t, start, size, -1) for t in tables]


def in_window(xyr, height, width):
    """x and y of corners [3, n], three [n] each, relative to the first pixel of their window."""
    x0, y0, _, _ = window_box(xyr[0], xyr[1], height, width)
    return [t - (x0 << SUB) for t in xyr[0]], [t - (y0 << SUB) for t in xyr[1]]


def draw_pixels(always, keys, face, xyr, valid, shift, height, width):
    """Faces [n] of the first class into the keys."""
    (rows, columns), stride = WINDOWS[0], width + BORDER

    def new_keys(face, xyr, valid, shift):
        x, y = in_window(xyr, height, width)
        return pixel_keys(x, y, nearness(xyr[2]) - shift, ~face.astype(jnp.uint32), valid, rows, columns)

    def pixels(xyr):
        x0, y0, _, _ = window_box(xyr[0], xyr[1], height, width)
        offset = np.add.outer(np.arange(rows) * stride, np.arange(columns)).astype(np.int32)
        return (y0 * stride + x0)[None] + offset.reshape(-1, 1)

    new, at = apart(always, new_keys, face, xyr, valid, shift), apart(always, pixels, xyr)
    return keys.at[at.reshape(-1)].max(new.reshape(-1), mode="promise_in_bounds", wrap_negative_indices=False)


def draw_windows(always, keys, face, xyr, valid, shift, sizes, height, width):
    """The first `sizes[k]` of the faces [n], as faces of class k + 2, into the keys."""
    low, stride = ~face.astype(jnp.uint32), width + BORDER

    def boxes(xyr):
        x0, y0, columns, rows = window_box(xyr[0], xyr[1], height, width)
        return jnp.stack([y0 * stride + x0, columns, rows])

    def edge_planes(xyr, valid):
        a, b, c = edge_functions(*in_window(xyr, height, width))
        return jnp.stack([*a, *b, *(jnp.where(valid, t, NEVER) for t in c)]).astype(jnp.float32)

    def nearness_planes(xyr, shift):
        x, y = in_window(xyr, height, width)
        return jnp.stack(nearness_plane(x, y, nearness(xyr[2]) - shift))

    box, edges = apart(always, boxes, xyr), apart(always, edge_planes, xyr, valid)
    plane = apart(always, nearness_planes, xyr, shift)
    for (rows, columns), size in zip(WINDOWS[1:], sizes[:-1], strict=True):
        part = min(face.shape[0], SLOTS // (rows * columns))

        def draw_part(j, keys, rows=rows, columns=columns, part=part):
            some = apart(always, lambda *t: cut(j * part, part, *t), edges, plane, low)

            def new_keys(edges, plane, low):
                return window_keys(edges.reshape(3, 3, -1), plane, low, rows, columns)

            return merge(keys, apart(always, new_keys, *some), cut(j * part, part, box[0])[0], stride)

        keys = lax.fori_loop(jnp.int32(0), (size + (part - 1)) // part, draw_part, keys)
    return draw_medium(always, keys, edges, plane, low, box, sizes[-1], stride)


def draw_medium(always, keys, edges, plane, low, box, size, stride):
    """The first `size` of the faces, window by window of WINDOW x WINDOW pixels: as many as their boxes need."""
    n = edges.shape[1]

    def listed(box):
        windows = jnp.where(lax.iota(jnp.int32, n) < size, box[1] * box[2], 0)
        ends = jnp.cumsum(windows, dtype=jnp.int32)
        begins = jnp.where(windows > 0, ends - windows, NO_PAIR)
        return ends, jnp.append(begins, jnp.full((PAIRS,), NO_PAIR))

    ends, begins = apart(size > 0, listed, box)  # of chunks of other classes, nothing
    total = ends[-1]

    def step(j, keys):
        def find(ends, begins, box):
            """The pairs' faces, by counting the faces that begin among them, and their windows' column and row."""
            pair = j * PAIRS + lax.iota(jnp.int32, PAIRS)
            earliest = jnp.sum(ends <= j * PAIRS, dtype=jnp.int32)  # the face of the first pair
            later = lax.dynamic_slice(begins, (earliest + 1,), (PAIRS - 1,)) - j * PAIRS
            marks = jnp.zeros((PAIRS + 1,), jnp.int32).at[jnp.minimum(later, PAIRS)].set(1, mode="promise_in_bounds")
            at = earliest + jnp.cumsum(marks[:PAIRS], dtype=jnp.int32)
            number = jnp.minimum(pair, total - 1) - take(begins, at)
            row = number // take(box[1], at)
            return at, number - row * take(box[1], at), row, pair < total

        at, column, row, there = apart(always, find, ends, begins, box)

        def of_faces(planes, at):
            return take(planes.reshape(-1), at[None] + np.arange(planes.shape[0], dtype=np.int32)[:, None] * n)

        local = [apart(always, of_faces, t, at) for t in (edges, plane)]
        edges_there, plane_there = apart(always, move_window, *local, column * WINDOW, row * WINDOW, there)
        start = take(box[0], at) + (row * stride + column) * WINDOW
        return merge(keys, window_keys(edges_there, plane_there, take(low, at), WINDOW, WINDOW), start, stride)

    return lax.fori_loop(jnp.int32(0), (total + (PAIRS - 1)) // PAIRS, step, keys)
