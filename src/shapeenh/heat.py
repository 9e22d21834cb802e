"""Explicit steps of anisotropic diffusion, dg/ds = div(c grad g) (Perona-Malik; LW09 4.3, SPEC 3.5 and 3.6).

The semi-discrete operator is A g (p) = sum over the four neighbours q of l_pq (g_q - g_p), with the links l_pq of
`stencils.links`. A is symmetric, its rows and columns sum to 0, its off-diagonal entries are not negative: hence the
three laws (nothing crosses a closed link, the sum over a connected region stays, no new extrema).

Planes are `[C, H, W]`. Imports `fusion` only.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero

from shapeenh.fusion import stored

STEP = 0.2  # at 1/4 a checkerboard would keep its amplitude (SPEC 3.5)

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


@partial(jax.custom_vjp, nondiff_argnums=(5, 6))
def explicit(planes, link_x, link_y, budget, weight, step=STEP, slots=(8, 8, 8, 8, 8)):
    """`planes` after each pixel has spent its time `budget` in explicit steps (SPEC 3.5, 3.6).

    planes: [C, H, W]; link_x: [H, W-1]; link_y: [H-1, W]; budget: [1, 1] or [H, W], time in px^2, sigma = sqrt(2 time).
    weight: [1, 1] or [H, W], what a pixel makes of one unit of inflow (1, or 1/volume); no gradient.
    *Static*: step, the longest step; slots, how many states the reverse sweep keeps per level, coarsest first: their
        product bounds the number of steps that can be differentiated with respect to links.
    The number of steps is read at run time, so nothing recompiles when the budget changes; the last step is as
    short as it has to be, so the result is continuous in the budget.
    """
    return _forward(0, _count(budget, step), planes, (link_x, link_y, budget, weight), step)


# ------------------------------------------------------------------------------------------- reverse mode
#
# A is symmetric, so the cotangent lam is pulled back by the same operator, lam <- lam + A (dt lam): no state is needed.
# The derivative with respect to a pixel's budget is lam (A g) at its last, short step: that one A g per pixel is kept
# on the way forward. The derivative with respect to a link is -jump(dt lam) jump(g) summed over all steps: only where
# it is asked for is g computed again, from states kept at a few steps.


def _explicit_fwd(planes, link_x, link_y, budget, weight, step, slots):
    links_wanted, time_wanted = link_x.perturbed or link_y.perturbed, budget.perturbed
    planes, *fixed = (argument.value for argument in (planes, link_x, link_y, budget, weight))
    count = _count(fixed[2], step)
    if fixed[2].shape == (1, 1):
        last = jnp.maximum(count - 1, 0)
        states, g = _keep(0, count, last, planes, fixed, step, slots) if links_wanted else (None, None)
        g = _forward(0, last, planes, fixed, step) if g is None else g
        rate = divergence(g, *fixed[:2])
        out = _step(last, g, rate, fixed, step)
    else:
        states, out = _keep(0, count, count, planes, fixed, step, slots) if links_wanted else (None, None)
        out, rate = _forward_with_rate(planes, fixed, step) if time_wanted or out is None else (out, None)
    return out, (fixed, states, rate if time_wanted else None)


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
    fixed, states, rate = saved
    budget, weight = fixed[2:]
    if isinstance(lam, SymbolicZero):
        lam = jnp.zeros(lam.shape, lam.dtype)
    count = _count(budget, step)
    d_budget = None
    if rate is not None:
        d_budget = jnp.zeros_like(budget)
        if budget.shape == (1, 1):
            d_budget, rate = jnp.sum(weight[None] * lam * rate)[None, None], None
    sums = None if states is None else tuple(jnp.zeros_like(link) for link in fixed[:2])
    carry = lam, sums, d_budget
    if states is None:
        carry = lax.fori_loop(
            0, count, lambda j, carry: _reverse_step(count - 1 - j, None, carry, fixed, rate, step), carry
        )
    else:
        carry = _reverse(0, count, states, carry, fixed, rate, step, slots)
    lam, sums, d_budget = carry
    return lam, *(sums or (None, None)), d_budget, None


def _reverse_step(k, g, carry, fixed, rate, step):
    link_x, link_y, budget, weight = fixed
    lam, sums, d_budget = carry
    pulled = (_share(budget, k, step) * weight)[None] * lam
    if rate is not None:
        own = weight * _over_channels(lam * rate)
        d_budget = d_budget + jnp.where(_is_last(budget, k, step), own, 0)
    if sums is not None:
        lam_x, lam_y = _jumps(pulled)
        g_x, g_y = _jumps(g)
        sums = sums[0] - _over_channels(lam_x * g_x), sums[1] - _over_channels(lam_y * g_y)
    return lam + divergence(pulled, link_x, link_y), sums, d_budget


def _keep(start, count, stop, g, fixed, step, slots):
    """(g at the start of each stretch of prod(slots[1:]) steps, g after step `stop`), of `count` steps from `start`."""
    span = math.prod(slots[1:])

    def keep(i, kept):
        states, g = kept
        states = lax.dynamic_update_index_in_dim(states, g, i, 0)
        first = start + i * span
        return states, _forward(first, jnp.minimum(first + span, stop), g, fixed, step)

    return lax.fori_loop(0, (count + span - 1) // span, keep, (jnp.zeros((slots[0], *g.shape), g.dtype), g))


def _reverse(start, count, states, carry, fixed, rate, step, slots):
    """Pull `carry` back through `count` steps that begin at `start`, with the states that `_keep` kept of them."""
    span = math.prod(slots[1:])
    pieces = (count + span - 1) // span

    def back(j, carry):
        i = pieces - 1 - j
        first, g = start + i * span, stored(count > 0, lambda i: lax.dynamic_index_in_dim(states, i, 0, False), i)
        if span == 1:
            return _reverse_step(first, g, carry, fixed, rate, step)
        inner = jnp.minimum(span, count - i * span)
        last = first + (inner - 1) // math.prod(slots[2:]) * math.prod(slots[2:])
        finer, _ = _keep(first, inner, last, g, fixed, step, slots[1:])
        return _reverse(first, inner, finer, carry, fixed, rate, step, slots[1:])

    return lax.fori_loop(0, pieces, back, carry)


explicit.defvjp(_explicit_fwd, _explicit_bwd, symbolic_zeros=True)


def slots_for(steps: int, most: int = 8) -> tuple[int, ...]:
    """`slots` of `explicit` for up to `steps` steps, none above `most`."""
    depth = 1
    while most**depth < steps:
        depth += 1
    return (max(2, math.ceil(steps ** (1 / depth))),) * depth
