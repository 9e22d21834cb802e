"""Cells of the fast diffusion: blocks of 2 x 2 pixels that stand for their pixels, and respect insulated lines.

Where an insulated line cuts through a block, one connected part of its pixels forms the cell; pixels cut off from it
join the cell of a neighbouring block that they are linked to, or else keep their value and wait for the smoothing.
A cell knows its volume (in pixels) and the length of its open border with the cell to its right and the one below.

Planes are `[C, H, W]`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from shapeenh.fusion import stored
from shapeenh.sparse import FewLinks, at, at_ends
from shapeenh.stencils import shift

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


def _merge(volume, border_x, border_y, role, always):
    """Volumes and borders of the cells."""
    across_x, across_y = stored(always, _across, border_x, border_y, role)
    volume = stored(always, _hand_over, volume, role)

    def add(volume, across_x, across_y):
        over_x, over_y = across_x[0::2] + across_x[1::2], across_y[1::2]
        return _over_blocks(volume), over_x[:, 1::2], over_y[:, 0::2] + over_y[:, 1::2]

    return stored(always, add, volume, across_x, across_y)


def merged(volume, border_x, border_y, spacing, always):
    """(the role of every pixel, the volume and the borders of the cells); all sizes rounded up to even ones."""
    v, x, y = (_even(plane, volume.shape) for plane in (volume, border_x, border_y))
    role = _roles(v, x, y, always, spacing=spacing)
    return role, _merge(v, x, y, role, always)


def averages(planes, volume, role, cell_volume, always):
    """The cells' averages of planes; volume: the pixels'."""

    def hand_over(planes, volume, role):
        return _hand_over(_even(planes * volume[None], volume.shape), role)

    def average(planes, volume):
        return _over_blocks(planes) / jnp.where(volume > 0, volume, 1)[None]

    return stored(always, average, stored(always, hand_over, planes, volume, role), cell_volume)


def filled(cells, planes, role, always):
    """`planes` with the value of its cell for every pixel that has one."""
    height, width = planes.shape[1:]

    def choose(blocks, planes, role):
        return _choose(blocks, _even(planes, (height, width)), role)[:, :height, :width]

    return stored(always, choose, stored(always, _blocks, cells), planes, role)


# ------------------------------------------------------------------------------------------- borders


def conduct(border, volume, beside, spacing, step):
    """Links between cells: border length over distance, but never so much that a step could overshoot."""
    return jnp.minimum(border / spacing, jnp.minimum(volume, beside) * (0.25 / step))


def conduct_few(few, volume, spacing, step):
    """The same of a few borders."""
    ends = zip(few.values, at_ends(volume, few.places), strict=True)
    return FewLinks(tuple(conduct(border, begin, end, spacing, step) for border, (begin, end) in ends), few.places)


def few_below(few, width: int, role, borders):
    """Of a few borders of an image of this width those that are borders of blocks, as such; the others are none."""
    values, places = [], []
    spots = tuple((place // width, place % width) for place in few.places)
    ends = at_ends(role, tuple(row * role.shape[1] + column for row, column in spots))
    for value, (row, column), (begin, end), odd, border in zip(few.values, spots, ends, (1, 0), borders, strict=True):
        across = ((row, column)[odd] % 2 == 1) & (begin == _CELL) & (end == _CELL)
        place = jnp.where(across, row // 2 * border.shape[1] + column // 2, border.size - 1)
        values.append(at(border, place) + (value - lax.stop_gradient(value)))
        places.append(place)
    return FewLinks(tuple(values), tuple(places))
