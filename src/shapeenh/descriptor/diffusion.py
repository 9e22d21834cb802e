"""Anisotropic diffusion of image planes, dg/ds = div(c grad g) (Perona-Malik; LW09 4.3, SPEC 3.5 and 3.6).

Either explicit steps (`heat`), or the fast scheme. Both are made of averages with non-negative weights alone, and so
keep the three laws step for step: nothing crosses a closed link, the sum over a connected region stays, no new extrema.

Planes are `[C, H, W]`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from shapeenh.fusion import stored
from shapeenh.heat import SLOTS, STEP, explicit, slots_for
from shapeenh.sparse import dense, few_links, steep
from shapeenh.stencils import shift

GREATEST_SIGMA = 100.0

# ------------------------------------------------------------------------------------------- the fast scheme
#
# Once a few explicit steps have removed what is finer than 2 px, blocks of 2 x 2 pixels may stand for their pixels: a
# step there is four times as long and costs a quarter. So: smooth, average over blocks, go on (recursively) on the
# blocks, give every pixel its block's value, smooth again, which removes the blocks' edges. All are averages with
# non-negative weights, and symmetric ones.
#
# Where an insulated line cuts through a block, one connected part of its pixels forms the cell; pixels cut off from it
# join the cell of a neighbouring block that they are linked to, or else keep their value and wait for the smoothing.
# A cell knows its volume (in pixels) and the length of its open border with the cell to its right and the one below.

_SMOOTHING = (4, 20)  # explicit steps before and after a descent: on pixels; on blocks of any size
_WORTH = 12  # a descent costs as much as about so many steps
_LEVELS = 2  # blocks of 4 x 4 pixels: there, even sigma = 100 takes a fraction of the other work
_STRONG = 0.2  # a border less open than that joins nothing

_CELL, _LEFT, _RIGHT, _UP, _DOWN = 1, 2, 3, 4, 5  # a pixel's role: in its block's cell, or which neighbour's it joins
_SIDES = ((_LEFT, -1, -1), (_RIGHT, 1, -1), (_UP, -1, -2), (_DOWN, 1, -2))  # (role, step, axis)


def _quarters(array):
    """The four members of every 2 x 2 block: top left, top right, bottom left, bottom right."""
    return tuple(array[..., i::2, j::2] for i in (0, 1) for j in (0, 1))


def _blocks(cells):
    """Every pixel of a 2 x 2 block gets the block's value."""
    *lead, h, w = cells.shape
    rows = jnp.broadcast_to(cells[..., None], (*lead, h, w, 2)).reshape(*lead, h, 1, 2 * w)
    return jnp.broadcast_to(rows, (*lead, h, 2, 2 * w)).reshape(*lead, 2 * h, 2 * w)


def _over_blocks(planes):
    """Sums over the blocks."""
    rows = planes[..., 0::2, :] + planes[..., 1::2, :]
    return rows[..., 0::2] + rows[..., 1::2]


def _even(array, size):
    """Zero rows and columns at the bottom and right, up to `size` rounded up to even numbers."""
    return jnp.pad(
        array, [(0, 0)] * (array.ndim - 2) + [(0, n + n % 2 - m) for n, m in zip(size, array.shape[-2:], strict=True)]
    )


def _members(volume, strong_x, strong_y):
    """Which members of a block form its cell: a bit for each quarter, `[h, w]` int8."""
    v = _quarters(volume)
    top, _, bottom, _ = _quarters(strong_x)
    left, right, _, _ = _quarters(strong_y)

    # the largest member, the first of several, and all that is linked to it inside the block
    largest = jnp.maximum(jnp.maximum(v[0], v[1]), jnp.maximum(v[2], v[3]))
    seed, taken = [], largest <= 0
    for part in v:
        seed.append((part == largest) & ~taken)
        taken = taken | seed[-1]
    a, b, c, d = seed
    for _ in range(3):
        a, b, c, d = (
            a | b & top | c & left,
            b | a & top | d & right,
            c | a & left | d & bottom,
            d | b & right | c & bottom,
        )
    return sum(part.astype(jnp.int8) << i for i, part in enumerate((a, b, c, d)))


