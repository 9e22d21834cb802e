"""Explicit steps of anisotropic diffusion, dg/ds = div(c grad g) (Perona-Malik; LW09 4.3, SPEC 3.5 and 3.6).

The semi-discrete operator is A g (p) = sum over the four neighbours q of l_pq (g_q - g_p), with the links l_pq of
`stencils.links`. A is symmetric, its rows and columns sum to 0, its off-diagonal entries are not negative: hence the
three laws (nothing crosses a closed link, the sum over a connected region stays, no new extrema).

Planes are `[C, H, W]`. Imports `fusion` and `sparse` only.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from shapeenh.fusion import stored
from shapeenh.sparse import FewLinks, dense, jumps_at

STEP = 0.2  # at 1/4 a checkerboard would keep its amplitude (SPEC 3.5)
REPLAYED = 4  # steps between the finest kept states: to take them again costs less than to store and load more states
SLOTS = 10  # states that the reverse sweep keeps at most per level

# ------------------------------------------------------------------------------------------- the operator


def _jumps(planes):
    """g(right) - g and g(below) - g, the differences across every link."""
    return planes[:, :, 1:] - planes[:, :, :-1], planes[:, 1:] - planes[:, :-1]


def _over_channels(planes):
    """Their sum; XLA on CPU takes ten times as long for `jnp.sum` over a short leading axis."""
    return sum(planes[i] for i in range(1, planes.shape[0])) + planes[0]


def divergence(planes, link_x, link_y):
    """A g: what flows into every pixel per unit of time."""
    jump_x, jump_y = _jumps(planes)
    flow_x = jnp.pad(link_x[None] * jump_x, ((0, 0), (0, 0), (1, 1)))
    flow_y = jnp.pad(link_y[None] * jump_y, ((0, 0), (1, 1), (0, 0)))
    return flow_x[:, :, 1:] - flow_x[:, :, :-1] + flow_y[:, 1:] - flow_y[:, :-1]


# ------------------------------------------------------------------------------------------- steps


def _share(budget, k, step):
    """How much of its time budget a pixel spends in step k: a full step, a short last one, or 0."""
    return jnp.clip(budget - k * step, 0, step)


def _count(budget, step):
    return jnp.ceil(jnp.max(budget) / step - 1e-6).astype(jnp.int32)


def _step(k, g, inflow, fixed, step):
    _, _, budget, weight = fixed
    return g + (_share(budget, k, step) * weight)[None] * inflow


def _forward(start, stop, g, fixed, step):
    return lax.fori_loop(start, stop, lambda k, g: _step(k, g, divergence(g, *fixed[:2]), fixed, step), g)


@partial(jax.custom_vjp, nondiff_argnums=(6, 7))
def explicit(planes, link_x, link_y, budget, weight, few=None, step=STEP, slots=(SLOTS,) * 4):
    """`planes` after each pixel has spent its time `budget` in explicit steps (SPEC 3.5, 3.6).

    planes: [C, H, W]; link_x: [H, W-1]; link_y: [H-1, W]; budget: [1, 1] or [H, W], time in px^2, sigma = sqrt(2 time).
    weight: [1, 1] or [H, W], what a pixel makes of one unit of inflow (1, or 1/volume); no gradient.
    few: None, or the links that alone have a derivative, and where it arrives: `link_x` and `link_y` are to be
        constants then.
    *Static*: step, the longest step; slots, how many states the reverse sweep keeps per level, coarsest first: the
        number of steps that can be differentiated with respect to links is at most REPLAYED times their product.
    The number of steps is read at run time, so nothing recompiles when the budget changes; the last step is as
    short as it has to be, so the result is continuous in the budget.
    """
    return _forward(0, _count(budget, step), planes, (link_x, link_y, budget, weight), step)


# ------------------------------------------------------------------------------------------- reverse mode
#
# A is symmetric. With one budget for all, a step takes g to g + dt w A g, and pulls a cotangent lam back to
# lam + dt A (w lam): the same step, of w lam. So the cotangent is diffused, and no state is needed.
# The derivative with respect to a pixel's budget is lam w (A g) at its last, short step: that one A g per pixel is kept
# on the way forward. The derivative with respect to a link is -jump(dt w lam) jump(g) summed over all steps. Of a few
# links the jumps of g are kept on the way forward. Of all, g is kept at some steps, and for the few up to the next
# taken anew each time.


def _explicit_fwd(planes, link_x, link_y, budget, weight, few, step, slots):
    links_wanted, time_wanted = link_x.perturbed or link_y.perturbed, budget.perturbed
    few_wanted = few is not None and any(value.perturbed for value in few.values)
    places = tuple(place.value for place in few.places) if few_wanted else None
    planes, *fixed = (argument.value for argument in (planes, link_x, link_y, budget, weight))
    count = _count(fixed[2], step)
    uniform = fixed[2].shape == (1, 1)
    last = jnp.maximum(count - 1, 0)
    stop = last if uniform else count
    states = kept = rate = None
    if few_wanted:
        kept, g = _forward_with_jumps(stop, planes, fixed, step, places, REPLAYED * math.prod(slots))
    else:
        states, g = _keep(count, stop, planes, fixed, step, slots, links_wanted)
    if uniform:
        rate = divergence(g, *fixed[:2])
        g = _step(last, g, rate, fixed, step)
    elif time_wanted:
        g, rate = _forward_with_rate(planes, fixed, step)
    return g, (fixed, states, (kept, places), rate if time_wanted else None)


def _keep(count, stop, planes, fixed, step, slots, wanted: bool):
    """(the states that the reverse sweep starts from, or None where they are not wanted; planes after step `stop`)."""
    if not wanted or len(slots) < 2:
        return planes if wanted else None, _forward(0, stop, planes, fixed, step)
    return _keep_states(0, count, stop, planes, fixed, step, slots)


def _forward_with_jumps(stop, g, fixed, step, places, most: int):
    """(the jumps of g at `places` before each of at most `most` steps and before step `stop`, g after that many)."""

    def keep(kept, g, k):
        return [lax.dynamic_update_index_in_dim(a, b, k, 0) for a, b in zip(kept, jumps_at(g, places), strict=True)]

    def one(k, carry):
        kept, g = carry
        g = _step(k, g, divergence(g, *fixed[:2]), fixed, step)
        return keep(kept, g, k + 1), g  # of the new g: the old one is overwritten

    kept = [jnp.zeros((most + 1, g.shape[0], place.size), g.dtype) for place in places]
    return lax.fori_loop(0, stop, one, (keep(kept, g, 0), g))


def _forward_with_rate(planes, fixed, step):
    """(planes at the end, A g at every pixel's last step)."""
    link_x, link_y, budget, _ = fixed

    def one(k, carry):
        g, rate = carry
        inflow = divergence(g, link_x, link_y)
        return _step(k, g, inflow, fixed, step), jnp.where(_is_last(budget, k, step)[None], inflow, rate)

    return lax.fori_loop(0, _count(budget, step), one, (planes, divergence(planes, link_x, link_y)))


def _is_last(budget, k, step):
    rest = budget - k * step
    return (rest > 0) & (rest <= step)


def _explicit_bwd(step, slots, saved, lam):
    fixed, states, (kept, places), rate = saved
    link_x, link_y, budget, weight = fixed
    lam = dense(lam)
    count, uniform = _count(budget, step), budget.shape == (1, 1)
    d_budget = None
    if rate is not None:
        d_budget = jnp.sum(weight[None] * lam * rate)[None, None] if uniform else jnp.zeros_like(budget)
    pulled = weight[None] * lam if uniform else lam
    sums = d_few = None
    if states is not None:
        sums = jnp.zeros_like(link_x), jnp.zeros_like(link_y)
        reverse = _reverse if len(slots) < 2 else _reverse_kept
        pulled, sums, d_budget = reverse(0, count, states, (pulled, sums, d_budget), fixed, rate, step, slots)
    elif kept is not None:
        jumps_of_g = lambda k: [lax.dynamic_index_in_dim(jumps, k, 0, False) for jumps in kept]  # noqa: E731
        jumps = jumps_of_g, partial(jumps_at, places=places)
        d_few = tuple(jnp.zeros(place.shape, lam.dtype) for place in places)
        pulled, d_few, d_budget = _sweep(0, count, (pulled, d_few, d_budget), fixed, rate, step, jumps, ahead=uniform)
    else:
        pulled, _, d_budget = _sweep(0, count, (pulled, None, d_budget), fixed, rate, step, None)
    if uniform:
        some = weight[None] > 0
        pulled = jnp.where(some, pulled / jnp.where(some, weight[None], 1), lam)
    few = None if d_few is None else FewLinks(d_few, (None, None))
    return pulled, *(sums or (None, None)), d_budget, None, few


def _sweep(start, count, carry, fixed, rate, step, jumps, ahead=False):
    """Pull `carry` (cotangent, sums of derivatives with respect to links, d_budget) back through steps, the last first.

    jumps: step -> the jumps of g before it, and planes -> their jumps; or None, and there are no sums.
    ahead: those of the cotangent are taken from the new one, for the next step, so that the old one can be overwritten;
        with one budget for all.
    """
    uniform = fixed[2].shape == (1, 1)

    def back(j, carry):
        k = start + count - 1 - j
        (pulled, sums, d_budget), across = carry
        pulled, d_budget, factor = _pull(k, pulled, d_budget, fixed, rate, step)
        if jumps is not None:
            share = _share(fixed[2][0, 0], k, step) if uniform else 1
            across = across if ahead else jumps[1](factor)
            products = [_over_channels(a * b) for a, b in zip(jumps[0](k), across, strict=True)]
            sums = tuple(total - share * product for total, product in zip(sums, products, strict=True))
        return (pulled, sums, d_budget), jumps[1](pulled) if ahead else None

    return lax.fori_loop(0, count, back, (carry, jumps[1](carry[0]) if ahead else None))[0]


def _pull(k, pulled, d_budget, fixed, rate, step):
    """One step back: (the cotangent, d_budget, what stands in the products with the jumps of g).

    With one budget for all, the cotangent is w lam and the last of these times the step; else it is lam, and dt w lam.
    """
    link_x, link_y, budget, weight = fixed
    if budget.shape == (1, 1):
        return _step(k, pulled, divergence(pulled, link_x, link_y), fixed, step), d_budget, pulled
    if rate is not None:
        own = weight * _over_channels(pulled * rate)
        d_budget = d_budget + jnp.where(_is_last(budget, k, step), own, 0)
    spent = (_share(budget, k, step) * weight)[None] * pulled
    return pulled + divergence(spent, link_x, link_y), d_budget, spent


def _span(slots) -> int:
    """How many steps lie between two states of the coarsest level."""
    return REPLAYED * math.prod(slots[1:])


def _keep_states(start, count, stop, g, fixed, step, slots):
    """(g every `_span` steps, g after step `stop`), of `count` steps from `start`."""
    span = _span(slots)

    def keep(i, kept):
        states, g = kept
        states = lax.dynamic_update_index_in_dim(states, g, i, 0)
        first = start + i * span
        return states, _forward(first, jnp.minimum(first + span, stop), g, fixed, step)

    return lax.fori_loop(0, (count + span - 1) // span, keep, (jnp.zeros((slots[0], *g.shape), g.dtype), g))


def _reverse_kept(start, count, states, carry, fixed, rate, step, slots):
    """Pull `carry` back through `count` steps that begin at `start`, with the states that `_keep_states` kept."""
    span = _span(slots)
    pieces = (count + span - 1) // span

    def back(j, carry):
        i = pieces - 1 - j
        first, g = start + i * span, stored(count > 0, lambda i: lax.dynamic_index_in_dim(states, i, 0, False), i)
        return _reverse(first, jnp.minimum(span, count - i * span), g, carry, fixed, rate, step, slots[1:])

    return lax.fori_loop(0, pieces, back, carry)


def _reverse(start, count, g, carry, fixed, rate, step, slots):
    """Pull `carry` back through `count` steps that begin at `start` with `g`."""
    if slots:
        span = _span(slots)
        states, _ = _keep_states(start, count, start + (count - 1) // span * span, g, fixed, step, slots)
        return _reverse_kept(start, count, states, carry, fixed, rate, step, slots)

    def jumps_of_g(k):
        return _jumps(_forward(start, k, g, fixed, step))

    return _sweep(start, count, carry, fixed, rate, step, (jumps_of_g, _jumps))


explicit.defvjp(_explicit_fwd, _explicit_bwd, symbolic_zeros=True)


def depth_for(steps: float, most: int = SLOTS) -> int:
    """How many levels of `most` states do for so many steps."""
    depth = 0
    while REPLAYED * most**depth < steps:
        depth += 1
    return depth


def slots_for(steps: int, most: int = SLOTS) -> tuple[int, ...]:
    """`slots` of `explicit` for up to `steps` steps, none above `most`."""
    depth = depth_for(steps, most)
    return (max(2, math.ceil((steps / REPLAYED) ** (1 / max(depth, 1)) - 1e-6)),) * depth
