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

from shapeenh import stencils
from shapeenh.descriptor import cells
from shapeenh.fusion import stored
from shapeenh.heat import SLOTS, STEP, explicit, slots_for
from shapeenh.sparse import FewLinks, at_ends, dense, places_of, put_back, steep
from shapeenh.stencils import pair_mean, shift

GREATEST_SIGMA = 100.0

# ------------------------------------------------------------------------------------------- the fast scheme
#
# Once a few explicit steps have removed what is finer than 2 px, blocks of 2 x 2 pixels may stand for their pixels: a
# step there is four times as long and costs a quarter. So: smooth, average over blocks, go on (recursively) on the
# blocks, give every pixel its block's value, smooth again, which removes the blocks' edges. All are averages with
# non-negative weights, and symmetric ones.

_SMOOTHING = (4, 20)  # explicit steps before and after a descent: on pixels; on blocks of any size
_WORTH = 12  # a descent costs as much as about so many steps
_LEVELS = 2  # blocks of 4 x 4 pixels: there, even sigma = 100 takes a fraction of the other work


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


def _descend(stacks, level: int, time, grid, few, always, levels: int, sure: bool):
    """Diffuse a tuple of plane stacks on the cells of one level for `time`.

    grid: the volumes of the cells and their borders to the right and below.
    few: the borders that alone have a derivative, with that; or None for all.
    """
    volume, border_x, border_y = grid
    spacing = 2.0**level
    step = STEP * spacing**2
    smoothing = step * _SMOOTHING[min(level, 1)]
    rest = time - 2 * smoothing - 0.25 * spacing**2  # averaging over blocks spreads like a time of h^2 / 4
    if level == _LEVELS:  # too many steps to keep what they leave at single links
        border_x, border_y = put_back(few, border_x, border_y)
        few = None
    link_x = cells.conduct(border_x, volume, shift(volume, 1, -1), spacing, step)[:, :-1]
    link_y = cells.conduct(border_y, volume, shift(volume, 1, -2), spacing, step)[:-1]
    followed = few and cells.conduct_few(few, volume, spacing, step)
    if level == 0:
        weight = jnp.ones((1, 1), volume.dtype)
    else:
        weight = jnp.where(volume > 0, 1 / jnp.maximum(volume, 1), 0)
        link_x, link_y, weight = stored(always, lambda *planes: planes, link_x, link_y, weight)

    def smooth(stacks, time, steps):
        slots = slots_for(steps, SLOTS * 4**level)  # coarse states are small
        return tuple(explicit(planes, link_x, link_y, time, weight, followed, step, slots) for planes in stacks)

    direct = 2 * _SMOOTHING[min(level, 1)] + 2 + _WORTH  # steps that are not worth a descent
    if level == levels:
        return smooth(stacks, time, direct if levels < _LEVELS else math.ceil(0.5 * GREATEST_SIGMA**2 / step))

    def coarse(stacks):
        role, below = cells.merged(volume, border_x, border_y, spacing, always)
        few_below = few and cells.few_below(few, volume.shape[1], role, below[1:])
        aside = jnp.full((1, 1), smoothing, volume.dtype)
        stacks = smooth(stacks, aside, _SMOOTHING[min(level, 1)])
        lower = tuple(cells.averages(planes, volume, role, below[0], always) for planes in stacks)
        lower = _descend(lower, level + 1, rest, below, few_below, always, levels, sure)
        stacks = tuple(cells.filled(*pair, role, always) for pair in zip(lower, stacks, strict=True))
        return smooth(stacks, aside, _SMOOTHING[min(level, 1)])

    if sure:
        return coarse(stacks)
    return lax.cond(rest[0, 0] > _WORTH * step, coarse, lambda stacks: smooth(stacks, time, direct), stacks)


def _diffuse(stacks, links, few, alive, budget, always, levels: int, sure: bool):
    borders = jnp.pad(links[0], ((0, 0), (0, 1))), jnp.pad(links[1], ((0, 1), (0, 0)))
    if levels >= 0:
        grid = alive.astype(borders[0].dtype), *borders
        return _descend(stacks, 0, budget, grid, few, always, levels, sure)
    slots = (SLOTS,) * -levels
    if len(slots) > 2:  # more steps leave too much to keep
        borders = put_back(few, *borders)
        few = None
    link_x, link_y, one = borders[0][:, :-1], borders[1][:-1], jnp.ones((1, 1), borders[0].dtype)
    return tuple(explicit(planes, link_x, link_y, budget, one, few, STEP, slots) for planes in stacks)


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