def _in_cell(members):
    """1 for the pixels of a cell, else 0, from the bits of `_members`."""
    bits = _blocks(members)
    row, column = (lax.broadcasted_iota(jnp.int32, bits.shape, axis) % 2 for axis in (0, 1))
    return (bits >> (2 * row + column).astype(jnp.int8)) & 1


def _join(cell, alive, strong_x, strong_y):
    """The roles: `cell`'s, and of the others those linked to the cell of a neighbouring block."""
    role = cell
    for name, step, axis in _SIDES:
        odd = lax.broadcasted_iota(jnp.int32, role.shape, axis % 2) % 2
        strong = strong_x if axis == -1 else strong_y
        link = strong if step == 1 else shift(strong, -1, axis)
        joins = (role == 0) & alive & (odd == (step == 1)) & link & (shift(cell, step, axis) == _CELL)
        role = jnp.where(joins, jnp.int8(name), role)
    return role


def _roles(volume, border_x, border_y, always, *, spacing):
    """The role of every pixel, int8; 0 for none. All sizes even."""
    least = _STRONG * spacing

    def members(volume, border_x, border_y):
        return _members(volume, border_x >= least, border_y >= least)

    def join(cell, volume, border_x, border_y):
        return _join(cell, volume > 0, border_x >= least, border_y >= least)

    cell = stored(always, _in_cell, stored(always, members, volume, border_x, border_y))
    return stored(always, join, cell, volume, border_x, border_y)


def _hand_over(planes, role):
    """Members that join the cell of a neighbouring block hand their value to its nearest pixel; others keep it."""
    role = role.reshape((1,) * (planes.ndim - 2) + role.shape)
    total = jnp.where(role == _CELL, planes, 0)
    for name, step, axis in _SIDES:
        total = total + shift(jnp.where(role == name, planes, 0), -step, axis)
    return total


def _choose(blocks, planes, role):
    """The value of every pixel's cell; those without one keep that of `planes`."""
    out = jnp.where(role[None] == _CELL, blocks, planes)
    for name, step, axis in _SIDES:
        out = jnp.where(role[None] == name, shift(blocks, step, axis), out)
    return out


def _across(border_x, border_y, role):
    """Borders between two pixels that are both in their blocks' cells, else 0."""
    cell = role == _CELL
    across_x = jnp.where(cell & shift(cell, 1, -1), border_x, 0)
    return across_x, jnp.where(cell & shift(cell, 1, -2), border_y, 0)


def _over_borders(border_x, border_y):
    """Sums over those borders of pixels that are borders of blocks; of flags, whether one is set."""
    over_x, over_y = border_x[0::2] + border_x[1::2], border_y[1::2]
    return over_x[:, 1::2], over_y[:, 0::2] + over_y[:, 1::2]


def _merge(volume, border_x, border_y, role, always):
    """Volumes and borders of the cells."""
    across_x, across_y = stored(always, _across, border_x, border_y, role)
    volume = stored(always, _hand_over, volume, role)

    def add(volume, across_x, across_y):
        return _over_blocks(volume), *_over_borders(across_x, across_y)

    return stored(always, add, volume, across_x, across_y)


def _conduct(border, volume, axis: int, spacing, step):
    """Links between cells: border length over distance, but never so much that a step could overshoot."""
    least = jnp.minimum(volume, shift(volume, 1, axis))
    link = jnp.minimum(border / spacing, least * (0.25 / step))
    return link[:, :-1] if axis == -1 else link[:-1]


