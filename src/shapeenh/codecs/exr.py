"""OpenEXR by the `OpenEXR` package, an extra of ours: half and float, every compression, from and to bytes."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

CHANNEL_SETS = (("R", "G", "B"), ("r", "g", "b"), ("X", "Y", "Z"), ("x", "y", "z"), ("U", "V"), ("Y",))
INSTALL = "EXR files need the package OpenEXR, 3.5 or newer: pip install 'shapeenh[exr]'"


def decode_exr(data: bytes) -> np.ndarray:
    """The picture of an EXR file, in its display window.

    Channels, the first set that the file has: R G B, X Y Z (positions, normals), U V, Y (luminance), or the only
    channel, whatever its name. Without any, the same names inside a layer (`diffuse.R`), if only one layer has them.
    Alpha is left out: EXR colours are premultiplied. Pixels of the display window outside the data window are 0. Of
    several parts the first is read.

    Args:
        data: the file.

    Returns: [h, w] or [h, w, C] float32 (uint32 for integer channels).
    Errors: ValueError without the package OpenEXR, and for files that it cannot read or that hold other channels.
    """
    OpenEXR = _library()
    try:
        file = OpenEXR.File(io.BytesIO(data), separate_channels=True)
        header, channels = dict(file.header()), {name: np.asarray(c.pixels) for name, c in file.channels().items()}
    except MemoryError:
        raise
    except Exception as error:  # RuntimeError, ValueError, TypeError, depending on what is wrong
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"EXR: the file cannot be decoded ({text})") from None
    (x0, y0), (x1, y1) = (np.asarray(p, np.int64) for p in header["dataWindow"])
    names = _choose(channels)
    planes = [channels[name] for name in names]
    if any(p.shape != (y1 - y0 + 1, x1 - x0 + 1) for p in planes):
        raise ValueError(
            f"EXR: the channels {', '.join(names)} are subsampled or deep; accepted are flat channels of full size"
        )
    image = np.stack(planes, axis=-1)
    image = image if image.dtype == np.uint32 else image.astype(np.float32)

    (u0, v0), (u1, v1) = (np.asarray(p, np.int64) for p in header["displayWindow"])
    if (u0, v0, u1, v1) != (x0, y0, x1, y1):
        if not (0 < u1 - u0 + 1 <= 1 << 16 and 0 < v1 - v0 + 1 <= 1 << 16):
            raise ValueError(f"EXR: the display window is ({u0}, {v0}) to ({u1}, {v1})")
        shown = np.zeros((v1 - v0 + 1, u1 - u0 + 1, len(names)), image.dtype)
        left, right, top, bottom = max(u0, x0), min(u1, x1), max(v0, y0), min(v1, y1)
        if left <= right and top <= bottom:
            part = image[top - y0 : bottom - y0 + 1, left - x0 : right - x0 + 1]
            shown[top - v0 : bottom - v0 + 1, left - u0 : right - u0 + 1] = part
        image = shown
    return image[..., 0] if len(names) == 1 else image


def encode_exr(image, *, half: bool = False) -> bytes:
    """An EXR file, ZIP-compressed (lossless): channels R G B (A), or Y for one channel.

    Args:
        image: [h, w] or [h, w, C], C = 1, 3, 4 (alpha last; colours premultiplied by the caller).
        half: 16-bit floats instead of 32. Values beyond 65504 become that.

    Returns: the file. Errors: ValueError for another shape, and without the package OpenEXR.
    """
    image = np.asarray(image)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4) or image.size == 0 or image.dtype.kind not in "biuf":
        raise ValueError(
            f"image is {image.dtype} {image.shape}; accepted for EXR are numbers [h, w] or [h, w, C], C = 1, 3, 4"
        )
    OpenEXR = _library()
    if half:
        image = np.clip(image, -65504, 65504).astype(np.float16)
    with np.errstate(over="ignore"):
        image = image.astype(np.float16 if half else np.float32)
    names = "Y" if image.shape[2] == 1 else "RGBA"[: image.shape[2]]
    channels = {name: np.ascontiguousarray(image[..., k]) for k, name in enumerate(names)}
    out = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(out)
    return out.getvalue()


def _choose(channels: dict[str, Any]) -> tuple[str, ...]:
    """Names of the channels to read."""
    if len(channels) == 1:
        return tuple(channels)
    if {"RY", "BY"} & set(channels):
        raise ValueError("EXR: luminance-chroma files (Y, RY, BY) are not read; save the picture as RGB")
    found = {}  # by layer, the first set of its channels; the layer "" is the file itself
    for layer in sorted({name.rpartition(".")[0] for name in channels}):
        prefix = f"{layer}." if layer else ""
        sets = [tuple(prefix + n for n in names) for names in CHANNEL_SETS]
        complete = [names for names in sets if all(n in channels for n in names)]
        if complete:
            found[layer] = complete[0]
    if "" in found or len(found) == 1:
        return found.get("") or next(iter(found.values()))
    raise ValueError(
        f"EXR: the file holds the channels {', '.join(sorted(channels))}; accepted are R G B, X Y Z, Y, or one channel"
    )


def _library() -> Any:
    try:
        import OpenEXR
    except ImportError:
        raise ValueError(INSTALL) from None
    if tuple(int(n) for n in OpenEXR.__version__.split(".")[:2]) < (3, 5):  # older ones cannot read from memory
        raise ValueError(f"{INSTALL} (installed is {OpenEXR.__version__})")
    return OpenEXR
