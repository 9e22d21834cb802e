"""Anisotropic diffusion of image planes, dg/ds = div(c grad g) (Perona-Malik; LW09 4.3, SPEC 3.5 and 3.6).

The semi-discrete operator is A g (p) = sum over the four neighbours q of l_pq (g_q - g_p), with the links l_pq of
`stencils.links`. A is symmetric, its rows and columns sum to 0, its off-diagonal entries are not negative: hence the
three laws (nothing crosses a closed link, the sum over a connected region stays, no new extrema).

Planes are `[C, H, W]`. Imports `numerics`, `checks` and `stencils` only.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

# ------------------------------------------------------------------------------------------- the operator

STEP = 0.2  # at 1/4 a checkerboard would keep its amplitude (SPEC 3.5)
_SLOTS = 8  # states kept per level of the reverse sweep


def _jumps(planes):
    """g(right) - g and g(below) - g, the differences across every link."""
    return planes[:, :, 1:] - planes[:, :, :-1], planes[:, 1:] - planes[:, :-1]


def divergence(planes, link_x, link_y):
    """A g: what flows into every pixel per unit of time."""
    jump_x, jump_y = _jumps(planes)
    flow_x = jnp.pad(link_x[None] * jump_x, ((0, 0), (0, 0), (1, 1)))
    flow_y = jnp.pad(link_y[None] * jump_y, ((0, 0), (1, 1), (0, 0)))
    return flow_x[:, :, 1:] - flow_x[:, :, :-1] + flow_y[:, 1:] - flow_y[:, :-1]


# ------------------------------------------------------------------------------------------- explicit steps


def _share(budget, k):
    """How much of its time budget ([1, 1] or [H, W]) a pixel spends in step k: a full step, a short last one, or 0."""
    return jnp.clip(budget - k * STEP, 0, STEP)


def _steps(budget):
    return jnp.ceil(jnp.max(budget) / STEP - 1e-6).astype(jnp.int32)


def _forward(start, stop, planes, link_x, link_y, budget):
    def step(k, g):
        return g + _share(budget, k)[None] * divergence(g, link_x, link_y)

    return lax.fori_loop(start, stop, step, planes)


@jax.custom_vjp
def explicit(planes, link_x, link_y, budget):
    """`planes` after each pixel has spent its time `budget` in explicit steps of at most 1/5 (SPEC 3.5, 3.6).

    The number of steps is read at run time, so nothing recompiles when the budget changes; the last step is as
    short as it has to be, so the result is continuous in the budget.
    """
    return _forward(0, _steps(budget), planes, link_x, link_y, budget)


def _explicit_fwd(planes, link_x, link_y, budget):
    return explicit(planes, link_x, link_y, budget), (planes, link_x, link_y, budget)


def _explicit_bwd(saved, cotangent):
    """Reverse mode without storing every step.

    A is symmetric, so the cotangent is pulled back by the same operator: lam <- lam + A (dt lam). The derivative with
    respect to a link is -jump(dt lam) jump(g), and to a pixel's budget lam (A g), summed over the steps; they need g at
    every step, which is recomputed from kept states.
    """
    planes, link_x, link_y, budget = saved
    zero = (jnp.zeros_like(link_x), jnp.zeros_like(link_y), jnp.zeros_like(budget))
    carry = _reverse(0, _steps(budget), planes, (cotangent, zero), link_x, link_y, budget, level=4)
    lam, (d_x, d_y, d_budget) = carry
    return lam, d_x, d_y, d_budget


def _reverse_step(k, g, carry, link_x, link_y, budget):
    lam, (d_x, d_y, d_budget) = carry
    share = _share(budget, k)[None]
    pulled = share * lam
    lam_x, lam_y = _jumps(pulled)
    g_x, g_y = _jumps(g)
    partial_step = (budget - k * STEP > 0) & (budget - k * STEP <= STEP)
    gain = jnp.where(partial_step, jnp.sum(lam * divergence(g, link_x, link_y), axis=0), 0)
    if budget.shape == (1, 1):
        gain = jnp.sum(gain)[None, None]
    sums = (d_x - jnp.sum(lam_x * g_x, axis=0), d_y - jnp.sum(lam_y * g_y, axis=0), d_budget + gain)
    return lam + divergence(pulled, link_x, link_y), sums


def _reverse(start, count, g, carry, link_x, link_y, budget, *, level: int):
    """Pull `carry` back through `count` steps that begin at `start` with state `g`; keeps `_SLOTS` states per level."""
    span = _SLOTS ** (level - 1)

    def sweep(carry):
        pieces = (count + span - 1) // span

        def keep(i, kept):
            states, g = kept
            states = lax.dynamic_update_index_in_dim(states, g, i, 0)
            ahead = jnp.where(i + 1 < pieces, span, 0)
            first = start + i * span
            return states, _forward(first, first + ahead, g, link_x, link_y, budget)

        states, _ = lax.fori_loop(0, pieces, keep, (jnp.zeros((_SLOTS, *g.shape), g.dtype), g))

        def back(j, carry):
            i = pieces - 1 - j
            first, state = start + i * span, lax.dynamic_index_in_dim(states, i, 0, keepdims=False)
            if level == 1:
                return _reverse_step(first, state, carry, link_x, link_y, budget)
            length = jnp.minimum(span, count - i * span)
            return _reverse(first, length, state, carry, link_x, link_y, budget, level=level - 1)

        return lax.fori_loop(0, pieces, back, carry)

    if level == 1:
        return sweep(carry)
    shallow = partial(_reverse, level=level - 1)
    return lax.cond(count <= span, lambda c: shallow(start, count, g, c, link_x, link_y, budget), sweep, carry)


explicit.defvjp(_explicit_fwd, _explicit_bwd)
