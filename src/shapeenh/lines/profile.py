"""The height profile across the feature line that lies nearest to each pixel (TH10 7.2.2 and 7.2.3, SPEC 9).

A pixel x reads 2k + 1 heights on the straight line x + t theta(x), and a cubic is fitted to them. Where the cubic has a
maximum there is the skeleton; how far it is, how high, and how sharply curved, is all that brushes need to know.
No eigenvectors, no systems to solve per pixel: the least-squares matrix is one constant.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.checks import check_choice, check_range, check_shape, check_size, check_type, float_dtype, is_concrete
from shapeenh.fusion import stored, unknown_truth
from shapeenh.lines.candidates import (
    CHUNK,
    FREE,
    GAMMA_MAX,
    HELD,
    candidates_of,
    list_flagged,
    list_pixels,
    looked_at,
    pixels_of,
    planes_of,
    read,
)
from shapeenh.lines.tiles import different
from shapeenh.numerics import normalize, smoothstep
from shapeenh.sparse import dense
from shapeenh.types import LineField, Profile

LEAST_REACH = 1.0  # px: a neighbourhood narrower than this shows no neighbour on either side, hence no profile


def fit_profile(field, *, radius: float = 4.0, samples: int = 9, least=0.0) -> Profile:
    """The distance to the nearest skeleton along the direction field, and the profile's height and curvature there.

    Source: TH10 7.2.2, 7.2.3; SPEC 9.2 to 9.4. The neighbourhood of a pixel shrinks, alike on both sides, so that it
    ends where the singularity accumulated outwards reaches 1. A cubic is fitted to the heights, and its *maximum* is
    the skeleton; there is none where the cubic has no maximum within the neighbourhood, where less than 1 px of it is
    left, or where all that varies is rounding.

    Args:
        field: LineField [H, W]. Pixels whose height or direction is not finite are singular; where the direction is 0
            there is no line. Reversing directions, pixel by pixel, only reverses the sign of `distance`.
        radius: px, in [1, 32], half the length of a neighbourhood.
        samples: heights read along it, odd, 5 to 65.
        least: [], finite or -inf; profiles that are not higher are no lines. What can be no higher is not looked at, so
            a threshold makes the fit as cheap as the lines are few.

    Static: radius, samples.
    Returns: Profile [H, W]; all fields are 0, and `valid` False, where no skeleton was found.
    Gradient: with respect to height, direction and singularity, finite everywhere; 0 where not valid. None through
        which pixels are valid. In reverse mode alone.
    Errors: ValueError for fields whose shapes disagree, and for numbers out of range.

    >>> profile = se.fit_profile(se.line_field("ridge", gbuffer, descriptor))
    >>> skeleton = profile.valid & (abs(profile.distance) < 0.5)
    """
    check_type("field", field, LineField)
    check_shape("field.height", field.height, (None, None))
    h, w = np.shape(field.height)
    check_shape("field.direction", field.direction, (h, w, 2))
    check_shape("field.singularity", field.singularity, (h, w))
    if not is_concrete(radius):
        raise ValueError("radius is a traced value; accepted is a Python number, since it decides the number of steps")
    check_range("radius", radius, 1, 32)
    samples = check_size("samples", samples, low=5, high=65)
    check_choice("samples % 2", samples % 2, (1,))
    check_shape("least", least, ())
    if is_concrete(least) and (np.isnan(least) or least == np.inf):
        raise ValueError(f"least is {least}; accepted are finite numbers and -inf")
    dtype = float_dtype(field.height)
    concrete = is_concrete(field, least)
    least = np.asarray(least, dtype) if concrete else jnp.asarray(least, dtype)
    options = {"radius": float(radius), "samples": samples}
    if h == 0 or w == 0:
        raise ValueError(f"field.height has shape {(h, w)}; accepted are images of at least one pixel")
    if not concrete:
        return _fit_traced(field, least, **options)
    planes, candidates = looked_at(field, least, float(radius))
    listed, counts = list_pixels(np.asarray(candidates))
    return _fit_listed(planes, field.direction, listed, counts, least, **options)


@partial(jax.jit, static_argnames=("radius", "samples"))
def _fit_listed(planes, direction, listed, counts, least, *, radius, samples) -> Profile:
    """`_fit` at the listed pixels alone, in chunks that stay in the cache."""
    h, w = direction.shape[:2]
    always = unknown_truth(planes[0], least)

    def chunk(k, out, *, held):
        index = lax.dynamic_slice_in_dim(listed, k * CHUNK, CHUNK)
        inside = jnp.minimum(index, h * w - 1)
        x, y = stored(always, lambda index: normalize(direction.reshape(h * w, 2)[index]).T, inside)
        return _written(out, index, _fit_at((radius, samples), (*planes, x, y), inside, w, least, held))

    out = _nothing(planes[0], h * w, least)
    out = lax.fori_loop(0, counts[0], partial(chunk, held=False), out)
    out = lax.fori_loop(counts[0], counts[0] + counts[1], partial(chunk, held=True), out)
    return Profile(*(o.reshape(h, w) for o in out))


def _nothing(height, size: int, least):
    """Where no profile was found, as [H * W]."""
    return *(jnp.full(size, b, height.dtype) for b in different((0, 0, 0), least)), jnp.zeros(size, bool)


def _written(out, index, found):
    return tuple(o.at[index].set(f, mode="drop") for o, f in zip(out, found, strict=True))


# ------------------------------------------------------------------------------------------- under a transformation


@partial(jax.jit, static_argnames=("radius", "samples"))
def _fit_traced(field, least, *, radius, samples) -> Profile:
    """`_fit` where there may be a profile, listed at run time. Gradient: in reverse mode, where there is one."""
    planes = planes_of(field)
    constant = lax.stop_gradient((planes, least))
    candidates = stored(unknown_truth(planes[0], least), partial(candidates_of, radius=radius), *constant)
    return Profile(*_profiles((radius, samples), planes, least, candidates))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _profiles(how, planes, least, candidates):
    """(distance, height, curvature, valid), [H, W], of what `planes_of` and `candidates_of` return."""
    shape = candidates.shape

    def chunk(out, index, inside, held):
        values = _at_pixels(planes, inside)
        return _written(out, index, _fit_at(how, values, inside, shape[1], least, held))

    out = _each_chunk(chunk, _nothing(planes[0], candidates.size, least), candidates, candidates > 0)
    return tuple(o.reshape(shape) for o in out)


def _at_pixels(planes, inside):
    """Heights and singularities, which are read anywhere, and the directions of the pixels."""
    return *planes[:2], *(plane.ravel().at[inside].get(mode="promise_in_bounds") for plane in planes[2:])


def _fit_at(how, values, inside, width: int, least, held):
    radius, samples = how
    *planes, x, y = values
    return _fit(planes, inside // width, inside % width, x, y, least, radius=radius, samples=samples, held=held)


def _each_chunk(function, carry, candidates, flags):
    """`function(carry, pixels, the same within the image, held)` over all flagged pixels, and others beyond the image;
    those near singularities last, since only their neighbourhoods may have to end."""
    size, candidates = candidates.size, jnp.where(flags, candidates, 0)
    for kind, held in ((FREE, False), (HELD, True)):
        runs, chunks = list_flagged(candidates == kind)

        def step(k, carry, runs=runs, kind=kind, held=held):
            index = pixels_of(runs, k)
            inside = jnp.minimum(index, size - 1)
            index = jnp.where(candidates.ravel()[inside] == kind, index, size)
            return function(carry, index, inside, held)

        carry = lax.fori_loop(0, chunks, step, carry)
    return carry


def _profiles_forward(how, planes, least, candidates):
    wanted = tuple(() if plane.perturbed else None for plane in planes)
    planes, least, candidates = tuple(p.value for p in planes), least.value, candidates.value
    found = _profiles(how, planes, least, candidates)
    return found, (planes, least, candidates, found[3], wanted)


def _profiles_backward(how, saved, cotangents):
    planes, least, candidates, valid, wanted = saved
    shape = candidates.shape
    bars = [dense(bar).ravel() for bar in cotangents[:3]]
    asked = [k for k, want in enumerate(wanted) if want is not None]

    def chunk(found, index, inside, held):
        values = _at_pixels(planes, inside)

        def fit(some):
            chosen = [some.get(k, value) for k, value in enumerate(values)]
            return _fit_at(how, chosen, inside, shape[1], least, held)[:3]

        given = tuple(jnp.where(index < candidates.size, bar[inside], 0) for bar in bars)
        (pulled,) = jax.vjp(fit, {k: values[k] for k in asked})[1](given)
        for k, bar in pulled.items():
            found[k] = found[k] + bar if k < 2 else found[k].at[index].set(bar, mode="drop")
        return found

    found = {k: jnp.zeros_like(planes[k] if k < 2 else bars[0]) for k in asked}
    found = _each_chunk(chunk, found, candidates, valid)
    return tuple(found[k].reshape(planes[k].shape) if k in found else None for k in range(4)), None, None


_profiles.defvjp(_profiles_forward, _profiles_backward, symbolic_zeros=True)


# ------------------------------------------------------------------------------------------- the profile


def _barrier(gamma):
    """What a sample adds to the accumulated singularity.

    Sums of unit steps measure how thick a singularity is, and a diagonal line of single pixels is but 0.7 thick: as
    printed it would let trajectories through. Strong singularities count up to three times, so that none does.
    """
    return jnp.minimum(gamma * (1 + 2 * smoothstep(0.1, 0.3, gamma)), 1)


def _along(plane, row, col, theta_x, theta_y, t):
    """Reads at x + t theta(x), [len(t), ...]; t: [S] or [S, ...], px."""
    t = t.reshape(t.shape + (1,) * (row.ndim + 1 - t.ndim))
    return read(plane, row[None] - t * theta_y[None], col[None] + t * theta_x[None])


def _reach(singular, row, col, theta_x, theta_y, radius: float):
    """How far, in px, a neighbourhood extends on both sides before a singularity ends it (TH10 7.2.2).

    A bilinear read sees a pixel from 1 px away, so it ends that much before the place where the sum reaches its limit.
    """
    steps = int(np.ceil(radius))
    t = radius / steps * np.arange(-steps, steps + 1)
    added = _barrier(_along(singular, row, col, theta_x, theta_y, jnp.asarray(t, row.dtype)))
    return _until(radius, added)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _until(radius: float, added):
    """The reach, from what each sample adds, [2 steps + 1, ...]: where the sum from the middle outwards first meets its
    limit, between two samples. Gradient: reverse mode; by the samples up to there, on the side that ends it."""
    return _ending(radius, added)[0]


def _ending(radius: float, added):
    """(reach, the number of the sample at which the sum passes the limit, counted from the middle, 0 if none does; the
    part of that sample which it takes; the inverse of what that sample adds)."""
    steps = added.shape[0] // 2
    step, limit = radius / steps, GAMMA_MAX * (1 - 1e-3)
    start = added[steps]
    reach = jnp.where(start < limit, radius, 0.0).astype(added.dtype)
    last, part, inverse = (jnp.zeros_like(reach) for _ in range(3))
    for side in (1, -1):
        total = start
        for i in range(1, steps + 1):
            before, total = total, total + added[steps + side * i]
            crosses = (before < limit) & (total >= limit)
            slope = 1 / jnp.where(crosses, total - before, 1)
            share = (limit - before) * slope
            end = (i - 1 + share) * step - 1
            nearer = crosses & (end < reach)
            reach, last = jnp.where(nearer, end, reach), jnp.where(nearer, side * i, last)
            part, inverse = jnp.where(nearer, share, part), jnp.where(nearer, slope, inverse)
    return reach, last, part, inverse


def _until_forward(radius, added):
    reach, *ending = _ending(radius, added)
    return reach, ending


def _until_backward(radius, ending, cotangent):
    last, part, inverse, cotangent = (a[None] for a in (*ending, cotangent))
    steps = int(np.ceil(radius))
    number = np.arange(-steps, steps + 1, dtype=last.dtype).reshape(-1, *(1,) * (last.ndim - 1))
    before = (np.sign(number) * last >= 0) & (np.abs(number) < jnp.abs(last))  # none where last is 0
    share = jnp.where(number == last, part, before.astype(last.dtype))
    return (share * (-radius / steps * inverse * cotangent),)


_until.defvjp(_until_forward, _until_backward)


def least_squares_matrix(samples: int) -> np.ndarray:
    """[4, samples]: heights at t = -1 .. 1 to the cubic's coefficients a, b, c, d, of t^3, t^2, t, 1 (TH10 7.2.3)."""
    t = np.linspace(-1, 1, samples)
    return np.linalg.pinv(np.stack([t**3, t**2, t, np.ones_like(t)], axis=1))


