"""TIFF 6.0 and BigTIFF with 8, 16, 32, 64 bits per channel, integer or float: the first picture of a file.

Strips and tiles, both byte orders, channels together or apart; no compression, deflate, LZW, PackBits, Zstandard;
horizontal and floating-point predictors (Adobe Photoshop TIFF Technical Note 3). That is what elevation
models and scans come in; the usual readers take float files of one channel only, and drop their georeference.
"""

from __future__ import annotations

import io
import zlib
from typing import Any

import numpy as np

from shapeenh.codecs.tiff_directory import (
    BITS,
    COMPRESSION,
    GDAL_NODATA,
    HEIGHT,
    PHOTOMETRIC,
    PIXEL_SCALE,
    PLANAR,
    PREDICTOR,
    ROWS_PER_STRIP,
    SAMPLE_FORMAT,
    SAMPLES,
    STRIP_COUNTS,
    STRIP_OFFSETS,
    TILE_COUNTS,
    TILE_HEIGHT,
    TILE_OFFSETS,
    TILE_WIDTH,
    WIDTH,
    one,
    read_directory,
    write_file,
)

NONE, LZW, DEFLATE, PACKBITS, ZSTD = 1, 5, (8, 32946), 32773, 50000
MAX_RATIO = 5000  # what the densest of these compressions can reach; a header that claims more is corrupt
KIND = {1: "u", 2: "i", 3: "f"}


# ------------------------------------------------------------------------------------------- decoding