def _descend(stacks, level: int, time, cells, flank, always, levels: int, sure: bool):
    """Diffuse a tuple of plane stacks on the cells of one level for `time`.

    flank: the borders that alone have a derivative, flags like those; or None for all.
    """
    volume, border_x, border_y = cells
    spacing = 2.0**level
    step = STEP * spacing**2
    smoothing = step * _SMOOTHING[min(level, 1)]
    rest = time - 2 * smoothing - 0.25 * spacing**2  # averaging over blocks spreads like a time of h^2 / 4
    link_x = _conduct(border_x, volume, -1, spacing, step)
    link_y = _conduct(border_y, volume, -2, spacing, step)
    if level == 0:
        weight = jnp.ones((1, 1), volume.dtype)
    else:
        weight = jnp.where(volume > 0, 1 / jnp.maximum(volume, 1), 0)
        link_x, link_y, weight = stored(always, lambda *planes: planes, link_x, link_y, weight)

    # coarser levels have no more flagged links, and the last one takes too many steps to keep what they leave
    marks = flank if level < _LEVELS else None
    followed, link_x, link_y = _followed(link_x, link_y, marks, _most(volume.size * 4**level))

    def smooth(stacks, time, steps):
        slots = slots_for(steps, SLOTS * 4**level)  # coarse states are small
        return tuple(explicit(planes, link_x, link_y, time, weight, followed, step, slots) for planes in stacks)

    direct = 2 * _SMOOTHING[min(level, 1)] + 2 + _WORTH  # steps that are not worth a descent
    if level == levels:
        return smooth(stacks, time, direct if levels < _LEVELS else math.ceil(0.5 * GREATEST_SIGMA**2 / step))

    def coarse(stacks):
        size = h, w = volume.shape
        v, bx, by = _even(volume, size), _even(border_x, size), _even(border_y, size)
        role = _roles(v, bx, by, always, spacing=spacing)
        below = _merge(v, bx, by, role, always)
        flank_below = flank and _over_borders(_even(flank[0], size), _even(flank[1], size))

        def hand_over(planes, role, v):
            return _hand_over(_even(planes, size) * v[None], role)

        def average(planes, volume):
            return _over_blocks(planes) / jnp.where(volume > 0, volume, 1)[None]

        def down(planes):
            return stored(always, average, stored(always, hand_over, planes, role, v), below[0])

        def choose(blocks, planes, role):
            return _choose(blocks, _even(planes, size), role)[:, :h, :w]

        def up(cells, planes):
            return stored(always, choose, stored(always, _blocks, cells), planes, role)

        aside = jnp.full((1, 1), smoothing, volume.dtype)
        stacks = smooth(stacks, aside, _SMOOTHING[min(level, 1)])
        lower = tuple(down(planes) for planes in stacks)
        lower = _descend(lower, level + 1, rest, below, flank_below, always, levels, sure)
        stacks = tuple(up(cells, planes) for cells, planes in zip(lower, stacks, strict=True))
        return smooth(stacks, aside, _SMOOTHING[min(level, 1)])

    if sure:
        return coarse(stacks)
    return lax.cond(rest[0, 0] > _WORTH * step, coarse, lambda stacks: smooth(stacks, time, direct), stacks)


def _diffuse(stacks, link_x, link_y, budget, alive, flank, always, levels: int, sure: bool):
    if levels >= 0:
        border_x, border_y = jnp.pad(link_x, ((0, 0), (0, 1))), jnp.pad(link_y, ((0, 1), (0, 0)))
        cells = alive.astype(link_x.dtype), border_x, border_y
        return _descend(stacks, 0, budget, cells, flank, always, levels, sure)
    one, slots = jnp.ones((1, 1), link_x.dtype), (SLOTS,) * -levels
    marks = flank if len(slots) <= 2 else None  # more steps leave too much to keep
    followed, link_x, link_y = _followed(link_x, link_y, marks, _most(alive.size))
    return tuple(explicit(planes, link_x, link_y, budget, one, followed, STEP, slots) for planes in stacks)


# ------------------------------------------------------------------------------------------- few links
#
# Nearly everywhere the conductance is 0 or 1 for good: only on the flanks of silhouettes and creases, a few hundred or
# thousand pixels, does it have a derivative. That of a few links is cheap to follow, that of all is not. How many they
# are is known at run time: where they are too many, all is done again with all.


