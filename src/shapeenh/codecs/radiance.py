"""Radiance pictures (.hdr, .pic): RGBE pixels, flat or run-length encoded (Ward, Graphics Gems II, "Real Pixels")."""

from __future__ import annotations

import re

import numpy as np

MAX_PIXELS = 1 << 28  # a few bytes of run lengths can claim any size: larger pictures are refused
MIN_RUN = 4  # shorter runs cost more than they save
RESOLUTION = re.compile(rb"([+-])([XY]) +(\d{1,9}) +([+-])([XY]) +(\d{1,9})\s*")
# CIE XYZ to the RGB of Radiance: primaries (.64, .33), (.29, .60), (.15, .06), equal-energy white.
XYZ_TO_RGB = np.array([[2.5653, -1.1668, -0.3985], [-1.0221, 1.9783, 0.0438], [0.0747, -0.2519, 1.1772]])


# ------------------------------------------------------------------------------------------- decoding


def decode_hdr(data: bytes) -> np.ndarray:
    """A Radiance picture as linear RGB radiance.

    Old and new run lengths and flat pixels, all eight orientations, RGBE and XYZE. EXPOSURE and COLORCORR lines are
    divided out, so that values are the scene's. A mantissa m is read as m/256, as most programs do.

    Args:
        data: the file.

    Returns: [h, w, 3] float32, >= 0 for RGBE.
    Errors: ValueError for anything else, and for files that end too early.
    """
    xyz, scale, start = _header(data)
    end = data.find(b"\n", start)
    match = RESOLUTION.fullmatch(data[start:end]) if end >= 0 else None
    if match is None or match[2] == match[5]:
        raise ValueError(
            f"HDR: the resolution line is {data[start : start + 40]!r}; accepted is '-Y 256 +X 512' and the like"
        )
    rows, columns = int(match[3]), int(match[6])
    if not 0 < rows * columns <= MAX_PIXELS:
        raise ValueError(f"HDR: the picture claims {rows} x {columns} pixels; accepted are 1 to {MAX_PIXELS}")
    pixels = _pixels(data, end + 1, rows, columns)

    # The file lists scanlines along its first axis. Standard is -Y +X: from top to bottom, from left to right.
    if match[2] == b"X":
        pixels = pixels.transpose(1, 0, 2)
        up, right = match[4], match[1]
    else:
        up, right = match[1], match[4]
    pixels = pixels[:: -1 if up == b"+" else 1, :: 1 if right == b"+" else -1]

    factor = np.ldexp(1.0, pixels[..., 3].astype(np.int32) - (128 + 8))
    image = pixels[..., :3] * np.where(pixels[..., 3] == 0, 0, factor)[..., None]
    image = image / scale
    if xyz:
        image = image @ XYZ_TO_RGB.T
    limit = float(np.finfo(np.float32).max)
    return np.clip(image, -limit, limit).astype(np.float32)


def _header(data: bytes):
    """(XYZE instead of RGBE, what to divide by [3], where the resolution line starts)."""
    if data[:2] != b"#?":
        raise ValueError(f"HDR: the file starts with {data[:10]!r}; accepted is '#?RADIANCE'")
    xyz, scale, start = False, np.ones(3), 0
    while True:
        end = data.find(b"\n", start)
        if end < 0:
            raise ValueError("HDR: the header does not end")
        line, start = data[start:end].strip(), end + 1
        if not line:
            return xyz, scale, start
        name, _, value = line.partition(b"=")
        if name == b"FORMAT":
            if value.strip() not in (b"32-bit_rle_rgbe", b"32-bit_rle_xyze"):
                raise ValueError(f"HDR: FORMAT is {value.strip()!r}; accepted are 32-bit_rle_rgbe and 32-bit_rle_xyze")
            xyz = value.strip() == b"32-bit_rle_xyze"
        elif name in (b"EXPOSURE", b"COLORCORR"):
            try:
                factor = np.array([float(v) for v in value.split()])
                scale = scale * (factor if factor.size in (1, 3) else np.nan)
            except ValueError:
                scale = scale * np.nan
            if not np.all((scale > 0) & np.isfinite(scale)):
                raise ValueError(f"HDR: {name.decode()} is {value!r}; accepted are numbers > 0")


def _pixels(data: bytes, at: int, rows: int, columns: int) -> np.ndarray:
    """RGBE [rows, columns, 4] uint8. Each scanline says for itself whether it has the new run lengths."""
    if not 8 <= columns < 1 << 15:
        return _old_pixels(data, at, rows * columns).reshape(rows, columns, 4)
    picture: list[np.ndarray] = []
    marker = bytes((2, 2, columns >> 8, columns & 255))
    for row in range(rows):
        if data[at : at + 4] != marker:
            rest = _old_pixels(data, at, (rows - row) * columns).reshape(-1, columns, 4)
            return np.concatenate([np.array(picture, np.uint8).reshape(-1, columns, 4), rest])
        line, at = _new_scanline(data, at + 4, columns, row)
        picture.append(line)
    return np.stack(picture)


