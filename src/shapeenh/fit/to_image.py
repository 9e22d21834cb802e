"""Parameters that make a picture equal to a reference picture (SPEC 12)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from shapeenh import checks
from shapeenh.fit import solve
from shapeenh.fit.box import Box
from shapeenh.fit.picture import FitResult, check_common, check_mask, picture
from shapeenh.fit.search import Stop, survey_points
from shapeenh.numerics import safe_divide


def fit_image(
    render: Callable,
    reference,
    parameters,
    *,
    mask,
    bounds,
    arguments: tuple = (),
    solver: str | Callable = "scipy",
    starts: int = 1,
    tolerance: float = 1e-5,
    max_renders: int = 500,
) -> FitResult:
    """Parameters within bounds that make a picture equal to a reference picture, in the sense of least squares.

    Source: SPEC 12, with a picture for the target. Minimises the sum of squared differences under the mask, over the
    reference's sum of squares.

    Args:
        render, parameters, bounds, arguments: as in `fit_contrast`.
        reference: [H, W, 3] or [H, W], of the shape that `render` gives.
        mask: [H, W], what is compared; pixels that are not finite in the reference do not count, those that are not in
            a rendered picture are black.
        solver: the jaxopt solvers "scipy" (SciPy's L-BFGS-B), "lbfgsb" and "projected"; optax's "adam"; or a function
            `solver(fun, start, bounds, *arguments)` -> [n] that minimises `fun(u, *arguments)` over the unit cube.
        starts: how many starts may be tried, the given one first, then points that fill the bounds evenly; the best
            result wins.
        tolerance: of the rms difference, relative to the reference's rms: where it is this small the fit ends.
        max_renders: how many pictures may be rendered.

    Static: solver, starts, tolerance, max_renders. Does not run under `jit` and `vmap`: the course depends on values.
    Returns: `FitResult`; `value` is the rms difference over the reference's rms. `converged`: it is within the
    tolerance, or the best start's solver found no way down; `reason` says why not.
    Gradient: none; traced references and arguments are refused.
    Errors: ValueError that names the argument.

    >>> found = se.fit_image(render, photograph, {"alpha": 10.0}, mask=gbuffer.mask, bounds={"alpha": (0, 100)})
    """
    mask = check_mask(mask)
    check_common(arguments, tolerance, max_renders)
    solve.check_solver(solver, solve.SOLVERS)
    checks.check_size("starts", starts, high=64)
    if not checks.is_concrete(reference, arguments):
        raise ValueError("reference or arguments are traced; accepted are plain values (this fit has no gradient)")
    shape = np.shape(reference)
    if len(shape) not in (2, 3) or shape[:2] != mask.shape:
        raise ValueError(
            f"reference has shape {shape}; accepted is [H, W] or [H, W, 3] of the mask's size {mask.shape}"
        )
    reference = jnp.asarray(reference, checks.float_dtype(reference))
    mask = mask & np.all(np.isfinite(np.asarray(reference).reshape(*mask.shape, -1)), axis=-1)
    if not mask.any():
        raise ValueError("reference has no finite pixel under the mask; accepted is a picture with some")
    box = Box(parameters, bounds)

    def difference(u, *arguments):
        return _difference(picture(render, box.parameters(u), arguments, mask, shape), reference, mask)

    objective = solve.Objective(difference, tuple(arguments))
    descent = _Descent(objective, tolerance**2, max_renders)
    places = survey_points(int(box.dimension.max()) + 1)[2:, box.dimension]
    for start in [box.start, *places][:starts]:
        descent.run(solver, start)
        if descent.ended:
            break
    value, u, success = descent.best
    u = jnp.asarray(u, box.dtype)
    rms = jnp.asarray(np.sqrt(value), box.dtype)
    converged = success or value <= tolerance**2
    spent = f"max_renders = {max_renders} pictures did not do" if objective.renders >= max_renders else ""
    reason = "" if converged else spent or f"{solver} ended before it found a minimum"
    return FitResult(box.parameters(u), rms, descent.steps, objective.renders, converged, reason)


class _Descent:
    """Runs of a solver from several starts, and the best point of all."""

    def __init__(self, objective, tolerance, budget):
        self.objective, self.tolerance, self.budget = objective, tolerance, budget
        self.best: tuple[float, Any, bool] = (np.inf, None, False)  # value, u, whether its run ended at a minimum
        self.steps = 0

    @property
    def ended(self):
        return self.best[0] <= self.tolerance or self.objective.renders >= self.budget

    def run(self, solver, start):
        # Solvers stop at absolute changes: relative to the value at the start they mean the same for every picture.
        first = self._keep(self.objective.value(start), start) or 1.0
        if self.ended:
            return

        def on_host(u):
            value, gradient = self.objective.value_and_gradient(u)
            self._keep(value, u)
            if self.ended:
                raise Stop
            return value / first, gradient / first

        def traced(u, *arguments):
            return self.objective.traced(u, *arguments) / first

        try:
            found, success = solve.minimise(
                solver,
                on_host,
                traced,
                start,
                self.objective.arguments,
                tolerance=self.tolerance,
                limit=self.budget,
                stepped=self._stepped,
            )
            self._keep(self.objective.value(found), found, success)
        except Stop:
            pass

    def _keep(self, value, u, success=False):
        if value < self.best[0] or (success and value <= self.best[0]):
            self.best = (value, np.array(u, np.float64), success)
        return value

    def _stepped(self, count=1):
        self.steps += count


def _difference(image, reference, mask):
    """Sum of squared differences under the mask over the reference's sum of squares.

    Both are taken relative to the brightest value of the reference, so that no square overflows.
    """
    plain = image[..., None] if image.ndim == 2 else image
    wanted = (reference[..., None] if reference.ndim == 2 else reference).astype(plain.dtype)
    seen = mask & jnp.all(jnp.isfinite(plain), axis=-1)
    plain, wanted = jnp.where(seen[..., None], plain, 0), jnp.where(mask[..., None], wanted, 0)
    top = jnp.max(jnp.abs(wanted))
    top = jnp.where(top > 0, top, 1)
    power = jnp.sum(jnp.square(wanted / top))
    return safe_divide(jnp.sum(jnp.square((plain - wanted) / top)), jnp.where(power > 0, power, 1))