def decode_tiff(data: bytes) -> np.ndarray:
    """The first picture of a TIFF, in the numbers of the file (white-is-zero integers are inverted).

    Args:
        data: the file.

    Returns: [h, w], or [h, w, C] for C > 1 channels; (u)int 8 to 64, float 16 to 64.
    Errors: ValueError for other kinds (palettes, bilevel, JPEG) and for corrupt files.
    """
    order, tags = read_directory(data)
    width, height = one(tags, WIDTH), one(tags, HEIGHT)
    samples = one(tags, SAMPLES, 1)
    if min(width, height, samples) < 1:
        raise ValueError(f"TIFF: the picture has {width} x {height} pixels of {samples} channels")
    dtype = _dtype(tags, samples)
    planes = samples if one(tags, PLANAR, 1) == 2 and samples > 1 else 1
    offsets, counts, tile_height, tile_width = _segments(tags, height, width)
    down, across = -(-height // tile_height), -(-width // tile_width)
    if min(len(offsets), len(counts)) < planes * down * across:
        raise ValueError(
            f"TIFF: {len(offsets)} strips or tiles cannot hold a picture of {width} x {height} x {samples}"
        )
    size = width * height * samples * dtype.itemsize
    if size > MAX_RATIO * len(data):
        raise ValueError(
            f"TIFF: {len(data)} bytes cannot hold the {width} x {height} x {samples} picture that the header claims"
        )

    image = np.empty((height, width, samples), dtype)
    depth = samples // planes
    for index in range(planes * down * across):
        plane, row, column = index // (down * across), index // across % down * tile_height, index % across * tile_width
        tiled = TILE_OFFSETS in tags
        shape = (tile_height if tiled else min(tile_height, height - row), tile_width, depth)
        packed = data[offsets[index] : offsets[index] + counts[index]]
        if len(packed) != counts[index]:
            raise ValueError(f"TIFF: the file ends within strip or tile {index} of {len(offsets)}")
        block = _block(packed, tags, order, dtype, shape, index)
        target = image[row : row + tile_height, column : column + tile_width, plane * depth : (plane + 1) * depth]
        target[...] = block[: target.shape[0], : target.shape[1]]

    if one(tags, PHOTOMETRIC, 1) == 0 and dtype.kind == "u":
        image = np.iinfo(dtype).max - image
    return image[..., 0] if samples == 1 else image


def tiff_georeference(data: bytes) -> tuple[tuple[float, float] | None, float | None]:
    """What an elevation model says about itself: (cell size (dx, dy) in map units, nodata value), None where missing.

    From the GeoTIFF tag ModelPixelScale and GDAL's nodata tag. Cells in degrees are told in degrees.

    Errors: ValueError for a file that is no TIFF.
    """
    _, tags = read_directory(data)
    scale, nodata = tags.get(PIXEL_SCALE), tags.get(GDAL_NODATA)
    spacing = (float(scale[0]), float(scale[1])) if scale and len(scale) >= 2 and min(scale[:2]) > 0 else None
    try:
        value = float(nodata.split(b"\0")[0]) if isinstance(nodata, bytes) else None
    except ValueError:
        value = None
    return spacing, value


def _dtype(tags, samples: int) -> np.dtype:
    bits, kinds = tags.get(BITS, (1,)), tags.get(SAMPLE_FORMAT, (1,))
    name = f"{KIND.get(kinds[0], '?')}{bits[0] // 8}"
    same = len(set(bits[:samples])) == 1 and len(set(kinds[:samples])) == 1
    if not same or bits[0] % 8 or name not in ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f2", "f4", "f8"):
        raise ValueError(
            f"TIFF: bits per sample {bits}, sample format {kinds}; accepted are integers from 8 and floats from 16 bits"
        )
    if one(tags, PHOTOMETRIC, 1) not in (0, 1, 2):
        raise ValueError(
            f"TIFF: photometric interpretation {tags[PHOTOMETRIC][0]}; accepted are grey (0, 1) and RGB (2)"
        )
    return np.dtype(name)


def _segments(tags, height: int, width: int):
    """(offsets, byte counts, rows, columns) of the strips or tiles."""
    if TILE_OFFSETS in tags:
        shape = one(tags, TILE_HEIGHT), one(tags, TILE_WIDTH)
        offsets, counts = tags[TILE_OFFSETS], tags.get(TILE_COUNTS)
    else:
        shape = min(one(tags, ROWS_PER_STRIP, height), height), width
        offsets, counts = tags.get(STRIP_OFFSETS), tags.get(STRIP_COUNTS)
    if not offsets or not counts or min(shape) < 1:
        raise ValueError("TIFF: the tags that say where the pixels are are missing or zero")
    return offsets, counts, *shape


def _block(packed: bytes, tags, order: Any, dtype: np.dtype, shape: tuple[int, int, int], index: int) -> np.ndarray:
    """One strip or tile [rows, columns, channels], decompressed, its predictor undone."""
    rows, columns, depth = shape
    row_bytes = columns * depth * dtype.itemsize
    raw = np.frombuffer(_decompress(packed, one(tags, COMPRESSION, 1), rows, row_bytes, index), np.uint8)
    predictor = one(tags, PREDICTOR, 1)
    if predictor == 3 and dtype.kind == "f":
        # Rows of bytes, differenced by pixel; each row holds all first bytes of its numbers, then all second ones.
        lines = np.add.accumulate(raw.reshape(rows, -1, depth), axis=1, dtype=np.uint8)
        lines = lines.reshape(rows, dtype.itemsize, columns * depth).transpose(0, 2, 1)
        return np.ascontiguousarray(lines).view(dtype.newbyteorder(">")).reshape(shape).astype(dtype)
    values = raw.view(dtype.newbyteorder(order)).astype(dtype).reshape(shape)
    if predictor == 2:  # differences of the numbers as integers, floats too
        whole = np.dtype(f"u{dtype.itemsize}")
        return np.add.accumulate(values.view(whole), axis=1, dtype=whole).view(dtype)
    if predictor != 1:
        raise ValueError(f"TIFF: predictor {predictor} for {dtype} is not known; accepted are 1, 2, and 3 for floats")
    return values


def _decompress(packed: bytes, compression: int, rows: int, row_bytes: int, index: int) -> bytes:
    size = rows * row_bytes
    if size > MAX_RATIO * (len(packed) + 1):
        raise ValueError(f"TIFF: {len(packed)} bytes cannot hold the {size} bytes of strip or tile {index}")
    if compression == NONE:
        raw = packed[:size]
    elif compression in DEFLATE:
        try:
            raw = zlib.decompressobj().decompress(packed, size)
        except zlib.error as error:
            raise ValueError(f"TIFF: strip or tile {index} cannot be inflated: {error}") from None
    elif compression in (LZW, PACKBITS, ZSTD):
        raw = _by_pillow(packed, compression, rows, row_bytes, index)
    else:
        raise ValueError(f"TIFF: compression {compression}; accepted are none, deflate, LZW, PackBits, Zstandard")
    if len(raw) != size:
        raise ValueError(f"TIFF: strip or tile {index} holds {len(raw)} of {size} bytes")
    return raw


def _by_pillow(packed: bytes, compression: int, rows: int, row_bytes: int, index: int) -> bytes:
    """Bytes of one strip by libtiff, which Pillow has built in: to it the strip is a grey 8-bit picture of its own."""
    from PIL import Image

    tags = {WIDTH: row_bytes, HEIGHT: rows, BITS: 8, COMPRESSION: compression, PHOTOMETRIC: 1, STRIP_OFFSETS: 0,
            SAMPLES: 1, ROWS_PER_STRIP: rows, STRIP_COUNTS: len(packed)}  # fmt: skip
    try:
        with Image.open(io.BytesIO(write_file(tags, [packed])), formats=["TIFF"]) as image:
            return image.tobytes()
    except MemoryError:
        raise
    except Exception as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"TIFF: strip or tile {index} cannot be decompressed: {text}") from None


