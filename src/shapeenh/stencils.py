"""Image derivatives that never read across an insulated line or off the mask.

Planes are `[C, H, W]` arrays here (channel first: one fused pass serves all channels); x runs right, y runs *up*
(SPEC 1), so a row step is a step of -1 in y. Which neighbours may be read is said by *links*: weights in [0, 1]
between a pixel and its right neighbour (`link_x`, [H, W-1]) and its lower neighbour (`link_y`, [H-1, W]).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from shapeenh.fusion import stored
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
#
# Everything is padded once, so that all reads below are plain slices: `_at(a, dr, dc, rim)` is the image, and `rim`
# pixels around it, as seen (dr, dc) further down and right.

_MARGIN = 3


def _at(padded, dr: int, dc: int, rim: int):
    h, w = padded.shape[-2] - 2 * _MARGIN, padded.shape[-1] - 2 * _MARGIN
    top, left = _MARGIN - rim + dr, _MARGIN - rim + dc
    return padded[..., top : top + h + 2 * rim, left : left + w + 2 * rim]


def _along(planes, link, dr: int, dc: int):
    """The derivative towards (dr, dc), on the image and a rim of one pixel.

    Central where both neighbours may be read, (-3, 4, -1)/2 where one side is missing, a plain difference where the
    other side has but one pixel: second order everywhere but in the last case. Partial links blend the three.
    """
    f0, f1, f2, e1, e2 = (_at(planes, k * dr, k * dc, 1) for k in (0, 1, 2, -1, -2))
    ahead1, ahead2, behind1, behind2 = (_at(link, k * dr, k * dc, 1)[None] for k in (0, 1, -1, -2))
    forward, backward = f1 - f0, f0 - e1
    ahead = forward + 0.5 * ahead2 * (forward - (f2 - f1))
    behind = backward + 0.5 * behind2 * (backward - (e1 - e2))
    both = 0.5 * ahead1 * behind1
    return both * (forward + backward) + ahead1 * (1 - behind1) * ahead + behind1 * (1 - ahead1) * behind


def _known(link, dr: int, dc: int):
    """How far `_along` had anything to read, in [0, 1]."""
    return (1 - (1 - _at(link, 0, 0, 1)) * (1 - _at(link, -dr, -dc, 1)))[None]


def _across(derivative, known, link, dr: int, dc: int):
    """The derivative averaged 1:4:1 with its neighbours towards ±(dr, dc), where both are there; theirs, where a pixel
    has none.

    With these weights the leading error is h^2/6 grad(laplace f), the same in every direction; Sobel's 1:2:1 has a
    larger one that favours the axes. Averaging with one side alone would cost an order, hence all or nothing.
    """
    h, w = derivative.shape[-2] - 2, derivative.shape[-1] - 2

    def at(a, k):
        return a[..., 1 + k * dr : 1 + k * dr + h, 1 + k * dc : 1 + k * dc + w]

    ahead, behind = _at(link, 0, 0, 0)[None], _at(link, -dr, -dc, 0)[None]
    known_ahead, known_behind = ahead * at(known, 1), behind * at(known, -1)
    both = at(known, 0) * known_ahead * known_behind / 6
    borrow = (1 - at(known, 0)) / jnp.maximum(known_ahead + known_behind, 1e-6)
    return (
        (1 - 2 * both) * at(derivative, 0)
        + (both + borrow * ahead) * at(derivative, 1)
        + (both + borrow * behind) * at(derivative, -1)
    )


def derivatives(planes, link_x, link_y, always):
    """(d/dx, d/dy) of `[C, H, W]` planes in 1/px, y up, reading only along open links.

    Second order up to the outline; 0 where a pixel has no readable neighbour.
    always: a true predicate unknown at compile time, for `stored`.
    """
    m = _MARGIN

    def padded(planes, link_x, link_y):
        link_x = jnp.pad(link_x, ((m, m), (m, m + 1)))
        link_y = jnp.pad(link_y, ((m, m + 1), (m, m)))
        return jnp.pad(planes, [(0, 0), (m, m), (m, m)]), link_x, link_y

    def along(planes, link_x, link_y):
        return _along(planes, link_x, 0, 1), _along(planes, link_y, 1, 0)

    def across(d_x, d_y, link_x, link_y):
        return (
            _across(d_x, _known(link_x, 0, 1), link_y, 1, 0),
            -_across(d_y, _known(link_y, 1, 0), link_x, 0, 1),
        )

    planes, link_x, link_y = stored(always, padded, planes, link_x, link_y)
    d_x, d_y = stored(always, along, planes, link_x, link_y)
    return stored(always, across, d_x, d_y, link_x, link_y)
