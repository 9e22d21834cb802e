"""Strokes under a transformation: runs with stamps are listed at run time, and reverse mode follows them (SPEC 10)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from shapeenh.lines.accumulate import (
    GROUP,
    LANES,
    channels_of,
    compress,
    crossings,
    framed_stamps,
    gathered,
    rim,
    row_of_window,
    unhindered,
)
from shapeenh.lines.stamps import Tip, imprint, tinted


@partial(jax.jit, static_argnames=("wants", "function", "reach"))
def draw_traced(profile, field, brush, shading, noise, image, barriers, *, wants, function, reach):
    """The picture [H, W, 4] from runs that are listed at run time. Gradient: exact, in reverse mode."""
    shape, frame = profile.distance.shape, rim(profile.distance.shape[1], reach)
    stamps = framed_stamps((profile, field, shading, noise), brush, None, wants=wants, margin=None, reach=reach)
    crossed = None if barriers is None else tuple(jnp.pad(count, frame) for count in crossings(barriers))
    # without flow no stamp has a weight, but that has a derivative
    inked = (stamps.weight > 0) | jnp.pad(profile.valid & (brush.flow == 0), frame)
    tip = Tip(brush.color, brush.radius, brush.aspect)
    total = _sums((function, reach, shape), stamps, tip, image, crossed, inked)
    total = [total[..., i] for i in range(total.shape[-1])]
    return jnp.stack(compress(total, brush, None if noise is None else noise[..., 0]), axis=-1)


def _list_inked(inked, reach: int):
    """(runs [n] int32, how many of them) with a flag within `reach`; inked: [H, W] and so many pixels around it."""
    near = lax.reduce_window(inked, False, lax.bitwise_or, (1, LANES + 2 * reach), (1, LANES), "valid")
    near = lax.reduce_window(near, False, lax.bitwise_or, (2 * reach + 1, 1), (1, 1), "valid")
    (listed,) = jnp.nonzero(near.ravel(), size=near.size + GROUP, fill_value=0)
    return listed.astype(jnp.int32), jnp.sum(near, dtype=jnp.int32)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _sums(how, stamps, tip, image, crossed, inked):
    """I of every pixel, [H, W, channels]. how: (function, reach, (H, W)); inked: which stamps count, in the frame.

    Gradient: with respect to stamps, tip and image. Pixels gather from stamps, and stamps their derivatives from
    pixels: the same walk, along the runs that hold stamps.
    """
    listed, total = _list_inked(inked, how[1])
    steps = -(-total // GROUP)
    counts = (steps, 0) if crossed is None else (0, steps)
    channels, _ = channels_of(stamps, tip, image, how[0])
    return gathered(lambda total, run: total, channels, how, stamps, listed, counts, tip, image, crossed)


def _sums_forward(how, *arguments):
    wanted = tuple(() if leaf.perturbed else None for leaf in jax.tree.leaves(arguments[:3]))
    arguments = jax.tree.map(lambda leaf: leaf.value, arguments)
    return _sums(how, *arguments), (arguments, wanted)


def _sums_backward(how, saved, cotangent):
    function, reach, (h, w) = how
    (*sources, crossed, inked), wanted = saved
    runs, channels, dtype = -(-w // LANES), cotangent.shape[2], cotangent.dtype
    given = [jnp.pad(cotangent[..., i], rim(w, reach)).ravel() for i in range(channels)]
    counted = [] if crossed is None else [count.ravel() for count in crossed]
    listed, total = _list_inked(inked[reach:-reach, reach:-reach], 0)
    leaves, structure = jax.tree.flatten(sources)
    planes, tips = len(jax.tree.leaves(sources[0])), len(jax.tree.leaves(sources[:2]))
    asked = [k for k, want in enumerate(wanted) if want is not None]

    def group(k, found):
        run = lax.dynamic_slice_in_dim(listed, k * GROUP, GROUP)
        rows = partial(row_of_window, run, runs, reach)
        fresh = (k * GROUP + lax.iota(jnp.int32, GROUP) < total)[:, None]  # what fills the list up counts for nothing
        middle = slice(reach, reach + LANES)
        own = [rows(leaf.ravel(), reach)[:, middle] for leaf in leaves[:planes]]
        own += [jnp.broadcast_to(a[..., None, None], (*a.shape, GROUP, LANES)) for a in leaves[planes:tips]]
        own += leaves[tips:]

        def row(i, bars):
            window = [jnp.where(fresh, rows(plane, i), 0) for plane in given]
            places = [rows(c, at) for at in (reach, i) for c in counted]
            y = (reach - i).astype(dtype)

            def inner(values):
                """What the row's pixels weigh the stamps' marks with, added up."""
                stamp, tip, image = jax.tree.unflatten(structure, [values.get(k, own[k]) for k in range(len(own))])
                product = 0
                for j in range(2 * reach + 1):
                    here = slice(j, j + LANES)
                    alpha, rgb = imprint(stamp, jnp.asarray(j - reach, dtype), y, tip, image, function)
                    colors = [1] if channels == 1 else [*tinted(stamp, rgb, tip), 1]
                    weighed = sum(bar[:, here] * c for bar, c in zip(window, colors, strict=True))
                    if places:
                        weighed = jnp.where(unhindered(places, middle, here), weighed, 0)
                    product = product + weighed * alpha
                return product

            _, pull = jax.vjp(inner, {k: own[k] for k in asked})
            return jax.tree.map(jnp.add, bars, pull(jnp.ones((GROUP, LANES), dtype))[0])

        bars = lax.fori_loop(0, 2 * reach + 1, row, {k: jnp.zeros_like(own[k]) for k in asked})
        for k in asked:
            if k < planes:
                found[k] = found[k].at[run].add(bars[k], mode="promise_in_bounds")
            else:
                found[k] = found[k] + (jnp.sum(bars[k], axis=(-2, -1)) if k < tips else bars[k])
        return found

    found = {k: jnp.zeros((h * runs, LANES) if k < planes else leaves[k].shape, dtype) for k in asked}
    found = lax.fori_loop(0, -(-total // GROUP), group, found)
    for k in asked:
        if k < planes:
            found[k] = jnp.pad(found[k].reshape(h, runs * LANES), reach)
    return *jax.tree.unflatten(structure, [found.get(k) for k in range(len(leaves))]), None, None


_sums.defvjp(_sums_forward, _sums_backward, symbolic_zeros=True)
