"""Parameters that give a picture a wanted contrast (SPEC 12)."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh import checks
from shapeenh.fit import solve
from shapeenh.fit.box import Box
from shapeenh.fit.contrast import MEASURES, contrast
from shapeenh.fit.picture import FitResult, check_common, check_mask, picture
from shapeenh.fit.search import Search, Stop
from shapeenh.numerics import safe_divide


def fit_contrast(
    render: Callable,
    target,
    parameters,
    *,
    mask,
    bounds,
    measure: str | Callable = "rms",
    arguments: tuple = (),
    solver: str | Callable = "newton",
    tolerance: float = 1e-4,
    max_renders: int = 200,
) -> FitResult:
    """Parameters within bounds that give a picture the wanted contrast.

    Source: SPEC 12. One number is asked for, so several parameters have many solutions: the one found is near the start
    (every step is the shortest, in units of the bounds' widths).

    Args:
        render: `render(parameters, *arguments)` -> [H, W, 3] or [H, W], differentiable by JAX. Called as it is: what it
            closes over is best computed once, outside; many small operations run faster under `jax.jit`.
        target: [], > 0, the contrast wanted.
        parameters: where to start: a number, an array, a record or any tree of these.
        mask: [H, W], where contrast is measured.
        bounds: `(lower, upper)`, numbers or trees like `parameters`; or `{name: (lower, upper)}` by key or field of
            `parameters`: what is not named is held.
        measure: as in `contrast`, or a function `measure(image, mask)` -> [], continuous.
        arguments: handed to `render`; the result can be differentiated with respect to them.
        solver: "newton", steps with secant updates, the fewest renders; the jaxopt solvers "scipy", "lbfgsb" and
            "projected" on the squared relative error; optax's "adam"; or a function
            `solver(fun, start, bounds, *arguments)` -> [n] that minimises `fun(u, *arguments)` over the unit cube.
        tolerance: of the contrast, relative to the target.
        max_renders: how many pictures may be rendered.

    Where the solver ends elsewhere (a flat start, a local extremum), the bounds are searched for a contrast on the
    other side of the target: by a survey, by climbs from its best points, and then, with most of `max_renders`,
    everywhere (DIRECT). Between two such points a continuous contrast meets the target. A target is out of reach where
    all this finds none: peaks of about 1 % of the bounds' width, more with several parameters, may be missed.

    Static: measure, solver, tolerance, max_renders. Does not run under `jit` and `vmap`: the course depends on values.
    Returns: `FitResult`; `converged` is False where `max_renders` did not do or the contrast jumps across the target
    (in steps of the parameters' precision), and `reason` says which.
    Gradient: of the parameters with respect to target and arguments, by the implicit function theorem: exact for one
    parameter; for several that of the shortest change, in units of the bounds' widths, that follows. Parameters at a
    bound stay there. 0 where the contrast has no slope. The start has no gradient.
    Errors: ValueError that names the argument; for a target out of reach, the range of contrasts that were found.

    >>> fitted = se.fit_contrast(lambda w: se.shade_warped(..., alpha=w), 0.4, 10.0, mask=gbuffer.mask, bounds=(0, 100))
    """
    mask = check_mask(mask)
    check_common(arguments, tolerance, max_renders)
    if not callable(measure):
        checks.check_choice("measure", measure, MEASURES)
    measured = measure if callable(measure) else functools.partial(contrast, measure=measure)
    solve.check_solver(solver, ("newton", *solve.SOLVERS))
    _check_target(target)
    box = Box(parameters, bounds)
    course: dict = {}

    def reached(u, *arguments):
        return measured(picture(render, box.parameters(u), arguments, mask), mask)

    @jax.custom_jvp
    def solution(target, arguments):
        if not checks.is_concrete(target, arguments):
            raise ValueError("target or arguments are traced by jit or vmap; accepted are plain values, and `jax.grad`")
        _check_target(target)
        with jax.ensure_compile_time_eval():  # under jacfwd, too, values are looked at
            search, objective = _search(reached, arguments, float(target), box, tolerance, max_renders)
            _meet(search, objective, solver, box.start)
            residual, u = search.best
            course.update(steps=search.steps, renders=objective.renders, converged=search.met)
            course.update(reason="" if search.met else search.reason)
            return jnp.asarray(u, box.dtype), jnp.asarray(search.target * (1 + residual), box.dtype)

    @solution.defjvp
    def _(primals, tangents):
        (target, arguments), (target_dot, arguments_dot) = primals, tangents
        u, value = solution(target, arguments)
        slope, moved = _slopes(reached, u, arguments, arguments_dot)
        return (u, value), (_follow(u, slope, target_dot - moved), target_dot)

    u, value = solution(jnp.asarray(target, box.dtype), tuple(arguments))
    return FitResult(box.parameters(u), value, **course)


# ------------------------------------------------------------------------------------------- the search


def _search(reached, arguments, target, box, tolerance, max_renders):
    objective = solve.Objective(reached, arguments)
    search = Search(
        objective.value,
        objective.value_and_gradient,
        target,
        tolerance=tolerance,
        budget=max_renders,
        dimension=box.dimension,
        resolution=float(jnp.finfo(box.dtype).eps),
    )
    return search, objective


def _meet(search, objective, solver, start):
    """Ends with the target met, or the budget spent, or the error that says what can be reached."""
    try:
        if solver == "newton":
            search.newton(start)
        else:
            _approach(search, objective, solver, start)
        search.survey()
        sign = 1 if search.best[0] < 0 else -1
        _climb(search, sign, 2)
    except Stop:
        return
    with contextlib.suppress(Stop):
        _explore(search, sign)
        _climb(search, sign, 1)
        _climb(search, -sign, 2)  # the other end of the range
    low, high = search.range
    if search.met or low <= search.target <= high:
        return
    raise ValueError(
        f"target is {search.target:g}; accepted are the contrasts that can be reached within the bounds, "
        f"{low:.4g} to {high:.4g} (found in {objective.renders} renders)"
    )


def _approach(search, objective, solver, start):
    """Another solver, on the squared relative error, with half the budget; a bracket where it straddles the target."""
    search.look(start)
    share = search.budget // 2

    def on_host(u):
        if objective.renders >= share:
            raise _ShareSpent
        residual, slope = search.look_with_slope(u)
        return residual**2, 2 * residual * slope

    def traced(u, *arguments):
        return jnp.square(objective.traced(u, *arguments) / search.target - 1)

    with contextlib.suppress(_ShareSpent):
        found, _ = solve.minimise(
            solver,
            on_host,
            traced,
            start,
            objective.arguments,
            tolerance=search.tolerance**2,
            limit=share,
            stepped=search.stepped,
        )
        search.look(found)
    search.bracket_nearest()


class _ShareSpent(Exception):
    """A solver has used its part of the budget; the rest is for what comes after it."""


def _explore(search, sign):
    """The whole cube by dividing rectangles (DIRECT, Jones 1993), for larger (sign 1) or smaller (-1) contrast.

    Climbs see the hills that the survey hit; this one finds those between. Most of what is left of the budget.
    """
    from scipy.optimize import direct

    limit = len(search.points) + int(0.7 * (search.budget - len(search.points)))

    def on_host(place):
        if len(search.points) >= limit:
            raise _ShareSpent
        residual = search.look(place[search.dimension])
        search.bracket_nearest()
        return -sign * residual

    with contextlib.suppress(_ShareSpent):
        dimensions = int(search.dimension.max()) + 1
        direct(on_host, [(0, 1)] * dimensions, maxfun=search.budget, locally_biased=False, vol_tol=0, len_tol=0)


def _climb(search, sign, count):
    """From the best `count` points, along the gradient, towards larger (sign 1) or smaller (-1) contrast."""

    def on_host(u):
        residual, slope = search.look_with_slope(u)
        search.bracket_nearest()
        return -sign * residual, -sign * slope

    for _, u in sorted(search.points, key=lambda point: -sign * point[0])[:count]:
        solve.minimise("scipy", on_host, None, u, (), tolerance=1e-7, limit=30, stepped=search.stepped)


def _slopes(reached, u, arguments, arguments_dot):
    """(d reached/d u, d reached along the arguments' tangents), in reverse mode, which every stage offers."""
    leaves, structure = jax.tree.flatten(arguments)
    dots = jax.tree.leaves(arguments_dot)
    smooth = [k for k, leaf in enumerate(leaves) if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)]

    def of_smooth(u, values):
        changed = list(leaves)
        for k, value in zip(smooth, values, strict=True):
            changed[k] = value
        return reached(u, *jax.tree.unflatten(structure, changed))

    slope, slopes = jax.grad(of_smooth, argnums=(0, 1))(u, [leaves[k] for k in smooth])
    moved = sum((jnp.sum(s * dots[k]) for k, s in zip(smooth, slopes, strict=True)), jnp.zeros((), u.dtype))
    return slope, moved.astype(u.dtype)


@jax.jit
def _follow(u, slope, change):
    """The shortest step along which the contrast changes by `change`; components at a bound stay, unless all are."""
    at_bound = (u <= 0) | (u >= 1)
    slope = jnp.where(at_bound & ~jnp.all(at_bound), 0, slope)
    return safe_divide(slope, jnp.sum(slope * slope)) * change


def _check_target(target):
    checks.check_shape("target", target, ())
    if checks.is_concrete(target):
        checks.check_range("target", target, 0, np.inf, open_ends=True)
