"""Bringing one number to a target inside the unit cube: Newton with secant updates, and a safeguard that cannot fail.

The number is continuous and the cube is convex. So as soon as one point lies below the target and one above, the
segment between them holds a solution, and bracketing on it ends there whatever the function does in between. Newton
steps are the fast way to it; where they stall (a flat or a non-monotone start), a survey of the cube and then a climb
towards the target look for a point on the other side.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


class Stop(Exception):
    """The target is met, or the budget is spent: leaves whatever loop was looking."""


class Search:
    """The points looked at so far, and the moves that choose the next one.

    value(u), value_and_gradient(u): the number at a point [n] of the unit cube, and its gradient [n].
    target: > 0. tolerance: of |value/target - 1|. budget: of points. dimension: [n] int, which components of u the
    survey moves together. resolution: the smallest step along a segment that changes a point.

    points: [(residual, u)], the residual being value/target - 1. reason: why the search ended without the target.
    """

    def __init__(
        self, value: Callable, value_and_gradient: Callable, target, *, tolerance, budget, dimension, resolution
    ):
        self._value, self._value_and_gradient = value, value_and_gradient
        self.target, self.tolerance, self.budget, self.resolution = target, tolerance, budget, resolution
        self.dimension = dimension
        self.points: list[tuple[float, np.ndarray]] = []
        self.steps = 0
        self.reason = ""

    # --------------------------------------------------------------------------------------- looking

    def look(self, u):
        """The residual at u."""
        return self._record(self._value(u), u)

    def look_with_slope(self, u):
        """The residual at u and its gradient."""
        value, gradient = self._value_and_gradient(u)
        return self._record(value, u), np.asarray(gradient, np.float64) / self.target

    def _record(self, value, u):
        residual = float(value) / self.target - 1
        self.points.append((residual, np.array(u, np.float64)))
        if abs(residual) <= self.tolerance:
            raise Stop
        if len(self.points) >= self.budget:
            self.reason = f"max_renders = {self.budget} pictures did not do"
            raise Stop
        return residual

    @property
    def best(self):
        """(residual, u) nearest to the target."""
        return min(self.points, key=lambda point: abs(point[0]))

    @property
    def met(self):
        return bool(self.points) and abs(self.best[0]) <= self.tolerance

    @property
    def range(self):
        """(smallest, largest) value seen."""
        residuals = [residual for residual, _ in self.points]
        return self.target * (1 + min(residuals)), self.target * (1 + max(residuals))

    def stepped(self, count=1):
        self.steps += count

    # --------------------------------------------------------------------------------------- Newton

    def newton(self, u):
        """Steps to where the linear model meets the target, each the shortest there is inside the cube.

        The gradient is taken afresh only where a step disappoints; between, Broyden's update (in one dimension: the
        secant) keeps it good enough, and a picture without its gradient costs a third. Once the target lies between two
        points, `bracket` ends the search.
        """
        (residual, slope), fresh = self.look_with_slope(u), True
        while True:
            step = shortest_step(u, slope, -residual)
            length = step @ step
            if length == 0:
                return
            new, self.steps = np.clip(u + step, 0, 1), self.steps + 1
            ahead = self.look(new)
            if ahead * residual < 0:
                return self.bracket((residual, u), (ahead, new))
            if abs(ahead) < 0.5 * abs(residual):
                slope = slope + (ahead - residual - slope @ step) / length * step
                u, residual, fresh = new, ahead, False
                continue
            if fresh and abs(ahead) > 0.9 * abs(residual):
                return
            u = new if abs(ahead) < abs(residual) else u
            (residual, slope), fresh = self.look_with_slope(u), True

    # --------------------------------------------------------------------------------------- bracketing

    def bracket(self, one, other):
        """Chandrupatla's method (1997) between two points on different sides of the target; ends with `Stop`.

        Inverse quadratic interpolation where the last three points allow it, bisection where they do not. It gives up
        where the interval cannot be halved any more: the number jumps across the target.
        """
        (fa, u), (fb, v) = one, other
        a, b = 0.0, 1.0  # the newest end and the one across the target, on the segment from u to v
        t = fa / (fa - fb)
        while abs(b - a) > self.resolution:
            self.steps += 1
            new = a + t * (b - a)
            ahead = self.look((1 - new) * u + new * v)
            if ahead * fa > 0:
                c, fc = a, fa
            else:
                c, fc, b, fb = b, fb, a, fa
            a, fa = new, ahead
            t = _interpolated(a, fa, b, fb, c, fc)
        ends = sorted(self.target * (1 + f) for f in (fa, fb))
        self.reason = f"the contrast jumps across the target, from {ends[0]:.6g} to {ends[1]:.6g}"
        raise Stop

    def bracket_nearest(self):
        """`bracket` between the newest point and the nearest one on the other side; returns where there is none."""
        residual, u = self.points[-1]
        others = [point for point in self.points[:-1] if point[0] * residual < 0]
        if others:
            self.bracket((residual, u), min(others, key=lambda point: np.sum((point[1] - u) ** 2)))

    # --------------------------------------------------------------------------------------- survey

    def survey(self):
        """Looks at both ends of the cube's diagonal and at points that fill it evenly (Halton)."""
        dimensions = int(self.dimension.max()) + 1
        for place in survey_points(dimensions):
            self.look(place[self.dimension])
            self.bracket_nearest()


def _interpolated(a, fa, b, fb, c, fc):
    """Where between a (0) and b (1) to look next; c is the end that was given up."""
    if fb == fc:
        return 0.5
    xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
    if not (phi * phi < xi and (1 - phi) ** 2 < 1 - xi):
        return 0.5
    t = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
    return float(np.clip(t, 0.01, 0.99))


def shortest_step(u, slope, change):
    """The shortest step s with slope . s = change and 0 <= u + s <= 1; else as far as there is room."""
    step, free = np.zeros_like(u), np.ones(u.shape, bool)
    for _ in range(min(u.size, 32)):
        left = change - slope @ np.where(free, 0, step)
        power = np.sum(np.where(free, slope, 0) ** 2)
        if power == 0 or left == 0:
            break
        wanted = slope * (left / power)
        outside = free & ((u + wanted < 0) | (u + wanted > 1))
        step = np.where(free, np.clip(u + wanted, 0, 1) - u, step)
        if not outside.any():
            break
        free &= ~outside
    return step


def survey_points(dimensions: int) -> np.ndarray:
    """[K, dimensions] in [0, 1]: both ends of the diagonal, then a Halton sequence."""
    count = min(7 * dimensions, 40)
    primes = [p for p in range(2, 400) if all(p % q for q in range(2, int(p**0.5) + 1))][:dimensions]
    halton = np.array([[_radical_inverse(k, p) for p in primes] for k in range(1, count + 1)])
    return np.concatenate([np.zeros((1, dimensions)), np.ones((1, dimensions)), halton])


def _radical_inverse(k: int, base: int) -> float:
    """The digits of k mirrored at the point: 0.5, 0.25, 0.75, 0.125 ... for base 2."""
    value, place = 0.0, 1.0 / base
    while k:
        k, digit = divmod(k, base)
        value, place = value + digit * place, place / base
    return value
