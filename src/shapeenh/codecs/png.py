"""PNG with 8 or 16 bits per channel (ISO/IEC 15948): grey, grey + alpha, RGB, RGBA, Adam7 included.

The usual readers reduce 16-bit colour to 8 bits, which costs a normal map its curvature; hence this one.
"""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np

SIGNATURE = b"\x89PNG\r\n\x1a\n"
CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # by colour type; 3 is a palette
COLOR_TYPE = {1: 0, 2: 4, 3: 2, 4: 6}
ADAM7 = (
    (0, 0, 8, 8),
    (0, 4, 8, 8),
    (4, 0, 8, 4),
    (0, 2, 4, 4),
    (2, 0, 4, 2),
    (0, 1, 2, 2),
    (1, 0, 2, 1),
)  # row, column, steps
SUB, UP, AVERAGE, PAETH = 1, 2, 3, 4
BLOCK = 1 << 22  # bytes filtered at a time when writing


# ------------------------------------------------------------------------------------------- decoding


def decode_png(data: bytes) -> np.ndarray:
    """A PNG in the numbers of the file; gamma and colour profiles are not applied.

    16-bit files and plain 8-bit ones are decoded here; palettes and 1, 2, 4 bits by imageio, to 8 bits.

    Args:
        data: the file.

    Returns: [h, w] (grey) or [h, w, C], C = 2 (grey + alpha), 3, 4; uint8 or uint16.
    Errors: ValueError for anything else, wrong checksums and files that end too early.
    """
    width, height, bits, kind, interlaced, packed = _chunks(data)
    if kind not in CHANNELS or bits not in (8, 16):
        return _by_imageio(data)
    channels = CHANNELS[kind]
    pixel = channels * bits // 8
    passes = ADAM7 if interlaced else ((0, 0, 1, 1),)
    sizes = [(max(0, -(-(height - r) // dr)), max(0, -(-(width - c) // dc))) for r, c, dr, dc in passes]
    raw = _inflate(packed, sum(h * (1 + w * pixel) for h, w in sizes if w))
    image, at = np.empty((height, width, pixel), np.uint8), 0
    for (r, c, dr, dc), (h, w) in zip(passes, sizes, strict=True):
        if h and w:
            lines = raw[at : at + h * (1 + w * pixel)].reshape(h, 1 + w * pixel)
            image[r::dr, c::dc] = _unfilter(lines[:, 0], lines[:, 1:].reshape(h, w, pixel))
            at += lines.size
    values = image if bits == 8 else image.view(">u2").astype(np.uint16)
    return values[..., 0] if channels == 1 else values


def _chunks(data: bytes):
    """(width, height, bits, colour type, interlaced, compressed pixels)."""
    if data[:8] != SIGNATURE:
        raise ValueError(f"PNG: the file starts with {data[:8]!r}, which is no PNG signature")
    header, packed, at = None, [], 8
    while True:
        if at + 12 > len(data):
            raise ValueError("PNG: the file ends before its IEND chunk")
        (length,), name = struct.unpack_from(">I", data, at), data[at + 4 : at + 8]
        body = data[at + 8 : at + 8 + length]
        if at + 12 + length > len(data):
            raise ValueError(f"PNG: the file ends within its {name!r} chunk")
        critical = not name[0] & 32
        if critical and zlib.crc32(name + body) != struct.unpack_from(">I", data, at + 8 + length)[0]:
            raise ValueError(f"PNG: the checksum of the {name!r} chunk at byte {at} is wrong")
        if header is None:
            if name != b"IHDR" or length != 13:
                raise ValueError(f"PNG: the first chunk is {name!r} of {length} bytes; accepted is IHDR of 13")
            header = struct.unpack(">IIBBBBB", body)
        elif name == b"IDAT":
            packed.append(body)
        elif name == b"IEND":
            break
        elif critical and name != b"PLTE":
            raise ValueError(f"PNG: the critical chunk {name!r} is not known")
        at += 12 + length
    width, height, bits, kind, compression, filtering, interlace = header
    if not width or not height or compression or filtering or interlace > 1:
        raise ValueError(
            f"PNG: the header holds {width} x {height}, {compression}, {filtering}, {interlace}, which is no PNG"
        )
    if bits not in {0: (1, 2, 4, 8, 16), 3: (1, 2, 4, 8)}.get(kind, (8, 16)) or kind not in (0, 2, 3, 4, 6):
        raise ValueError(f"PNG: colour type {kind} with {bits} bits is not a PNG kind")
    return width, height, bits, kind, interlace == 1, b"".join(packed)


def _inflate(packed: bytes, size: int) -> np.ndarray:
    """Exactly `size` bytes; never more memory than the compressed bytes can account for (1032 : 1)."""
    if size > 1032 * len(packed) + 1032:
        raise ValueError(
            f"PNG: {len(packed)} compressed bytes cannot hold the {size} bytes of pixels that the header says"
        )
    try:
        raw = zlib.decompressobj().decompress(packed, size)
    except zlib.error as error:
        raise ValueError(f"PNG: the pixels cannot be inflated: {error}") from None
    if len(raw) != size:
        raise ValueError(f"PNG: the file holds {len(raw)} of {size} bytes of pixels")
    return np.frombuffer(raw, np.uint8)


def _unfilter(kinds, lines) -> np.ndarray:
    """Undo the filter of each row; kinds [h], lines and result [h, w, bytes per pixel] uint8."""
    if kinds.max() > PAETH:
        raise ValueError(f"PNG: row filter {kinds.max()} is not known; accepted are 0 to 4")
    if kinds.max() > UP:
        return _unfilter_diagonally(kinds, lines)
    out = np.array(lines)
    out[kinds == SUB] = np.add.accumulate(lines[kinds == SUB], axis=1, dtype=np.uint8)
    for row in np.flatnonzero(kinds == UP):
        if row:
            out[row] += out[row - 1]
    return out


def _unfilter_diagonally(kinds, lines) -> np.ndarray:
    """As `_unfilter`, for rows that depend on their own left neighbours (average, Paeth).

    A pixel needs its left, upper and upper left neighbours, so all pixels of one anti-diagonal are independent. In a
    picture with a border row and column of zeros, laid out flat, an anti-diagonal is a slice of constant stride, and
    the neighbours are the same slice moved: h + w steps on views instead of h w steps.
    """
    h, w, pixel = lines.shape
    stride = w + 1
    out = np.zeros((h + 1, stride, pixel), np.uint8)
    out[1:, 1:] = lines
    flat = out.reshape(-1, pixel)
    kinds = kinds[:, None]
    is_sub, is_up, is_average, is_paeth = (kinds == k for k in (SUB, UP, AVERAGE, PAETH))
    for diagonal in range(h + w - 1):
        top, bottom = max(0, diagonal - w + 1), min(h - 1, diagonal)  # rows, inclusive; column = diagonal - row
        first = (top + 1) * stride + diagonal - top + 1
        last = (bottom + 1) * stride + diagonal - bottom + 1

        def view(offset, first=first, last=last):
            return flat[first - offset : last - offset + 1 : w]

        a, b, c = (view(k).astype(np.int16) for k in (1, stride, stride + 1))
        rows = slice(top, bottom + 1)
        to_a, to_b = b - c, a - c  # p - a and p - b for p = a + b - c
        to_c = np.abs(to_a + to_b)
        np.abs(to_a, out=to_a)
        np.abs(to_b, out=to_b)
        nearest = np.where((to_a <= to_b) & (to_a <= to_c), a, np.where(to_b <= to_c, b, c))
        guess = nearest * is_paeth[rows] + ((a + b) >> 1) * is_average[rows] + a * is_sub[rows] + b * is_up[rows]
        view(0)[...] += guess.astype(np.uint8)
    return out[1:, 1:]


def _by_imageio(data: bytes) -> np.ndarray:
    import imageio.v3 as iio

    try:
        image = np.asarray(iio.imread(io.BytesIO(data), extension=".png"))
    except MemoryError:
        raise
    except Exception as error:  # Pillow's parsers let several kinds through
        raise ValueError(f"PNG: {str(error).splitlines()[0] if str(error) else type(error).__name__}") from None
    return image.astype(np.uint8) * 255 if image.dtype == bool else image


# ------------------------------------------------------------------------------------------- encoding


def encode_png(image, *, level: int = 6) -> bytes:
    """A PNG of 8 or 16 bits per channel, not interlaced.

    Args:
        image: [h, w], or [h, w, C] with C = 1, 2 (grey + alpha), 3, 4; uint8 or uint16.
        level: of zlib, 0 to 9.

    Returns: the file. Errors: ValueError for another shape or dtype.
    """
    image = np.asarray(image)
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"image has dtype {image.dtype}; accepted for PNG are uint8 and uint16")
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in COLOR_TYPE or image.size == 0:
        raise ValueError(f"image has shape {image.shape}; accepted for PNG is [h, w] or [h, w, C], C = 1 to 4")
    height, width, channels = image.shape
    bits = 8 * image.dtype.itemsize
    lines = np.ascontiguousarray(image.astype(image.dtype.newbyteorder(">"))).view(np.uint8).reshape(height, width, -1)
    packer = zlib.compressobj(level)
    block = max(1, BLOCK // lines[0].size)
    packed = [packer.compress(_filter(lines, r, min(height, r + block)).tobytes()) for r in range(0, height, block)]
    packed.append(packer.flush())
    header = struct.pack(">IIBBBBB", width, height, bits, COLOR_TYPE[channels], 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", b"".join(packed)), (b"IEND", b""))
    return SIGNATURE + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    )


def _filter(lines, start: int, stop: int) -> np.ndarray:
    """Rows start:stop filtered, each by the kind with the least sum of absolute residuals (as the standard advises)."""
    x = lines[start:stop]
    a, b, c = (np.zeros(x.shape, np.int16) for _ in range(3))
    above = slice(max(start, 1) - 1, stop - 1)
    first = 1 if start == 0 else 0
    a[:, 1:], b[first:], c[first:, 1:] = x[:, :-1], lines[above], lines[above, :-1]
    to_a, to_b, to_c = np.abs(b - c), np.abs(a - c), np.abs(a + b - 2 * c)
    paeth = np.where((to_a <= to_b) & (to_a <= to_c), a, np.where(to_b <= to_c, b, c))
    residuals = [x] + [x - guess.astype(np.uint8) for guess in (a, b, (a + b) >> 1, paeth)]
    costs = [np.abs(r.view(np.int8).astype(np.int16)).sum(axis=(1, 2), dtype=np.int64) for r in residuals]
    best = np.argmin(costs, axis=0)
    chosen = np.empty_like(x)
    for kind, residual in enumerate(residuals):
        chosen[best == kind] = residual[best == kind]
    return np.concatenate([best.astype(np.uint8)[:, None], chosen.reshape(len(x), -1)], axis=1)
