"""Parameters within bounds as a vector in the unit cube, where every solver finds them well scaled."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh import checks

DIMENSIONS = 16  # a survey of the cube moves at most so many components on their own; larger arrays move as one
_HELD = object()  # stands for the bounds of a parameter that is not fitted


class Box:
    """The map between the unit cube and the parameters that are fitted; the others stay as they are.

    parameters: any tree of arrays and numbers. bounds: one of

    - `(lower, upper)`: each a number, or a tree of the structure of `parameters` (or of its upper part), whose numbers
      and arrays broadcast;
    - `{name: bounds, ...}`: by key or field, for dicts and records; what is not named is held. May be nested.

    start: [n] NumPy, the given parameters. size: n. dtype: that of the fitted parameters. dimension: [n] int, which
    components a survey moves together.
    Errors: ValueError that names the parameter: traced or not a real number, bounds that do not fit the structure, are
    not finite or not in order, a start outside them.
    """

    def __init__(self, parameters, bounds):
        if not checks.is_concrete(parameters):
            raise ValueError("parameters are traced; accepted are plain values (the start has no gradient)")
        structure: Any = jax.tree.structure(parameters)
        leaves = jax.tree.leaves(parameters)
        names = [
            "parameters" + jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(parameters)
        ]
        limits = [structure.flatten_up_to(side) for side in _sides(parameters, bounds, "bounds")]
        self._structure, self._leaves = structure, leaves
        self._fitted = [k for k in range(len(leaves)) if limits[0][k] is not _HELD]
        if not self._fitted:
            raise ValueError("bounds name no parameter; accepted is at least one to be fitted")
        ends = [_limits(names[k], leaves[k], limits[0][k], limits[1][k]) for k in self._fitted]
        self._lower, self._upper = ([pair[side] for pair in ends] for side in (0, 1))
        self.dtype = jnp.result_type(*[low.dtype for low in self._lower])
        start = []
        for k, low, high in zip(self._fitted, self._lower, self._upper, strict=True):
            value = np.asarray(leaves[k], low.dtype)
            _check_start(names[k], value, low, high)
            start.append(((np.float64(value) - low) / (np.float64(high) - low)).ravel())
        self.start = np.concatenate(start)
        self.size = self.start.size
        if not self.size:
            raise ValueError("parameters hold no number; accepted is at least one to be fitted")
        leaf = np.repeat(np.arange(len(start)), [s.size for s in start])
        self.dimension = (np.arange(self.size) if self.size <= DIMENSIONS else leaf) % DIMENSIONS

    def parameters(self, u):
        """The parameters at the point u, [n], of the unit cube. Exact at both ends of every interval."""
        leaves = list(self._leaves)
        placed = _placed(jnp.asarray(u, self.dtype), self._lower, self._upper)
        for k, value in zip(self._fitted, placed, strict=True):
            leaves[k] = value
        return jax.tree.unflatten(self._structure, leaves)


@jax.jit
def _placed(u, lower, upper):
    """The pieces of u between their ends; bounds are arguments, so that the next fit finds this compiled."""
    pieces, done = [], 0
    for low, high in zip(lower, upper, strict=True):
        part = u[done : done + low.size].reshape(low.shape).astype(low.dtype)
        done += low.size
        pieces.append(jnp.where(part < 0.5, low + part * (high - low), high - (1 - part) * (high - low)))
    return pieces


def _sides(parameters, bounds, name):
    """(lower, upper): trees of the structure of `parameters` with a number, an array or `_HELD` for every leaf."""
    if isinstance(bounds, dict):
        parts = _parts(parameters, name)
        unknown = [key for key in bounds if key not in parts]
        if unknown:
            accepted = ", ".join(repr(key) for key in parts)
            raise ValueError(f"{name} names {unknown[0]!r}; accepted are the names of the parameters, {accepted}")
        sides: tuple[dict, dict] = ({}, {})
        for key, part in parts.items():
            held = jax.tree.map(lambda _: _HELD, part)
            given = _sides(part, bounds[key], f"{name}[{key!r}]") if key in bounds else (held, held)
            for side, value in zip(sides, given, strict=True):
                side[key] = value
        return sides if isinstance(parameters, dict) else tuple(dataclasses.replace(parameters, **s) for s in sides)
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError(f"{name} is {bounds!r}; accepted is (lower, upper), or a dict from names to such pairs")
    try:
        return tuple(jax.tree.broadcast(side, parameters) for side in bounds)
    except ValueError:
        raise ValueError(
            f"{name} has the structure {jax.tree.structure(tuple(bounds))}; accepted is a pair of numbers or of trees "
            f"of the structure {jax.tree.structure(parameters)}"
        ) from None


def _parts(parameters, name) -> dict:
    if isinstance(parameters, dict):
        return parameters
    if dataclasses.is_dataclass(parameters):
        return {f.name: getattr(parameters, f.name) for f in dataclasses.fields(parameters)}
    given = type(parameters).__name__
    raise ValueError(f"{name} is a dict, but the parameters are a {given}; accepted is (lower, upper)")


def _limits(name, leaf, lower, upper):
    """(lower, upper) as NumPy arrays of the leaf's shape and precision."""
    kind = np.asarray(leaf).dtype
    if not (np.issubdtype(kind, np.number) or jnp.issubdtype(kind, jnp.floating)) or np.issubdtype(
        kind, np.complexfloating
    ):
        raise ValueError(f"{name} is {leaf!r}; accepted are real numbers and arrays of them")
    dtype = np.dtype(checks.float_dtype(leaf))
    try:
        sides = [np.broadcast_to(np.asarray(side, dtype), np.shape(leaf)) for side in (lower, upper)]
    except (ValueError, TypeError):
        shapes = f"{np.shape(lower)} and {np.shape(upper)}"
        raise ValueError(f"the bounds of {name} have shapes {shapes}; accepted is {np.shape(leaf)} or []") from None
    if not all(np.all(np.isfinite(side)) for side in sides):
        raise ValueError(f"the bounds of {name} are not finite; accepted are finite numbers")
    bad = ~(sides[0] < sides[1])
    if np.any(bad):
        low, high = (side[bad].flat[0] for side in sides)
        raise ValueError(f"the bounds of {name} are [{low:g}, {high:g}]; accepted is lower < upper")
    return sides


def _check_start(name, value, low, high):
    bad = ~((value >= low) & (value <= high))
    if np.any(bad):
        shown = [np.asarray(side)[bad].flat[0] for side in (value, low, high)]
        raise ValueError(
            f"{name} starts at {shown[0]:g}; accepted are values within its bounds [{shown[1]:g}, {shown[2]:g}]"
        )
