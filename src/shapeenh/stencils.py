"""Image derivatives that never read across an insulated line or off the mask.

Planes are `[C, H, W]` arrays here (channel first: one fused pass serves all channels); x runs right, y runs *up*
(SPEC 1), so a row step is a step of -1 in y. Which neighbours may be read is said by *links*: weights in [0, 1]
between a pixel and its right neighbour (`link_x`, [H, W-1]) and its lower neighbour (`link_y`, [H-1, W]).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from shapeenh.numerics import safe_divide

# ------------------------------------------------------------------------------------------- neighbours


def shift(array, step: int, axis: int):
    """The value `step` pixels further along `axis` (step may be negative); 0 where that lies outside."""
    config = [(0, 0, 0)] * array.ndim
    config[axis] = (-step, step, 0)
    return lax.pad(array, jnp.zeros((), array.dtype), config)


def pair_mean(a, b):
    """Harmonic mean 2ab/(a+b): symmetric, and 0 as soon as one of them is 0 (SPEC 3.5); gradient 0 where both are 0."""
    return 2 * safe_divide(a * b, a + b)


def links(conductance):
    """`(link_x [H, W-1], link_y [H-1, W])`: the conductance between neighbouring pixels of a `[H, W]` image."""
    c = conductance
    return pair_mean(c[:, :-1], c[:, 1:]), pair_mean(c[:-1], c[1:])


# ------------------------------------------------------------------------------------------- first derivatives


def _along(planes, link, axis: int):
    """(derivative towards growing index along `axis`, weight in [0, 1] that says how far it could be had).

    Central where both neighbours may be read, (-3, 4, -1)/2 where one side is missing, a plain difference where the
    other side has but one pixel: second order everywhere but in the last case. Partial links blend the three.
    """
    open_ahead, open_behind = link, shift(link, -1, axis)
    ahead = shift(planes, 1, axis) - planes
    behind = shift(ahead, -1, axis)
    centred = 0.5 * (ahead + behind)
    one_sided_ahead = ahead + 0.5 * shift(link, 1, axis) * (ahead - shift(ahead, 1, axis))
    one_sided_behind = behind + 0.5 * shift(link, -2, axis) * (behind - shift(ahead, -2, axis))
    derivative = (
        open_ahead * open_behind * centred
        + open_ahead * (1 - open_behind) * one_sided_ahead
        + open_behind * (1 - open_ahead) * one_sided_behind
    )
    return derivative, 1 - (1 - open_ahead) * (1 - open_behind)


def _across(derivative, known, link, axis: int):
    """The derivative averaged 1:4:1 with its neighbours across, where both are there; theirs, where a pixel has none.

    With these weights the leading error is h^2/6 grad(laplace f), the same in every direction; Sobel's 1:2:1 has a
    larger one that favours the axes. Averaging with one side alone would cost an order, hence all or nothing.
    """
    open_ahead, open_behind = link, shift(link, -1, axis)
    ahead, behind = shift(derivative, 1, axis), shift(derivative, -1, axis)
    known_ahead, known_behind = open_ahead * shift(known, 1, axis), open_behind * shift(known, -1, axis)
    both = known * known_ahead * known_behind
    theirs = safe_divide(open_ahead * ahead + open_behind * behind, known_ahead + known_behind)
    return derivative + (both / 6) * (ahead + behind - 2 * derivative) + (1 - known) * theirs


def derivatives(planes, link_x, link_y):
    """(d/dx, d/dy) of `[C, H, W]` planes in 1/px, y up, reading only along open links.

    Second order up to the outline; 0 where a pixel has no readable neighbour.
    """
    link_x = jnp.pad(link_x, ((0, 0), (0, 1)))[None]
    link_y = jnp.pad(link_y, ((0, 1), (0, 0)))[None]
    dx, known_x = _along(planes, link_x, 2)
    dy, known_y = _along(planes, link_y, 1)
    return _across(dx, known_x, link_y, 1), -_across(dy, known_y, link_x, 2)
