"""The solvers: jaxopt's, optax's, or one that is handed in, on an objective over the unit cube.

The only file that imports jaxopt. The objective is `fun(u, *arguments)`, so that any other solver fits in its place.
"""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh import checks

JAXOPT = ("scipy", "lbfgsb", "projected")
SOLVERS = (*JAXOPT, "adam")
ADAM_RATE = 0.05  # of the first step, in units of the bounds' widths


@functools.cache
def _jaxopt() -> Any:
    """The module, without the one warning that it gives at import: that it is not developed further."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
        import jaxopt
    return jaxopt


# ------------------------------------------------------------------------------------------- the objective


class Objective:
    """A number that depends on a rendered picture, `function(u, *arguments)`, and how many pictures it has cost."""

    def __init__(self, function: Callable, arguments: tuple):
        self.function, self.arguments, self.renders = function, arguments, 0

    def value(self, u) -> float:
        self.renders += 1
        with _named_leaks():
            return _plain(self.function(jnp.asarray(u), *self.arguments))

    def value_and_gradient(self, u) -> tuple[float, np.ndarray]:
        self.renders += 1
        with _named_leaks():
            value, gradient = jax.value_and_grad(self.function)(jnp.asarray(u), *self.arguments)
            number, slope = _plain(value), np.asarray(gradient, np.float64)
            if not np.all(np.isfinite(slope)):
                raise ValueError("the gradient of the picture's measure is not finite; accepted are finite numbers")
            return number, slope

    def traced(self, u, *arguments):
        """For a solver that compiles its loop: there Python is called once, so a callback counts."""
        jax.debug.callback(self._count, jnp.sum(u))  # depends on u, or it would be moved out of the loop
        return self.function(u, *arguments)

    def _count(self, _):
        self.renders += 1


def _plain(value) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise ValueError(f"the picture's measure is {number}; accepted are finite numbers")
    return number


@contextlib.contextmanager
def _named_leaks():
    """JAX's error for a tracer of an outer transformation does not say what to do about it."""
    try:
        yield
    except (jax.errors.UnexpectedTracerError, jax.errors.ConcretizationTypeError) as error:
        raise ValueError(
            "render closes over a value that jit, vmap or grad traces; accepted are plain values, and `arguments=` for "
            "what the fit is differentiated in"
        ) from error


# ------------------------------------------------------------------------------------------- the solvers


def check_solver(solver, names: tuple) -> None:
    if not callable(solver):
        checks.check_choice("solver", solver, names)


def minimise(
    solver, on_host: Callable, traced: Callable | None, start, arguments, *, tolerance, limit, stepped: Callable
):
    """(u, success): where `solver` ends, and whether it says that it is at a minimum.

    on_host(u) -> (value, gradient), NumPy: what "scipy" and "adam" call; may raise to end them.
    traced(u, *arguments) -> []: what the others call, differentiable by JAX.
    tolerance: of the value. limit: of the steps. stepped(n=1): told of every step.
    """
    if solver == "scipy":
        return _scipy(on_host, start, tolerance, limit, stepped)
    if solver == "adam":
        return _adam(on_host, start, limit, stepped)
    u, bounds = jnp.asarray(start), (jnp.zeros(len(start)), jnp.ones(len(start)))
    tolerance = tolerance**0.5  # these two look at the gradient, which of a squared error falls as its root
    if solver == "lbfgsb":
        found, state = _jaxopt().LBFGSB(fun=traced, tol=tolerance, maxiter=limit).run(u, bounds, *arguments)
    elif solver == "projected":
        projection = _jaxopt().projection.projection_box
        run = _jaxopt().ProjectedGradient(fun=traced, projection=projection, tol=tolerance, maxiter=limit).run
        found, state = run(u, bounds, *arguments)
    else:
        found, state = solver(traced, u, bounds, *arguments), None
    jax.effects_barrier()
    if state is not None:
        stepped(int(state.iter_num))
    return np.asarray(found, np.float64), state is None or bool(state.error <= tolerance)


def _scipy(on_host, start, tolerance, limit, stepped):
    """SciPy's L-BFGS-B through jaxopt; not jitted, so that every call is seen and may end the run."""
    solver = _jaxopt().ScipyBoundedMinimize(
        fun=lambda u: on_host(np.asarray(u, np.float64)),
        value_and_grad=True,
        jit=False,
        method="L-BFGS-B",
        maxiter=limit,
        options={"ftol": tolerance, "gtol": tolerance, "maxfun": 2 * limit},
        callback=lambda _: stepped(),
    )
    u, state = solver.run(jnp.asarray(start), (np.zeros(len(start)), np.ones(len(start))))
    return np.asarray(u, np.float64), int(state.status) != 1  # 1: out of steps; else rounding or a minimum ended it


def _adam(on_host, start, limit, stepped):
    """Projected Adam with a step that falls to 0 as a cosine; keeps the best point."""
    import optax

    optimiser = optax.adam(optax.cosine_decay_schedule(ADAM_RATE, limit))

    @jax.jit
    def step(u, gradient, state):
        change, state = optimiser.update(gradient, state)
        return jnp.clip(u + change, 0, 1), state

    u = jnp.asarray(start)
    state, best = optimiser.init(u), (np.inf, u)
    for _ in range(limit):
        value, gradient = on_host(np.asarray(u, np.float64))
        best = min(best, (value, u), key=lambda pair: pair[0])
        u, state = step(u, jnp.asarray(gradient, u.dtype), state)
        stepped()
    return np.asarray(best[1], np.float64), False