def _new_scanline(data: bytes, at: int, columns: int, row: int):
    """One scanline, its four channels one after the other, as runs (128 + n, value) and literals (n, n values)."""
    line = bytearray()
    for channel in range(1, 5):
        wanted = channel * columns
        while len(line) < wanted:
            count = data[at] if at < len(data) else 0
            if count > 128:
                line += data[at + 1 : at + 2] * (count - 128)
                at += 2
            else:
                line += data[at + 1 : at + 1 + count]
                at += 1 + count
            if at > len(data) or count == 0 or len(line) > wanted:
                what = "ends too early" if at >= len(data) else "holds a bad run length"
                raise ValueError(f"HDR: the file {what} in scanline {row}")
    return np.frombuffer(line, np.uint8).reshape(4, columns).T, at


def _old_pixels(data: bytes, at: int, count: int) -> np.ndarray:
    """`count` RGBE pixels; (1, 1, 1, n) repeats the one before n times, and the k-th such in a row n * 256^k times."""
    raw = np.frombuffer(data, np.uint8, offset=at)
    raw = raw[: raw.size // 4 * 4].reshape(-1, 4)
    repeat = np.all(raw[:, :3] == 1, axis=1)
    index = np.arange(len(raw))
    in_row = index - np.maximum.accumulate(np.where(repeat, -1, index))  # 1 for the first of several repeats
    times = np.where(repeat, raw[:, 3] * 256.0 ** np.clip(in_row - 1, 0, 4), 1.0)
    total = np.cumsum(times)
    last = int(np.searchsorted(total, count))
    if last >= len(raw):
        raise ValueError(
            f"HDR: the file ends too early: {int(total[-1]) if len(raw) else 0} of {count} pixels are left in it"
        )
    if total[last] != count or repeat[0]:
        raise ValueError("HDR: a run length leads beyond the picture")
    source = np.maximum.accumulate(np.where(repeat, 0, index))[: last + 1]
    return np.repeat(raw[source], times[: last + 1].astype(np.int64), axis=0)


# ------------------------------------------------------------------------------------------- encoding


def encode_hdr(image) -> bytes:
    """A Radiance picture, new run lengths, orientation -Y +X.

    Args:
        image: [h, w] or [h, w, 3], linear radiance. Negative values become 0, values above 1.69e38 that; mantissas are
            rounded to nearest, so the error is at most 1/255 of a pixel's largest channel.

    Returns: the file. Errors: ValueError for another shape, NaN or infinity.
    """
    image = np.asarray(image, np.float64)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=-1)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"image has shape {image.shape}; accepted for HDR is [h, w] or [h, w, 3]")
    if not np.isfinite(image).all():
        raise ValueError("image holds NaN or infinite values; accepted for HDR are finite numbers")
    rows, columns = image.shape[:2]
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (rows, columns)
    pixels = _rgbe(image)
    if not 8 <= columns < 1 << 15:  # flat; a mantissa >= 128 in every lit pixel cannot be mistaken for a run length
        return header + pixels.tobytes()
    marker = bytes((2, 2, columns >> 8, columns & 255))
    return header + b"".join(marker + b"".join(_runs(line[:, c]) for c in range(4)) for line in pixels)


def _rgbe(image) -> np.ndarray:
    """Shared-exponent pixels [h, w, 4] uint8; 0 below 2^-128."""
    image = np.clip(image, 0, np.ldexp(255 / 256, 127))
    _, exponent = np.frexp(image.max(axis=-1))
    largest = np.rint(np.ldexp(image.max(axis=-1), 8 - exponent))
    exponent = exponent + (largest > 255)  # rounded up to 256
    exponent = np.maximum(exponent, -127)
    mantissa = np.rint(np.ldexp(image, (8 - exponent)[..., None])).astype(np.uint8)
    dark = mantissa.max(axis=-1) < 128  # nothing, or below the smallest exponent
    return np.where(dark[..., None], 0, np.dstack([mantissa, (exponent + 128).astype(np.uint8)])).astype(np.uint8)


def _runs(values) -> bytes:
    """One channel of a scanline as runs of at most 127 and literals of at most 128 bytes."""
    raw = values.tobytes()
    starts = np.flatnonzero(np.diff(values, prepend=~values[:1]) != 0)
    lengths = np.diff(starts, append=len(raw))
    out, done = bytearray(), 0

    def literals(end):
        for k in range(done, end, 128):
            piece = raw[k : min(k + 128, end)]
            out.append(len(piece))
            out.extend(piece)

    for start, length in zip(starts[lengths >= MIN_RUN], lengths[lengths >= MIN_RUN], strict=True):
        literals(start)
        for k in range(0, length, 127):
            out.extend((128 + min(127, length - k), raw[start]))
        done = start + length
    literals(len(raw))
    return bytes(out)
