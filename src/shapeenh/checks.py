"""Argument checks at the Python boundary: each error names the argument, what was given and what is accepted.

Values are only looked at where they are concrete; under somebody's `jit`, `grad` or `vmap` the shape checks remain.
Imports nothing of ours.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np


def is_concrete(*trees) -> bool:
    """True when no leaf is a tracer, so that values can be read and work that is not needed can be skipped."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def is_zero(*values) -> bool:
    """Known to be zero: concrete, and nothing but zeros."""
    return all(is_concrete(v) and not np.any(np.asarray(v)) for v in values)


def as_number(value, dtype=None):
    """A number, or a few, as an array: by NumPy where it is known, because an eager operation of JAX takes as long as
    hundreds there, and waits for its turn among those on images. An image stays where it is."""
    return (np if np.ndim(value) < 2 and is_concrete(value) else jnp).asarray(value, dtype)


def float_dtype(*arrays):
    """float64 where x64 is enabled and an array is float64, float32 for narrower floats, JAX's default without any."""
    given = [np.dtype(a.dtype) for a in arrays if hasattr(a, "dtype")]
    floats = [d for d in given if jnp.issubdtype(d, jnp.floating)]
    return jnp.result_type(jnp.float64 if not floats or np.dtype(np.float64) in floats else jnp.float32)


def check_shape(name: str, array, shape: tuple) -> None:
    """`shape` holds ints, or None for any size; a leading Ellipsis allows any number of leading axes."""
    given = tuple(np.shape(array))
    wanted = shape[1:] if shape and shape[0] is Ellipsis else shape
    tail = given[len(given) - len(wanted) :] if len(given) >= len(wanted) else None
    fits = tail is not None and (len(given) == len(wanted) or wanted is not shape)
    if not fits or any(w is not None and w != g for w, g in zip(wanted, tail or (), strict=False)):
        text = ", ".join("..." if s is Ellipsis else "any" if s is None else str(s) for s in shape)
        raise ValueError(f"{name} {'is None' if array is None else f'has shape {given}'}; accepted is [{text}]")


def check_real(name: str, array) -> None:
    """Real numbers or booleans."""
    if is_concrete(array) or hasattr(array, "dtype"):
        dtype = array.dtype if hasattr(array, "dtype") else np.asarray(array).dtype
        numbers = jnp.issubdtype(dtype, np.number) and not jnp.issubdtype(dtype, np.complexfloating)
        if not numbers and not jnp.issubdtype(dtype, np.bool_):
            given = repr(array) if np.ndim(array) == 0 else f"an array of {dtype}"
            raise ValueError(f"{name} is {given}; accepted are real numbers")


def check_finite(name: str, array) -> None:
    """Every value a real number, and finite (looked at where concrete)."""
    check_real(name, array)
    if is_concrete(array):
        bad = int(np.size(array) - np.count_nonzero(np.isfinite(np.asarray(array))))
        if bad:
            raise ValueError(f"{name} holds {bad} NaN or infinite value(s); accepted are finite numbers")


def check_range(name: str, value, low: float, high: float, *, open_ends: bool = False) -> None:
    """A finite scalar (or array) within [low, high], or ]low, high[ with `open_ends` (looked at where concrete)."""
    if not is_concrete(value):
        return
    check_real(name, value)
    v = np.asarray(value)
    inside = (v > low) & (v < high) if open_ends else (v >= low) & (v <= high)
    if not np.all(inside & np.isfinite(v)):
        ends = f"]{low:g}, {high:g}[" if open_ends else f"[{low:g}, {high:g}]"
        shown = v.item() if v.ndim == 0 else v[~(inside & np.isfinite(v))].ravel()[0]
        raise ValueError(f"{name} is {shown}; accepted are finite numbers in {ends}")


def check_size(name: str, value, *, low: int = 1, high: int = 1 << 15) -> int:
    """A static Python integer within [low, high]."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name} is {value!r}; accepted are integers from {low} to {high}")
    if not low <= value <= high:
        raise ValueError(f"{name} is {value}; accepted are integers from {low} to {high}")
    return int(value)


def check_choice(name: str, value, choices) -> None:
    """One of a fixed set of words."""
    if value not in choices:
        raise ValueError(f"{name} is {value!r}; accepted are {', '.join(repr(c) for c in choices)}")


def check_type(name: str, value, accepted: type) -> None:
    """An instance of one of our records."""
    if not isinstance(value, accepted):
        raise ValueError(f"{name} is a {type(value).__name__}; accepted is a {accepted.__name__}")