def most_links(pixels: int, creases: bool) -> int:
    """How many links of a flank are followed, in either direction, in an image of so many pixels.

    Silhouettes are a few times as long as the image is wide, and one in four of their pixels is on a flank; creases of
    a detailed mesh are more.
    """
    return max(256, (8 if creases else 3) * math.isqrt(pixels))


@partial(jax.custom_vjp, nondiff_argnums=(6, 7, 8))
def diffuse_stacks(stacks, conductance, links, budget, flank, always, levels: int, sure: bool = False, most: int = 0):
    """A tuple of plane stacks, each diffused for the time `budget`.

    stacks: each [C, H, W]; conductance: [H, W]; links: those of the conductance, whose derivative goes to it;
    budget: as in `explicit`.
    flank: flags of the links along x and y that alone have a derivative, [H, W] where they begin; or None for all.
    always: a true predicate unknown at compile time, for `stored`.
    *Static*: levels: the fast scheme, for a budget of [1, 1], that merges blocks at most so often (`levels_for(sigma)`
        or more; exactly that many if `sure`); or -n, explicit steps, whose reverse mode keeps n levels of states
        (`heat.depth_for`). most: how many links of a flank are followed.
    """

    @jax.custom_batching.sequential_vmap  # of a batch one after the other: each has its own number of steps
    def diffused(stacks, alive, links, budget, always):
        return _diffuse(stacks, links, None, alive, budget, always, levels, sure)

    return diffused(stacks, conductance > 0, links, budget, always)


def _pull(moving, arguments, given, places, always, levels, sure):
    """(the result, the function from its cotangent to those of `moving`), of which leaves of `arguments` are.

    places: of the links that alone have a derivative, or None for all.
    """
    structure: Any = jax.tree.structure(arguments)
    leaves = jax.tree.leaves(arguments)
    alive = arguments[1] > 0

    def run(moving):
        stacks, c, budget = structure.unflatten([moving.get(i, leaf) for i, leaf in enumerate(leaves)])
        few, links = None, given
        if places is not None:
            few = FewLinks(tuple(pair_mean(*ends) for ends in at_ends(c, places)), places)
        elif len(arguments[0]) in moving:
            links = stencils.links(c)
        return _diffuse(stacks, links, few, alive, budget, always, levels, sure)

    return jax.vjp(run, moving)


def _diffuse_fwd(stacks, conductance, links, budget, flank, always, levels, sure, most):
    arguments = stacks, conductance, budget
    moving = {i: leaf.value for i, leaf in enumerate(jax.tree.leaves(arguments)) if leaf.perturbed}
    followed = flank is not None and conductance.perturbed
    arguments, links, flank, always = jax.tree.map(lambda leaf: leaf.value, (arguments, links, flank, always))
    flank = flank if followed else None
    structures: list[Any] = []  # of `pull`, which leaves `run` as arrays

    @jax.custom_batching.sequential_vmap  # as in `diffuse_stacks`
    def run(moving, arguments, links, flank, always):
        places = None if flank is None else places_of(flank, most)
        out, pull = _pull(moving, arguments, links, places, always, levels, sure)
        leaves, structure = jax.tree.flatten(pull)
        structures.append(structure)
        return out, leaves

    out, leaves = run(moving, arguments, links, flank, always)
    return out, (jax.tree.unflatten(structures[-1], leaves), moving, arguments, links, flank, always)


def _diffuse_bwd(levels, sure, most, saved, cotangents):
    structure: Any = jax.tree.structure(saved[2])

    @jax.custom_batching.sequential_vmap
    def run(saved, cotangents):
        pull, moving, arguments, links, flank, always = saved
        if flank is None:
            return pull(cotangents)[0]
        with_all = lambda bars: _pull(moving, arguments, links, None, always, levels, sure)[1](bars)[0]  # noqa: E731
        enough = jnp.maximum(*(jnp.sum(flags) for flags in flank)) <= most
        return lax.cond(enough, lambda bars: pull(bars)[0], with_all, cotangents)

    found = run(saved, tuple(dense(c) for c in cotangents))
    stacks, conductance, budget = structure.unflatten([found.get(i) for i in range(structure.num_leaves)])
    return stacks, conductance, None, budget, None, None


diffuse_stacks.defvjp(_diffuse_fwd, _diffuse_bwd, symbolic_zeros=True)
