"""What both fits share: the record of the result, the picture that is fitted, checks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass

from shapeenh import checks


@register_dataclass
@dataclass(frozen=True, eq=False)
class FitResult:
    """What a fit found.

    parameters: as they were given, with the fitted ones changed.
    value: [], the contrast reached (`fit_contrast`), or the rms difference over the reference's rms (`fit_image`).
    steps: moves of the solver.
    renders: pictures rendered, with or without their gradients.
    converged: whether the target was met; for `fit_image`, whether the difference is at a minimum.
    reason: empty where it converged, else a sentence that says why not.
    """

    parameters: Any
    value: jax.Array
    steps: int
    renders: int
    converged: bool
    reason: str = field(default="", metadata={"static": True})


def picture(render, parameters, arguments, mask, shape=None):
    """The picture for these parameters, of the mask's size, with something to see where values are known."""
    image = jnp.asarray(render(parameters, *arguments))
    wanted = mask.shape if shape is None else shape
    if image.shape != wanted and (shape is not None or image.shape != (*mask.shape, 3)):
        accepted = f"{wanted}" if shape is not None else f"{mask.shape} or {(*mask.shape, 3)}"
        raise ValueError(f"render gives an image of shape {image.shape}; accepted is {accepted}")
    if checks.is_concrete(image) and not _any_finite(image, mask):
        raise ValueError("render gives no finite pixel under the mask; accepted are pictures that show something there")
    return image.astype(checks.float_dtype(image))


@jax.jit
def _any_finite(image, mask):
    return jnp.any(jnp.isfinite(image) & mask.reshape(*mask.shape, *(1,) * (image.ndim - 2)))


def check_mask(mask):
    """A concrete mask with at least one pixel, as NumPy."""
    if not checks.is_concrete(mask):
        raise ValueError("mask is traced; accepted are plain values (a fit does not run under jit or vmap)")
    checks.check_shape("mask", mask, (None, None))
    mask = np.asarray(mask).astype(bool)
    if not mask.any():
        raise ValueError("mask is empty; accepted is a mask with at least one pixel")
    return mask


def check_common(arguments, tolerance, max_renders) -> None:
    if not isinstance(arguments, tuple | list):
        raise ValueError(
            f"arguments is a {type(arguments).__name__}; accepted is a tuple, handed to render after parameters"
        )
    for name, value in (("tolerance", tolerance), ("max_renders", max_renders)):
        if not checks.is_concrete(value):
            raise ValueError(f"{name} is traced; accepted are plain numbers")
    checks.check_range("tolerance", tolerance, 0, 1, open_ends=True)
    checks.check_size("max_renders", max_renders, low=2, high=1 << 20)
