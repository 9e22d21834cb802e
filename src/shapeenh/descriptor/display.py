"""Pictures of a descriptor (LW09 fig. 6, TH10 figs 4.3 and 4.7), and their legend."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from shapeenh.checks import check_range, check_shape, check_size, check_type
from shapeenh.descriptor.view import mean_curvature
from shapeenh.types import Descriptor

# sRGB-encoded anchors of the scale at t = -1 (convex), -1/2, 0 (flat), 1/2, 1 (concave)
_SCALE = (
    (0.10, 0.10, 0.55),
    (0.20, 0.60, 0.95),
    (1.00, 1.00, 1.00),
    (1.00, 0.62, 0.15),
    (0.70, 0.05, 0.05),
)


def curvature_scale(t):
    """Display colour of `t` in [-1, 1]: cold hues for convex (< 0), white for flat, warm for concave (LW09 fig. 6).

    t: any shape; beyond ±1 the end colours hold. Returns `[..., 3]` in [0, 1], sRGB encoded (to be saved as it is).
    """
    t = jnp.asarray(t)
    anchors = jnp.asarray(_SCALE, t.dtype)
    at = jnp.linspace(-1, 1, len(_SCALE), dtype=t.dtype)
    return jnp.stack([jnp.interp(t, at, anchors[:, i]) for i in range(3)], axis=-1)


def _default_scale(height: int) -> float:
    """0.1 1/px at a height of 600."""
    return 60 / height


def curvature_colors(descriptor, mask, *, scale=None):
    """The descriptor as in LW09 fig. 6: convex cold, concave warm, by mean curvature; silhouettes and creases black.

    descriptor: Descriptor.
    mask: [H, W] bool, where something is seen.
    scale: [], 1/px, > 0: the |mean curvature| at which colours saturate; None = 60 / H, that is 0.1 at a height of 600.
    Returns [H, W, 3] in [0, 1], sRGB encoded (to be saved as it is); white off the mask, and where
        the Hessian or a weight is not finite.
    Gradient: with respect to the Hessian and the weights.
    Errors: ValueError for a scale that is not positive, or a mask of another size.
    """
    check_type("descriptor", descriptor, Descriptor)
    if scale is None:
        scale = _default_scale(descriptor.silhouette.shape[0])
    check_range("scale", scale, 0, float("inf"), open_ends=True)
    check_shape("mask", mask, descriptor.silhouette.shape)
    ink = jnp.maximum(descriptor.silhouette, descriptor.crease)
    seen = mask & jnp.all(jnp.isfinite(descriptor.hessian), axis=-1) & jnp.isfinite(ink)
    h = mean_curvature(jnp.where(seen[..., None], descriptor.hessian, 0)) / scale
    colors = curvature_scale(h) * (1 - jnp.where(seen, ink, 0))[..., None]
    return jnp.where(seen[..., None], colors, 1)


# ------------------------------------------------------------------------------------------- the legend

_GLYPHS = {  # 3 x 5 pixels, a row per digit in octal
    "0": "75557",
    "1": "26227",
    "2": "71747",
    "3": "71717",
    "4": "55711",
    "5": "74717",
    "6": "74757",
    "7": "71122",
    "8": "75757",
    "9": "75717",
    ".": "00002",
    "-": "00700",
    "+": "02720",
    "e": "07746",
    "/": "11244",
    "p": "07744",
    "x": "05225",
}


def curvature_legend(height, *, scale=None) -> np.ndarray:
    """The colour scale of `curvature_colors` as a strip to stand beside a picture, with ticks in 1/px.

    height: int, px, 64 to 32768: that of the picture. scale: [], 1/px, > 0, as given to `curvature_colors`; None = its
        default for this height.
    Returns [height, width, 3] in [0, 1], sRGB encoded, NumPy: concave at the top, convex at the bottom, a label at
    +scale, +scale/2, 0, -scale/2, -scale, on white; the width grows with the height.
    Gradient: none. Errors: ValueError for a height or scale out of range.

        sheet = np.concatenate([curvature_colors(descriptor, mask), curvature_legend(mask.shape[0])], axis=1)
    """
    height = check_size("height", height, low=64)
    scale = _default_scale(height) if scale is None else scale
    check_range("scale", scale, 0, float("inf"), open_ends=True)
    zoom = max(1, height // 240)
    top, bar, tick = 8 * zoom, 10 * zoom, 3 * zoom
    labels = [_text(f"{t * float(scale):+.3g}" if t else "0", zoom) for t in (1, 0.5, 0, -0.5, -1)]
    unit = _text("1/px", zoom)
    left = 4 * zoom
    width = left + bar + tick + 2 * zoom + max(label.shape[1] for label in (*labels, unit)) + 4 * zoom
    sheet = np.ones((height, width, 3))
    rows = np.linspace(1, -1, height - 2 * top - 8 * zoom)
    sheet[top : top + len(rows), left : left + bar] = np.asarray(curvature_scale(jnp.asarray(rows)))[:, None]
    for i, label in enumerate(labels):
        middle = top + round(i * (len(rows) - 1) / 4)
        sheet[middle - zoom // 2 : middle - zoom // 2 + zoom, left + bar : left + bar + tick] = 0
        _print(sheet, label, middle - label.shape[0] // 2, left + bar + tick + 2 * zoom)
    _print(sheet, unit, height - unit.shape[0] - 2 * zoom, left)
    return sheet


def _text(text: str, zoom: int) -> np.ndarray:
    """[5 zoom, 4 zoom per letter] bool."""
    columns = [np.array([[int(row) >> bit & 1 for bit in (2, 1, 0, 3)] for row in _GLYPHS[letter]]) for letter in text]
    return np.kron(np.concatenate(columns, axis=1), np.ones((zoom, zoom), int)) > 0


def _print(sheet, ink, top: int, left: int) -> None:
    sheet[top : top + ink.shape[0], left : left + ink.shape[1]][ink] = 0