def flank(conductance):
    """The links that have a derivative if the conductance has none where it is 0 or 1: flags for `diffuse_stacks`."""
    some, open_ = steep(conductance), conductance > 0

    def pairs(axis):
        return (some | shift(some, 1, axis)) & open_ & shift(open_, 1, axis)

    return pairs(-1), pairs(-2)


def _most(pixels: int) -> int:
    """How many links of either direction are followed in an image of so many pixels."""
    return max(256, pixels // 96)


def _followed(link_x, link_y, flank, most: int):
    """(the flank's links, then all of them as constants); without a flank (None, the links)."""
    if flank is None:
        return None, link_x, link_y
    return few_links(link_x, link_y, flank, most), *lax.stop_gradient((link_x, link_y))


@partial(jax.custom_vjp, nondiff_argnums=(7, 8))
def diffuse_stacks(stacks, link_x, link_y, budget, alive, flank, always, levels: int, sure: bool = False):
    """A tuple of plane stacks, each diffused for the time `budget`.

    stacks: each [C, H, W]; link_x, link_y, budget: as in `explicit`; alive: [H, W] bool, conductance > 0.
    flank: flags of the links along x and y that alone have a derivative, [H, W] where they begin; or None for all.
    always: a true predicate unknown at compile time, for `stored`.
    *Static*: levels: the fast scheme, for a budget of [1, 1], that merges blocks at most so often (`levels_for(sigma)`
        or more; exactly that many if `sure`); or -n, explicit steps, whose reverse mode
        keeps n levels of states (`heat.depth_for`).
    """
    return _diffuse(stacks, link_x, link_y, budget, alive, None, always, levels, sure)


def _pull(moving, arguments, alive, flank, always, levels, sure):
    """(the result, the function from its cotangent to those of `moving`), of which leaves of `arguments` are."""
    structure: Any = jax.tree.structure(arguments)
    leaves = jax.tree.leaves(arguments)

    def run(moving):
        stacks, x, y, budget = structure.unflatten([moving.get(i, leaf) for i, leaf in enumerate(leaves)])
        return _diffuse(stacks, x, y, budget, alive, flank, always, levels, sure)

    return jax.vjp(run, moving)


def _diffuse_fwd(stacks, link_x, link_y, budget, alive, flank, always, levels, sure):
    leaves = enumerate(jax.tree.leaves((stacks, link_x, link_y, budget)))
    moving = {i: leaf.value for i, leaf in leaves if leaf.perturbed}
    if not (link_x.perturbed or link_y.perturbed):
        flank = None
    arguments = stacks, link_x, link_y, budget
    arguments, alive, flank, always = jax.tree.map(lambda leaf: leaf.value, (arguments, alive, flank, always))
    out, pull = _pull(moving, arguments, alive, flank, always, levels, sure)
    return out, (pull, moving, arguments, alive, flank, always)


def _diffuse_bwd(levels, sure, saved, cotangents):
    pull, moving, arguments, alive, flank, always = saved
    cotangents = tuple(dense(c) for c in cotangents)
    if flank is None:
        (found,) = pull(cotangents)
    else:
        with_all = lambda bars: _pull(moving, arguments, alive, None, always, levels, sure)[1](bars)  # noqa: E731
        enough = jnp.maximum(*(jnp.sum(flags) for flags in flank)) <= _most(alive.size)
        (found,) = lax.cond(enough, pull, with_all, cotangents)
    structure: Any = jax.tree.structure(arguments)
    return *structure.unflatten([found.get(i) for i in range(structure.num_leaves)]), None, None, None


diffuse_stacks.defvjp(_diffuse_fwd, _diffuse_bwd, symbolic_zeros=True)


def levels_for(sigma: float) -> int:
    """How many times `fast` merges blocks for this sigma."""
    level, rest = 0, 0.5 * sigma * sigma
    while level < _LEVELS:
        step = STEP * 4.0**level
        rest -= 2 * step * _SMOOTHING[min(level, 1)] + 0.25 * 4.0**level
        if rest <= _WORTH * step:
            break
        level += 1
    return level
