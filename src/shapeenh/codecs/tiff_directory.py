"""The directory of a TIFF: numbered tags that say how the pixels that follow are to be read (TIFF 6.0, BigTIFF)."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC = 256, 257, 258, 259, 262
STRIP_OFFSETS, SAMPLES, ROWS_PER_STRIP, STRIP_COUNTS, PLANAR = 273, 277, 278, 279, 284
PREDICTOR, TILE_WIDTH, TILE_HEIGHT, TILE_OFFSETS, TILE_COUNTS, SAMPLE_FORMAT = 317, 322, 323, 324, 325, 339
PIXEL_SCALE, GDAL_NODATA = 33550, 42113
NAMES = {WIDTH: "ImageWidth", HEIGHT: "ImageLength", TILE_WIDTH: "TileWidth", TILE_HEIGHT: "TileLength"}
FIELD = dict(zip((1, 2, 3, 4, 6, 7, 8, 9, 11, 12, 13, 16, 17, 18), "BsHIbshifdIQqQ", strict=True))  # as struct has them


def read_directory(data: bytes) -> tuple[Any, dict[int, Any]]:
    """(byte order, {tag: tuple of numbers, or bytes for text}) of the first picture."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2], "")
    try:
        version = struct.unpack_from(f"{order}H", data, 2)[0] if order else 0
        if version not in (42, 43):
            raise ValueError(f"TIFF: the file starts with {data[:4]!r}, which is no TIFF signature")
        word = "I" if version == 42 else "Q"
        start = struct.unpack_from(order + word, data, 4 if version == 42 else 8)[0]
        entry = struct.Struct(order + "HH" + word)
        room = struct.calcsize(word)
        counter = struct.Struct(order + ("H" if version == 42 else "Q"))
        length = counter.unpack_from(data, start)[0]
        tags: dict[int, Any] = {}
        for k in range(min(length, 4096)):
            at = start + counter.size + k * (entry.size + room)
            tag, field, count = entry.unpack_from(data, at)
            value = at + entry.size
            if field not in FIELD or (FIELD[field] in "sfd" and tag not in (PIXEL_SCALE, GDAL_NODATA)):
                continue
            size = struct.calcsize("=" + FIELD[field])
            if size * count > room:
                value = struct.unpack_from(order + word, data, value)[0]
            if size * count > len(data) - value:
                raise ValueError(f"TIFF: the values of tag {tag} lie beyond the end of the file")
            if FIELD[field] == "s":
                tags[tag] = data[value : value + count]
            else:
                tags[tag] = struct.unpack_from(f"{order}{count}{FIELD[field]}", data, value)
    except (struct.error, OverflowError):
        raise ValueError("TIFF: the file ends within its directory") from None
    return order, tags


def one(tags, tag: int, default: int | None = None) -> int:
    """The first value of a tag; without a default the tag must be there."""
    value = tags.get(tag)
    if not value:
        if default is None:
            raise ValueError(f"TIFF: the tag {NAMES.get(tag, tag)} is missing")
        return default
    return int(value[0])


def write_file(tags: dict[int, Any], strips: list[bytes]) -> bytes:
    """Header, directory, values, strips; fills in the strips' offsets."""
    fields = []
    for tag, value in sorted(tags.items()):
        values = value if isinstance(value, bytes | tuple) else (value,)
        if isinstance(values, bytes):
            fields.append((tag, 2, len(values), values))
        elif isinstance(values[0], float):
            fields.append((tag, 12, len(values), struct.pack(f"<{len(values)}d", *values)))
        else:
            long = tag in (STRIP_OFFSETS, STRIP_COUNTS) or max(values) > 65535
            kind, letter = (4, "I") if long else (3, "H")
            fields.append((tag, kind, len(values), struct.pack(f"<{len(values)}{letter}", *values)))
    at = 8 + 2 + 12 * len(fields) + 4
    places = []  # of values that do not fit the directory
    for _, _, _, body in fields:
        places.append(at)
        at += len(body) + len(body) % 2 if len(body) > 4 else 0
    offsets = np.cumsum([at] + [len(s) for s in strips[:-1]])
    if at + sum(len(s) for s in strips) >= 1 << 32:
        raise ValueError("image is too large: a TIFF holds at most 4 GiB")
    packed_offsets = struct.pack(f"<{len(strips)}I", *offsets.tolist())
    directory: list[bytes] = []
    bodies: list[bytes] = []
    for (tag, kind, count, body), place in zip(fields, places, strict=True):
        body = packed_offsets if tag == STRIP_OFFSETS else body
        if len(body) > 4:
            directory.append(struct.pack("<HHII", tag, kind, count, place))
            bodies.append(body + b"\0" * (len(body) % 2))
        else:
            directory.append(struct.pack("<HHI", tag, kind, count) + body.ljust(4, b"\0"))
    head = struct.pack("<2sHIH", b"II", 42, 8, len(fields))
    return b"".join([head, *directory, b"\0" * 4, *bodies, *strips])