# ------------------------------------------------------------------------------------------- encoding


def encode_tiff(image, *, spacing=None, nodata: float | None = None) -> bytes:
    """A float32 TIFF, little-endian, strips of deflate; without a predictor, which not every reader knows.

    Args:
        image: [h, w] or [h, w, C], C = 1 to 4, numbers; NaN and infinity are kept.
        spacing: cell size (dx, dy) or None: the GeoTIFF tag ModelPixelScale.
        nodata: a number or None: GDAL's nodata tag.

    Returns: the file. Errors: ValueError for another shape or dtype.
    """
    image = np.asarray(image)
    if image.dtype.kind not in "biuf":
        raise ValueError(f"image has dtype {image.dtype}; accepted for TIFF are numbers")
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or not 1 <= image.shape[2] <= 4 or image.size == 0:
        raise ValueError(f"image has shape {image.shape}; accepted for TIFF is [h, w] or [h, w, C], C = 1 to 4")
    with np.errstate(over="ignore"):
        image = image.astype("<f4")
    height, width, samples = image.shape
    rows = max(1, (1 << 18) // (4 * width * samples))
    strips = [zlib.compress(image[start : start + rows].tobytes(), 6) for start in range(0, height, rows)]
    counts = tuple(len(s) for s in strips)
    tags: dict[int, Any] = {
        WIDTH: width, HEIGHT: height, BITS: (32,) * samples, COMPRESSION: DEFLATE[0],
        PHOTOMETRIC: 2 if samples > 2 else 1,
        STRIP_OFFSETS: (0,) * len(strips), SAMPLES: samples, ROWS_PER_STRIP: rows, STRIP_COUNTS: counts, PLANAR: 1,
        SAMPLE_FORMAT: (3,) * samples,
    }  # fmt: skip
    if samples in (2, 4):
        tags[338] = 0  # ExtraSamples: unspecified
    if spacing is not None:
        dx, dy = (float(s) for s in spacing)
        tags[PIXEL_SCALE] = (dx, dy, 0.0)
    if nodata is not None:
        tags[GDAL_NODATA] = f"{float(nodata):.17g}".encode() + b"\0"
    return write_file(tags, strips)