def _cubic(height, row, col, theta_x, theta_y, reach, samples: int):
    """(a, b, c, d, size): the least-squares cubic of the heights, t = -1 .. 1 over ±reach, and the largest |height|.

    Pairs of samples are added and subtracted first: b and d see the even part alone, a and c the odd one. Heights are
    taken relative to the middle one, so that a small relief on a large height keeps its digits.
    """
    k = samples // 2
    matrix = least_squares_matrix(samples)
    share = jnp.asarray(np.arange(-k, k + 1) / k, reach.dtype).reshape(-1, *(1,) * reach.ndim)
    heights = _along(height, row, col, theta_x, theta_y, share * reach[None])
    middle, size = heights[k], jnp.max(jnp.abs(heights), axis=0)
    a, b, c, d = (jnp.zeros_like(middle) for _ in range(4))
    for i in range(1, k + 1):
        ahead, behind = heights[k + i] - middle, heights[k - i] - middle
        m = [float(v) for v in matrix[:, k + i]]
        a, b = a + m[0] * (ahead - behind), b + m[1] * (ahead + behind)
        c, d = c + m[2] * (ahead - behind), d + m[3] * (ahead + behind)
    return a, b, c, d + middle, size


def _fit(planes, row, col, theta_x, theta_y, least, *, radius: float, samples: int, held: bool = True):
    """(distance, height, curvature, valid) at integer pixels, as arrays of any shape.

    held: whether singularities may end the neighbourhood; without, nothing is read to find out.
    """
    height, singular = planes[:2]
    dtype = height.dtype
    row, col = row.astype(dtype), col.astype(dtype)
    defined = (theta_x != 0) | (theta_y != 0)
    reach = _reach(singular, row, col, theta_x, theta_y, radius) if held else jnp.full_like(row, radius)
    a, b, c, d, size = _cubic(height, row, col, theta_x, theta_y, reach, samples)

    # In units of the largest coefficient nothing over- or underflows; the root does not depend on the unit.
    unit = lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(a), jnp.abs(b)), jnp.abs(c)))
    usable = defined & (reach >= LEAST_REACH * (1 - 1e-3)) & (unit > 32 * jnp.finfo(dtype).eps * size)
    unit = jnp.where(usable, unit, 1)
    a, b, c = (jnp.where(usable, v / unit, 0) for v in (a, b, c))

    # p' = 3 a t^2 + 2 b t + c; of its two roots t_x = (-b - sqrt(D))/(3 a) = c/(-b + sqrt(D)) is the maximum, since
    # there p'' = 6 a t + 2 b = -2 sqrt(D). The first form cancels for b < 0, the second for b > 0, where a = 0 means
    # that there is no maximum.
    discriminant = b * b - 3 * a * c
    usable &= discriminant > 1e-6
    root = jnp.sqrt(jnp.where(usable, discriminant, 1))
    falling = b <= 0
    above, below = jnp.where(falling, c, -b - root), jnp.where(falling, -b + root, 3 * a)
    usable &= (jnp.abs(above) <= jnp.abs(below)) & (below != 0)  # |t_x| <= 1
    usable &= root * unit > 32 * jnp.finfo(dtype).eps * size  # a maximum made of rounding alone
    t = jnp.where(usable, above, 0) / jnp.where(usable, below, 1)
    peak = ((a * t + b) * t + c) * t * unit + d
    usable &= peak > least
    span = jnp.where(usable, reach, 1)
    return (
        jnp.where(usable, t * span, 0),
        jnp.where(usable, peak, 0),
        jnp.where(usable, -2 * root * unit / (span * span), 0),
        usable,
    )
