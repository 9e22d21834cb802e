"""Parsing of option values; what cannot be parsed is said in one plain line."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from shapeenh.scene import materials

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "grey": (0.78, 0.78, 0.78)}
LARGEST_SIDE = 8192


class UsageError(Exception):
    """Wrong input: ends the program with one plain line and exit code 2."""


def number(text: str) -> float:
    value = float(text)
    if not np.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(t) for t in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 800x600") from None
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise argparse.ArgumentTypeError(f"{text} is outside 1x1 to {LARGEST_SIDE}x{LARGEST_SIDE}")
    return width, height


def view(text: str) -> tuple[float, float]:
    try:
        azimuth, elevation = (number(t) for t in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not AZIMUTH,ELEVATION in degrees, such as 20,15") from None
    if not -89 <= elevation <= 89:
        raise argparse.ArgumentTypeError(f"elevation {elevation:g} is outside -89 to 89 degrees")
    return azimuth, elevation


def material(text: str) -> dict:
    if text in materials.PRESETS:
        return dict(zip(("diffuse", "specular", "shininess"), materials.PRESETS[text], strict=True))
    try:
        diffuse, specular, shininess = (number(t) for t in text.split(","))
    except ValueError:
        names = ", ".join(materials.PRESETS)
        raise argparse.ArgumentTypeError(f"{text!r} is neither one of {names} nor DIFFUSE,SPECULAR,SHININESS") from None
    if not (0 <= diffuse <= 1 and 0 <= specular <= 1 and shininess >= 0):
        raise argparse.ArgumentTypeError(f"{text}: diffuse and specular lie in 0 to 1, shininess is >= 0")
    return {"diffuse": (diffuse,) * 3, "specular": (specular,) * 3, "shininess": shininess}


def material_help() -> str:
    return f"{', '.join(materials.PRESETS)}, or three numbers (default: stone)"


def color(text: str) -> tuple[float, float, float]:
    if text in BACKGROUNDS:
        return BACKGROUNDS[text]
    digits = text.removeprefix("#")
    try:
        if len(digits) != 6:
            raise ValueError
        r, g, b = (int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither white, black, grey nor #RRGGBB") from None
    return r, g, b


def check_between(option: str, value: float, low: float, high: float) -> None:
    """An option's number within its range."""
    if not low <= value <= high:
        raise UsageError(f"{option} is {value:g}; accepted are numbers from {low:g} to {high:g}")


def check_folder(folder: Path, what: str) -> None:
    """A folder that is there."""
    if not folder.is_dir():
        raise UsageError(f"the {what} {folder} does not exist")
