"""Image derivatives that never read across an insulated line or off the mask.

Planes are `[C, H, W]` arrays here (channel first: one fused pass serves all channels); x runs right, y runs *up*
(SPEC 1), so a row step is a step of -1 in y. Which neighbours may be read is said by *links*: weights in [0, 1]
between a pixel and its right neighbour (`link_x`, [H, W-1]) and its lower neighbour (`link_y`, [H-1, W]).
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from shapeenh.fusion import stored
from shapeenh.numerics import safe_divide
from shapeenh.sparse import dense, pull_to, steep

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


# ------------------------------------------------------------------------------------------- windows
#
# The transpose of reading a neighbour is writing to it; as autodiff writes it down that is one padded copy per
# neighbour, which XLA on CPU evaluates pixel by pixel with a branch for each: reverse mode took 20 times the forward
# time. But a stencil can be transposed into a stencil: what a pixel gets is the sum, over the places that read it, of
# their derivatives, and these may be computed again from their own neighbourhoods.
#
# A domain is (top, bottom, left, right): how many rows and columns an array has beyond the image, or lacks if negative.

WHOLE = (0, 0, 0, 0)


def _grow(domain, by: int):
    return tuple(side + by for side in domain)


def _slice(array, held, domain, offset):
    """What an array that covers `held` shows at `offset` from every pixel of `domain`."""
    top, left = held[0] - domain[0] + offset[0], held[2] - domain[2] + offset[1]
    height = array.shape[0] - held[0] - held[1] + domain[0] + domain[1]
    width = array.shape[1] - held[2] - held[3] + domain[2] + domain[3]
    return array[top : top + height, left : left + width]


def _widen(array, held, domain):
    """The array on a larger domain, 0 there."""
    grow = [domain[i] - held[i] for i in range(4)]
    return jnp.pad(array, (tuple(grow[:2]), tuple(grow[2:])))


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2, 3))
def window(point, offsets, held, domain, always, *arrays):
    """`point(values...)` at every pixel of `domain`, a tuple of arrays, as a border of fusion.

    *Static*: point, which takes, array by array and offset by offset, what is there, and works on each pixel by itself;
        offsets, per array a tuple of (down, right); held, per array its domain, which has to hold all that is read.
    always: a true predicate unknown at compile time; arrays: each [H + ..., W + ...] floats.
    Gradient: exact, in reverse mode; as a stencil too, computed only for the arrays that it is asked for.
    """
    return stored(always, partial(_evaluate, point, offsets, held, domain), *arrays)


def _evaluate(point, offsets, held, domain, *arrays):
    triples = zip(arrays, offsets, held, strict=True)
    return point(*(_slice(array, own, domain, offset) for array, reads, own in triples for offset in reads))


def _window_fwd(point, offsets, held, domain, always, *arrays):
    values = [array.value for array in arrays]
    wanted = tuple(() if array.perturbed else None for array in arrays)
    return window(point, offsets, held, domain, always.value, *values), (always.value, values, wanted)


def _window_bwd(point, offsets, held, domain, saved, cotangents):
    always, arrays, wanted = saved
    reach = max(max(map(abs, offset)) for reads in offsets for offset in reads)
    wide = _grow([max(sides) for sides in zip(domain, *held, strict=True)], reach)
    wider = _grow(wide, reach)

    def padded(arrays, cotangents):
        arrays = [_widen(array, own, wider) for array, own in zip(arrays, held, strict=True)]
        return arrays, [_widen(bar, domain, wide) for bar in cotangents]

    def pulled(arrays, cotangents):
        values = [_slice(a, wider, wide, offset) for a, reads in zip(arrays, offsets, strict=True) for offset in reads]
        _, pull = jax.vjp(point, *values)
        bars = iter(pull(tuple(cotangents)))
        totals = []
        for reads, own, asked in zip(offsets, held, wanted, strict=True):
            found = [(next(bars), offset) for offset in reads]
            if asked is not None:
                totals.append(sum(_slice(bar, wide, own, (-down, -right)) for bar, (down, right) in found))
        return totals

    cotangents = [dense(c) for c in cotangents]
    totals = iter(stored(always, pulled, *stored(always, padded, arrays, cotangents)))
    return None, *(None if asked is None else next(totals) for asked in wanted)


window.defvjp(_window_fwd, _window_bwd, symbolic_zeros=True)

# ------------------------------------------------------------------------------------------- first derivatives


def _one_sided(f0, f1, f2, e1, e2, ahead1, ahead2, behind1, behind2):
    """The derivative from values at 0, 1, 2, -1, -2 and the links between them.

    Central where both neighbours may be read, (-3, 4, -1)/2 where one side is missing, a plain difference where the
    other side has but one pixel: second order everywhere but in the last case. Partial links blend the three.
    """
    forward, backward = f1 - f0, f0 - e1
    ahead = forward + 0.5 * ahead2 * (forward - (f2 - f1))
    behind = backward + 0.5 * behind2 * (backward - (e1 - e2))
    both = 0.5 * ahead1 * behind1
    return both * (forward + backward) + ahead1 * (1 - behind1) * ahead + behind1 * (1 - ahead1) * behind


def _along(*values):
    """Of each plane the derivatives to the right and down."""
    links_x, links_y = values[-8:-4], values[-4:]
    d_x, d_y = [], []
    for i in range(0, len(values) - 8, 9):
        centre, right, down = values[i : i + 1], values[i + 1 : i + 5], values[i + 5 : i + 9]
        d_x.append(_one_sided(*centre, *right, *links_x))
        d_y.append(_one_sided(*centre, *down, *links_y))
    return (*d_x, *d_y)


def _averaged(known, link_ahead, link_behind, *derivatives):
    """Derivatives (here, ahead, behind) averaged 1:4:1 across their direction where both neighbours are there; the
    neighbours' where a pixel has none.

    With these weights the leading error is h^2/6 grad(laplace f), the same in every direction; Sobel's 1:2:1 has a
    larger one that favours the axes. Averaging with one side alone would cost an order, hence all or nothing.
    known: how far each of the three had anything to read, in [0, 1].
    """
    known_ahead, known_behind = link_ahead * known[1], link_behind * known[2]
    both = known[0] * known_ahead * known_behind / 6
    borrow = (1 - known[0]) / jnp.maximum(known_ahead + known_behind, 1e-6)
    here, ahead, behind = 1 - 2 * both, both + borrow * link_ahead, both + borrow * link_behind
    return [here * d[0] + ahead * d[1] + behind * d[2] for d in derivatives]


def _across(*values):
    """The derivatives of each plane averaged across, y up."""
    y0, y_up, y_right, y_right_up, y_left, y_left_up, x0, x_left, x_down, x_down_left, x_up, x_up_left = values[-12:]
    known_x = [1 - (1 - a) * (1 - b) for a, b in ((x0, x_left), (x_down, x_down_left), (x_up, x_up_left))]
    known_y = [1 - (1 - a) * (1 - b) for a, b in ((y0, y_up), (y_right, y_right_up), (y_left, y_left_up))]
    triples = [values[i : i + 3] for i in range(0, len(values) - 12, 3)]
    d_x = _averaged(known_x, y0, y_up, *triples[: len(triples) // 2])
    d_y = _averaged(known_y, x0, x_left, *triples[len(triples) // 2 :])
    return (*d_x, *(-d for d in d_y))


_MARGIN, _RIM = _grow(WHOLE, 3), _grow(WHOLE, 1)
_STAR = ((0, 0), *((0, k) for k in (1, 2, -1, -2)), *((k, 0) for k in (1, 2, -1, -2)))


def derivatives(planes, link_x, link_y, always):
    """(d/dx, d/dy), two tuples of planes, of planes [H, W] in 1/px, y up, reading only along open links.

    Second order up to the outline; 0 where a pixel has no readable neighbour.
    always: a true predicate unknown at compile time, for `stored`.
    Gradient: with respect to planes and links, in reverse mode.
    """
    count, m = len(planes), _MARGIN[0]

    def padded(planes, link_x, link_y):
        link_x = jnp.pad(link_x, ((m, m), (m, m + 1)))
        link_y = jnp.pad(link_y, ((m, m + 1), (m, m)))
        return [jnp.pad(plane, m) for plane in planes], link_x, link_y

    # plane by plane: a derivative with respect to links, which all planes share, is a sum over planes, and XLA on CPU
    # takes ten times as long for it over an axis as over separate arrays
    planes, link_x, link_y = stored(always, padded, [planes[i] for i in range(count)], link_x, link_y)
    reads = (*(_STAR,) * count, tuple((0, k) for k in (0, 1, -1, -2)), tuple((k, 0) for k in (0, 1, -1, -2)))
    d = window(_along, reads, (_MARGIN,) * (count + 2), _RIM, always, *planes, link_x, link_y)

    down, right = ((0, 0), (1, 0), (-1, 0)), ((0, 0), (0, 1), (0, -1))
    of_y = tuple(spot for k in (0, 1, -1) for spot in ((0, k), (-1, k)))
    of_x = tuple(spot for k in (0, 1, -1) for spot in ((k, 0), (k, -1)))
    reads = (*(down,) * count, *(right,) * count, of_y, of_x)
    d = window(_across, reads, (*(_RIM,) * (2 * count), _MARGIN, _MARGIN), WHOLE, always, *d, link_y, link_x)
    return d[:count], d[count:]


@jax.custom_vjp
def derivatives_beside(stacks, link_x, link_y, conductance, always):
    """`derivatives` of each of a tuple of tuples of planes, where the links are `links(conductance)` and their
    derivative is to arrive there. One tuple after the other holds less memory at a time.

    Gradient: with respect to planes, and to the conductance where that is between 0 and 1 (it has none elsewhere if it
        comes from a smoothstep); in reverse mode.
    """
    return tuple(derivatives(planes, link_x, link_y, always) for planes in stacks)


def _beside_fwd(stacks, link_x, link_y, conductance, always):
    wanted = () if conductance.perturbed else None
    values = jax.tree.map(lambda leaf: leaf.value, (stacks, link_x, link_y, conductance, always))
    return derivatives_beside(*values), (*values, wanted)


def _beside_bwd(saved, cotangents):
    stacks, link_x, link_y, conductance, always, wanted = saved
    planes = tuple(jax.tree.leaves(stacks))
    d_x, d_y = ([dense(bar) for pair in cotangents for bar in pair[i]] for i in (0, 1))
    _, pull = jax.vjp(lambda planes: derivatives(planes, link_x, link_y, always), planes)
    pulled = jax.tree.unflatten(jax.tree.structure(stacks), *pull((tuple(d_x), tuple(d_y))))
    found = None
    if wanted is not None:

        def both(always, conductance, *planes):
            link_x, link_y = links(conductance)
            d_x, d_y = derivatives(planes, link_x, link_y, always)
            return *d_x, *d_y

        (found,) = pull_to(steep(conductance), 2, both, (conductance,), planes, (*d_x, *d_y), always)
    return pulled, None, None, found, None


derivatives_beside.defvjp(_beside_fwd, _beside_bwd, symbolic_zeros=True)
