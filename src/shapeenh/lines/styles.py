"""Named styles after the figures of TH10 chapter 8: for every kind of line its own brush."""

from __future__ import annotations

from typing import Any

from shapeenh.checks import check_choice, check_range
from shapeenh.lines.brush import Brush
from shapeenh.lines.fields import KINDS
from shapeenh.types import replace

# Heights at which a line of each kind begins to show, and is fully there, at an image height of 600 px. Occlusion lines
# are steps normalised to 1, whose smoothed gradient is about 0.4 at any resolution; slopes do not depend on it
# either; curvatures are per px, and variations of curvature per px^2.
_HEIGHTS = {
    "occlusion": (0.055, 0.16),
    "surface": (1.2, 4.0),
    "luminance": (0.008, 0.05),
    "ridge": (0.06, 0.35),
    "valley": (0.03, 0.20),
    "inflection": (0.02, 0.15),
}
_PER_PIXEL = {"luminance": 1, "ridge": 1, "valley": 1, "inflection": 2}
_WARM, _COOL, _SEPIA, _LIGHT = (0.22, 0.06, 0.02), (0.02, 0.03, 0.09), (0.08, 0.03, 0.015), (1.0, 0.97, 0.9)

_COMMON = {
    "ink": Brush(radius=1.2, flow=3.5),
    "pencil": Brush(color=(0.05, 0.05, 0.06), radius=1.3, flow=3.6, paper=0.6, wobble=0.7, tint=0.2, uneven=0.4),
    "airbrush": Brush(color=_SEPIA, radius=3.5, width=1.0, spread=0.5, flow=1.4),
    "charcoal": Brush(color=(0.03, 0.025, 0.02), radius=2.6, width=1.0, spread=0.2, flow=2.5, paper=0.6, grow=0.6),
    "calligraphy": Brush(color=_COOL, radius=2.6, aspect=0.45, flow=3.5, grow=0.8),
    "dashes": Brush(radius=1.4, flow=3.5, gaps=1.0),
    "shaded": Brush(radius=1.8, flow=3.0, shade=0.4),
}
_CHANGES: dict[tuple[str, str], dict[str, Any]] = {
    ("airbrush", "ridge"): {"color": _LIGHT, "radius": 2.5, "spread": 0.3, "flow": 0.6},
    ("airbrush", "occlusion"): {"radius": 1.8, "spread": 0.0, "flow": 2.5},
    ("shaded", "ridge"): {"color": _LIGHT, "shade": 0.6, "flow": 1.5},
    ("charcoal", "ridge"): {"radius": 1.6, "flow": 1.2},
    ("calligraphy", "ridge"): {"color": _WARM, "radius": 1.8},
    ("dashes", "occlusion"): {"gaps": 0.0},
}
STYLES = tuple(_COMMON)


def style_brush(style: str, kind: str, *, height: int = 600) -> Brush:
    """The brush of a named style for one kind of line (TH10 figs. 8.2 to 8.8).

    Args:
        style: "ink", "pencil", "airbrush", "charcoal", "calligraphy", "dashes", "shaded".
        kind: as in `line_field`.
        height: px of the image; brushes and thresholds are set for 600 and scaled.

    Returns: Brush. "calligraphy" wants the footprint "ellipse"; "shaded" wants shading; "pencil", "charcoal" and
        "dashes" want noise.
    Errors: ValueError for unknown names.
    """
    check_choice("style", style, STYLES)
    check_choice("kind", kind, KINDS)
    check_range("height", height, 1, 1 << 15)
    scale = height / 600
    low, high = _HEIGHTS[kind]
    unit = scale ** -_PER_PIXEL.get(kind, 0)
    brush = replace(_COMMON[style], **_CHANGES.get((style, kind), {}))
    if style in ("ink", "calligraphy", "dashes"):
        high = low + 0.4 * (high - low)  # there or not there
    radius, shortest = min(max(brush.radius * scale, 0.8), 40.0), min(5.0 * scale, 8.0)
    wobble = brush.wobble * min(scale, 8)
    return replace(brush, low=low * unit, high=high * unit, radius=radius, shortest=shortest, wobble=wobble)


def style_footprint(style: str) -> str:
    """ "ellipse" for calligraphy, "disc" otherwise: what `draw_lines` wants beside the brush."""
    check_choice("style", style, STYLES)
    return "ellipse" if style == "calligraphy" else "disc"
