"""The sum of all stamps, I(y) = sum over x of w(x) f(T_x(y - x)), and its compression (TH10 8.1, SPEC 10).

Pixels gather: each looks at the stamps around it. Only runs of 64 pixels that a stamp can reach are looked at, offset
by offset, on contiguous memory; so the cost is the number of pixels near lines times that of a footprint.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.fusion import stored, unknown_truth
from shapeenh.lines.stamps import Stamps, imprint, stamps_planes, tinted
from shapeenh.lines.tiles import over_tiles

LANES = 64
GROUP = 128  # runs per step: what they read stays in the cache


def rim(width: int, reach: int):
    """How many pixels `draw_listed` reads around an image of whole runs: ((above, below), (left, right))."""
    return (reach, reach), (reach, -width % LANES + reach)


# ------------------------------------------------------------------------------------------- barriers
#
# Footprints end at barriers between pixels. Crossings are counted along rows and columns: two pixels of a row have none
# between them if their counts are equal. A stamp reaches a pixel if one of the two ways around the rectangle between
# them, first along the row or first along the column, is free.


def crossings(barriers):
    """(along the rows, along the columns), [H, W] int32: how many barriers lie before each pixel."""
    across, down = (b.astype(jnp.int32) for b in barriers)
    return jnp.cumsum(across, axis=1) - across, jnp.cumsum(down, axis=0) - down


def crossings_on_host(barriers: tuple[np.ndarray, ...], reach: int):
    """`crossings` of concrete barriers, in the frame of `rim`, modulo 256, which is as good: no footprint spans that
    many. The rows outside those that hold barriers cost nothing. No stamp lies in the rim, so any count may.
    """
    (across, down), (h, w) = barriers, barriers[0].shape
    counts = [np.zeros([n + sum(sides) for n, sides in zip((h, w), rim(w, reach), strict=True)], np.int8) for _ in "xy"]
    inner = [count[reach : reach + h, reach : reach + w] for count in counts]
    used = np.flatnonzero(across.any(axis=1) | down.any(axis=1))
    if used.size:
        first, last = int(used[0]), int(used[-1]) + 1
        np.add.accumulate(across[first:last, :-1].view(np.int8), axis=1, dtype=np.int8, out=inner[0][first:last, 1:])
        for row in range(first, min(last, h - 1)):  # NumPy's own sum along columns takes four times as long
            np.add(inner[1][row], down[row].view(np.int8), out=inner[1][row + 1])
        inner[1][last + 1 :] = inner[1][last : last + 1]
    return tuple(counts)


def _free(stamp, pixel, row_of_stamp, row_of_pixel):
    """Whether no barrier separates two pixels, from the crossings at both and at the rectangle's other corners.

    Each is a pair (along rows, along columns). row_of_stamp: in the stamp's row and the pixel's column; row_of_pixel:
    in the pixel's row and the stamp's column.
    """
    along_column_first = (row_of_pixel[1] == stamp[1]) & (row_of_pixel[0] == pixel[0])
    along_row_first = (row_of_stamp[0] == stamp[0]) & (row_of_stamp[1] == pixel[1])
    return along_column_first | along_row_first


# ------------------------------------------------------------------------------------------- which runs


def list_runs(weight, valid, barriers, reach: int):
    """(runs [n] int32, how many of them [2] int32): first those without barriers within reach, then those with.

    weight: [H, W]; valid, barriers: [H, W] bool each, concrete, or None; where not valid, there is no weight.
    """
    stamped, rows = np.zeros(valid.shape, bool), np.flatnonzero(valid.any(axis=1))
    if rows.size:
        used = slice(int(rows[0]), int(rows[-1]) + 1)
        stamped[used] = weight[used] > 0
    near = _near(stamped, reach)
    if barriers is None:
        cut = np.zeros_like(near)
    else:
        cut = _near(barriers[0] | barriers[1], reach + 1)
    free, held = np.flatnonzero(near & ~cut), np.flatnonzero(near & cut)
    listed = np.zeros(near.size + 2 * GROUP, np.int32)  # one size per image: nothing recompiles
    start = -(-free.size // GROUP) * GROUP
    for first, runs in ((0, free), (start, held)):
        whole = -(-runs.size // GROUP) * GROUP
        listed[first : first + whole] = np.pad(runs, (0, whole - runs.size), mode="edge") if runs.size else 0
    return listed, np.asarray([start // GROUP, -(-held.size // GROUP)], np.int32)


def _near(flags: np.ndarray, reach: int) -> np.ndarray:
    """[H, runs per row]: which runs have a flag within `reach` rows and columns."""
    h, w = flags.shape
    runs = -(-w // LANES)
    near = np.zeros((h, runs), bool)
    used = np.flatnonzero(flags.any(axis=1))
    if not used.size:
        return near
    first, last = int(used[0]), int(used[-1]) + 1  # all other rows are empty
    block = np.pad(flags[first:last], ((0, 0), (0, runs * LANES - w))).reshape(last - first, runs, LANES)
    any_ = np.asarray(block.any(axis=2))
    any_[:, 1:] |= block[:, :-1, -reach:].any(axis=2)
    any_[:, :-1] |= block[:, 1:, :reach].any(axis=2)
    total = np.cumsum(np.pad(any_, ((2 * reach + 1, 2 * reach), (0, 0))), axis=0)
    wide = total[2 * reach + 1 :] > total[: -2 * reach - 1]
    top, bottom = max(first - reach, 0), min(last + reach, h)
    near[top:bottom] = wide[top - first + reach : bottom - first + reach]
    return near


# ------------------------------------------------------------------------------------------- the sum (8.1)


@partial(jax.jit, static_argnames=("wants", "margin", "reach"))
def framed_stamps(images, brush, tiles, *, wants, margin, reach) -> Stamps:
    """The stamps of (profile, field, shading, noise) in the frame of `rim`, plane by plane, with none there.

    wants: as for `stamps_planes`. tiles: outside of which there are none either, or None.
    """
    always, frame = unknown_truth(images[0].distance), rim(images[0].distance.shape[1], reach)

    def planes(images):
        profile, field, shading, noise = images
        make = partial(stamps_planes, **dict(wants))
        weight, radius, *vectors = stored(always, make, profile, field, brush, shading, noise)
        return Stamps(weight, radius, *(None if v is None else tuple(v) for v in vectors))

    shapes = jax.eval_shape(planes, images)
    blank = jax.tree.map(lambda _: 0, shapes)._replace(radius=None if shapes.radius is None else 1)
    blank, structure = jax.tree.flatten(blank)
    if tiles is None:
        found = [
            jnp.pad(p, frame, constant_values=b) for p, b in zip(jax.tree.leaves(planes(images)), blank, strict=True)
        ]
    else:
        found = over_tiles(
            lambda images: jax.tree.leaves(planes(images)), images, tiles, blank, margin=margin, rim=frame
        )
    return jax.tree.unflatten(structure, found)


@partial(jax.jit, static_argnames=("function", "reach", "shape"))
def draw_listed(stamps: Stamps, listed, counts, brush, noise, image, crossed, *, function, reach, shape):
    """The picture [H, W, 4], from the listed runs alone. stamps, crossed: from `framed_stamps`, `crossings_on_host`."""
    runs = -(-shape[1] // LANES)

    def picture(total, run):
        sheet = None
        if noise is not None:
            column = jnp.minimum((run % runs * LANES)[:, None] + jnp.arange(LANES, dtype=run.dtype)[None], shape[1] - 1)
            sheet = noise[(run // runs)[:, None], column, 0]
        return compress(total, brush, sheet)

    return gathered(picture, 4, (function, reach, shape), stamps, listed, counts, brush, image, crossed)


def gathered(finish, outputs: int, how, stamps: Stamps, listed, counts, brush, image, crossed):
    """`finish(sums, runs)` of the sums at the listed runs, planes [GROUP, LANES], as [H, W, outputs]; 0 elsewhere."""
    function, reach, (h, w) = how
    runs = -(-w // LANES)
    side = 2 * reach + 1
    planes, counted = jax.tree.map(jnp.ravel, (stamps, crossed or ()))
    channels, own_rgb = channels_of(stamps, brush, image, function)
    always = unknown_truth(stamps.weight)

    def group(k, canvas, *, cut):
        run = lax.dynamic_slice_in_dim(listed, k * GROUP, GROUP)
        rows = partial(row_of_window, run, runs, reach)

        def row(i, total):
            window = jax.tree.map(lambda plane: rows(plane, i), planes)
            places = [rows(c, at) for at in (i, reach) for c in counted * cut]
            y = (i - reach).astype(stamps.weight.dtype)  # the pixel is that much higher than the stamp
            left = partial(_row_of_stamps, y=y, reach=reach, brush=brush, image=image, function=function)
            if channels == 1:
                return [total[0] + sum(alpha for alpha, _ in left(window, places))]
            # every channel would compute the opacity again
            known = None if own_rgb else stored(always, lambda *a: jnp.stack([p[0] for p in left(*a)]), window, places)
            for j, (alpha, rgb) in enumerate(left(window, places)):
                alpha = alpha if known is None else known[j]
                stamp = jax.tree.map(lambda plane, j=j: plane[:, j : j + LANES], window)
                total = [t + alpha * c for t, c in zip(total, (*tinted(stamp, rgb, brush), 1), strict=True)]
            return total

        total = lax.fori_loop(0, side, row, [jnp.zeros((GROUP, LANES), stamps.weight.dtype)] * channels)
        found = jnp.stack(finish(total, run), axis=-1).reshape(GROUP, LANES * outputs)
        return canvas.at[run].set(found, mode="promise_in_bounds")

    canvas = jnp.zeros((h * runs, LANES * outputs), stamps.weight.dtype)
    canvas = lax.fori_loop(0, counts[0], partial(group, cut=False), canvas)
    if crossed is not None:
        canvas = lax.fori_loop(counts[0], counts[0] + counts[1], partial(group, cut=True), canvas)
    return canvas.reshape(h, runs * LANES, outputs)[:, :w]


def channels_of(stamps: Stamps, brush, image, function):
    """(4, or 1 where all stamps have the brush's colour; whether footprints have colours of their own)."""
    one = jax.tree.map(lambda plane: plane.ravel()[:1], stamps)
    own_rgb = jax.eval_shape(lambda p: imprint(p, 0.0, 0.0, brush, image, function), one)[1] is not None
    return 1 if stamps.color is None and not own_rgb else 4, own_rgb


def _row_of_stamps(window, places, *, y, reach, brush, image, function):
    """[(alpha, rgb)] that the stamps of one row of a window leave, from the leftmost to the rightmost."""
    found = []
    for j in range(2 * reach + 1):
        here, middle = slice(j, j + LANES), slice(reach, reach + LANES)
        stamp = jax.tree.map(lambda plane, here=here: plane[:, here], window)
        if places:
            free = unhindered(places, here, middle)
            stamp = stamp._replace(weight=jnp.where(free, stamp.weight, 0))
        found.append(imprint(stamp, jnp.asarray(reach - j, y.dtype), y, brush, image, function))
    return found


def unhindered(places, at_stamp, at_pixel):
    """`_free` of runs in two rows of windows; places: the crossings along the stamps' row, along the pixels' row."""
    of_stamp, of_pixel = places[:2], places[2:]
    corners = (of_stamp, at_stamp), (of_pixel, at_pixel), (of_stamp, at_pixel), (of_pixel, at_stamp)
    return _free(*([count[:, part] for count in counts] for counts, part in corners))


def row_of_window(run, runs: int, reach: int, flat, i):
    """[runs, LANES + 2 reach]: row `i` of the windows around runs, of a plane in the frame of `rim`, flattened."""
    corner = run // runs * (runs * LANES + 2 * reach) + run % runs * LANES
    return _read_runs(flat, corner + i * (runs * LANES + 2 * reach), LANES + 2 * reach)


def _read_runs(flat, start, width: int):
    """[runs, width] windows of flat [n]."""
    numbers = lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(), start_index_map=(0,))
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return lax.gather(flat, start[:, None], numbers, (width,), mode=mode)


def compress(total, brush, paper):
    """Paper, then all four channels by one factor, so that alpha = 1 - exp(-I_a) and colours stay."""
    depth = total[-1] if paper is None else total[-1] * (1 - brush.paper * paper)
    small = depth < 1e-4
    factor = jnp.where(small, 1 - 0.5 * depth, -jnp.expm1(-depth) / jnp.where(small, 1, depth))
    if paper is not None:
        factor = factor * (1 - brush.paper * paper)
    rgb = total[:3] if len(total) == 4 else [total[0] * brush.color[i] for i in range(3)]
    return [plane * factor for plane in (*rgb, total[-1])]
