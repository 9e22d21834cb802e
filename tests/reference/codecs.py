"""Plain writers and readers of image files, byte by byte, as the format descriptions have them."""

import struct
import zlib

import numpy as np

ADAM7 = [(0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)]


# ------------------------------------------------------------------------------------------- PNG


def png_chunk(name, body):
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png_scanlines(image, filters):
    """Filtered bytes of one (sub)image [h, w, C]; row r has filter filters[r % len(filters)]."""
    h, _, channels = image.shape
    size = channels * image.dtype.itemsize
    rows = [list(image[r].astype(image.dtype.newbyteorder(">")).tobytes()) for r in range(h)]
    out = bytearray()
    for r, row in enumerate(rows):
        kind = filters[r % len(filters)]
        out.append(kind)
        for k, x in enumerate(row):
            a = row[k - size] if k >= size else 0
            b = rows[r - 1][k] if r else 0
            c = rows[r - 1][k - size] if r and k >= size else 0
            p = a + b - c
            paeth = min((a, b, c), key=lambda v: abs(p - v))  # min keeps the first of equals: a, b, c
            out.append((x - (0, a, b, (a + b) // 2, paeth)[kind]) % 256)
    return bytes(out)


def png_file(image, *, filters=(0,), interlaced=False):
    """A PNG of [h, w, C] uint8 or uint16."""
    h, w, channels = image.shape
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", w, h, 8 * image.dtype.itemsize, kind, 0, 0, int(interlaced))
    if interlaced:
        parts = [image[r::dr, c::dc] for r, c, dr, dc in ADAM7]
        raw = b"".join(png_scanlines(p, filters) for p in parts if p.size)
    else:
        raw = png_scanlines(image, filters)
    body = zlib.compress(raw)
    middle = len(body) // 2
    return (
        b"\x89PNG\r\n\x1a\n"
        + png_chunk(b"IHDR", header)
        + png_chunk(b"tEXt", b"Comment\0of no importance")
        + png_chunk(b"IDAT", body[:middle])
        + png_chunk(b"IDAT", body[middle:])
        + png_chunk(b"IEND", b"")
    )


# ------------------------------------------------------------------------------------------- Radiance


def rgbe_to_float(pixels):
    """[..., 4] uint8 to [..., 3] float64."""
    out = np.zeros((*pixels.shape[:-1], 3))
    for index in np.ndindex(pixels.shape[:-1]):
        r, g, b, e = (int(v) for v in pixels[index])
        if e:
            out[index] = [v / 256 * 2.0 ** (e - 128) for v in (r, g, b)]
    return out


def hdr_old_runs(pixels):
    """Flat RGBE pixels [n, 4] with the old run lengths: (1, 1, 1, count), counts above 255 in several."""
    out, k = [], 0
    while k < len(pixels):
        n = 1
        while k + n < len(pixels) and (pixels[k + n] == pixels[k]).all():
            n += 1
        out.append(bytes(pixels[k]))
        rest = n - 1
        while rest:
            out.append(bytes((1, 1, 1, rest & 255)))
            rest >>= 8
        k += n
    return b"".join(out)


def hdr_new_scanlines(pixels):
    """New run lengths of [rows, columns, 4]: runs of 2 and more, literals one by one."""
    out = bytearray()
    for line in pixels:
        out += bytes((2, 2, len(line) >> 8, len(line) & 255))
        for channel in range(4):
            values, k = [int(v) for v in line[:, channel]], 0
            while k < len(values):
                n = 1
                while n < 127 and k + n < len(values) and values[k + n] == values[k]:
                    n += 1
                out += bytes((128 + n, values[k])) if n > 1 else bytes((1, values[k]))
                k += n
    return bytes(out)


# ------------------------------------------------------------------------------------------- TIFF


def tiff_predict(block, predictor, order):
    """Bytes of [rows, columns, C] with a predictor undone by the reader."""
    size = block.dtype.itemsize
    if predictor == 3:
        out = b""
        for row in block:
            raw = row.astype(block.dtype.newbyteorder(">")).tobytes()
            planes = b"".join(raw[k::size] for k in range(size))
            step = block.shape[2]
            out += bytes((planes[k] - (planes[k - step] if k >= step else 0)) % 256 for k in range(len(planes)))
        return out
    if predictor == 2:
        whole = block.view(f"u{size}").copy()
        for column in range(block.shape[1] - 1, 0, -1):
            whole[:, column] -= whole[:, column - 1]
        block = whole
    return block.astype(block.dtype.newbyteorder(order)).tobytes()


def tiff_file(image, *, order="<", rows=None, tile=None, planar=False, deflate=False, predictor=1, big=False, extra=()):
    """A TIFF of [h, w, C]; `rows` per strip or `tile` (rows, columns); extra: [(tag, type letter, values)]."""
    h, w, channels = image.shape
    down, across = tile or (rows or h, w)
    planes = [image[..., k : k + 1] for k in range(channels)] if planar else [image]
    blocks = []
    for plane in planes:
        for r in range(0, h, down):
            for c in range(0, w, across):
                block = plane[r : r + down, c : c + across]
                if tile:
                    pad = [(0, down - block.shape[0]), (0, across - block.shape[1]), (0, 0)]
                    block = np.pad(block, pad, mode="edge")
                body = tiff_predict(np.ascontiguousarray(block), predictor, order)
                blocks.append(zlib.compress(body) if deflate else body)
    pointer = "Q" if big else "I"
    kind = {"u": 1, "i": 2, "f": 3}[image.dtype.kind]
    where, count = (324, 325) if tile else (273, 279)
    tags = [(256, "I", [w]), (257, "I", [h]), (258, "H", [8 * image.dtype.itemsize] * channels)]
    tags += [(259, "H", [8 if deflate else 1]), (262, "H", [1]), (277, "H", [channels])]
    tags += [(284, "H", [2 if planar else 1]), (317, "H", [predictor]), (339, "H", [kind] * channels)]
    tags += [(322, "I", [across]), (323, "I", [down])] if tile else [(278, "I", [down])]
    at = 16 if big else 8
    offsets = []
    for block in blocks:
        offsets.append(at)
        at += len(block)
    tags += [(where, pointer, offsets), (count, pointer, [len(b) for b in blocks]), *extra]
    room = 8 if big else 4
    table = at
    at += (8 if big else 2) + len(tags) * (4 + 2 * room) + room
    entries, bodies = b"", b""
    codes = {"H": 3, "I": 4, "Q": 16, "s": 2, "d": 12}
    for tag, letter, values in sorted(tags):
        body = values if letter == "s" else struct.pack(f"{order}{len(values)}{letter}", *values)
        entries += struct.pack(f"{order}HH{pointer}", tag, codes[letter], len(values))
        if len(body) > room:
            entries += struct.pack(order + pointer, at + len(bodies))
            bodies += body
        else:
            entries += body + bytes(room - len(body))
    mark = b"II" if order == "<" else b"MM"
    head = struct.pack(f"{order}HHHQ", 43, 8, 0, table) if big else struct.pack(f"{order}HI", 42, table)
    counter = struct.pack(order + ("Q" if big else "H"), len(tags))
    return mark + head + b"".join(blocks) + counter + entries + bytes(room) + bodies
