"""Image files as bytes: round trips, files of plain writers, other programs' readings, corrupt files."""

import io
import struct
import sys
import zlib

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from shapeenh import codecs
from tests.reference import codecs as plain


def picture(dtype, shape, rng):
    """A smooth picture with a noisy half, so that every predictor and run has something to do."""
    h, w, channels = shape
    y, x, c = np.meshgrid(np.arange(h), np.arange(w), np.arange(channels), indexing="ij")
    smooth = 0.5 + 0.3 * np.sin(x / 5 + c) + 0.19 * np.cos(y / 3 - c)
    smooth = np.where(x > w / 2, smooth, rng.random(shape))
    dtype = np.dtype(dtype)
    if dtype.kind == "f":
        return ((smooth - 0.5) * 100).astype(dtype)
    info = np.iinfo(dtype)
    return (info.min + smooth * (float(info.max) - float(info.min)) * 0.999).astype(dtype)


# ------------------------------------------------------------------------------------------- PNG


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_png_round_trip(dtype, channels, rng):
    for size in ((13, 17), (1, 9), (9, 1), (1, 1)):
        image = picture(dtype, (*size, channels), rng)
        back = codecs.decode_png(codecs.encode_png(image))
        assert back.dtype == image.dtype
        assert np.array_equal(back, image[..., 0] if channels == 1 else image)


@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize("filters", [(0,), (1,), (2,), (3,), (4,), (0, 1, 2), (4, 3, 2, 1, 0)])
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_png_of_a_plain_writer(filters, interlaced, dtype, rng):
    for shape in ((11, 7, 3), (5, 12, 1), (1, 6, 4), (6, 1, 2), (1, 1, 3)):
        image = picture(dtype, shape, rng)
        back = codecs.decode_png(plain.png_file(image, filters=filters, interlaced=interlaced))
        assert np.array_equal(back.reshape(shape), image)


def test_png_is_what_pillow_reads(rng):
    for dtype, channels in (("uint8", 3), ("uint8", 4), ("uint8", 2), ("uint8", 1), ("uint16", 1)):
        image = picture(dtype, (23, 31, channels), rng)
        data = codecs.encode_png(image)
        assert np.array_equal(np.asarray(Image.open(io.BytesIO(data))).reshape(image.shape), image)
    image = picture("uint16", (23, 31, 3), rng)
    data = codecs.encode_png(image)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(data))), image >> 8)  # all that Pillow keeps


def test_png_large_blocks(monkeypatch, rng):
    """Rows are filtered block by block when writing: the blocks must not show."""
    image = picture("uint16", (40, 9, 3), rng)
    whole = codecs.encode_png(image)
    monkeypatch.setattr(sys.modules["shapeenh.codecs.png"], "BLOCK", 150)
    assert codecs.encode_png(image) == whole


def test_png_palette_and_bits_go_to_imageio(rng):
    indexed = Image.fromarray(picture("uint8", (8, 9, 3), rng)).quantize(16)
    out = io.BytesIO()
    indexed.save(out, "PNG")
    assert np.array_equal(codecs.decode_png(out.getvalue()), np.asarray(indexed.convert("RGB")))
    bits = rng.random((5, 11)) > 0.5
    out = io.BytesIO()
    Image.fromarray(bits).save(out, "PNG")
    assert np.array_equal(codecs.decode_png(out.getvalue()), bits.astype(np.uint8) * 255)


def test_png_errors(rng):
    data = codecs.encode_png(picture("uint16", (6, 5, 3), rng))
    at = data.index(b"IDAT")
    size = struct.unpack(">I", data[at - 4 : at])[0]

    def with_pixels(body):
        return data[: at - 4] + plain.png_chunk(b"IDAT", body) + plain.png_chunk(b"IEND", b"")

    cases = {
        "signature": b"GIF89a" + data,
        "ends before its IEND": data[:-12],
        "ends within its b'IDAT'": data[: at + 10],
        "checksum of the b'IDAT'": data[: at + 9] + bytes([data[at + 9] ^ 1]) + data[at + 10 :],
        "cannot be inflated": with_pixels(b"nothing that zlib knows, but long enough for the size"),
        "holds 10 of": with_pixels(zlib.compress(bytes(10)) + bytes(40)),
        "row filter 9": with_pixels(zlib.compress(bytes([9] * 6 * 31))),
        "first chunk": data[:8] + data[at - 4 :],
        "not a PNG kind": data[:8] + plain.png_chunk(b"IHDR", struct.pack(">IIBBBBB", 5, 6, 4, 2, 0, 0, 0)) + data[33:],
        "cannot hold": data[:8]
        + plain.png_chunk(b"IHDR", struct.pack(">IIBBBBB", 1 << 30, 1 << 30, 8, 2, 0, 0, 0))
        + data[33:],
        "which is no PNG": data[:8]
        + plain.png_chunk(b"IHDR", struct.pack(">IIBBBBB", 5, 0, 8, 2, 0, 0, 0))
        + data[33:],
    }
    assert size > 20
    for message, broken in cases.items():
        with pytest.raises(ValueError, match=message):
            codecs.decode_png(broken)
    for bad in (np.zeros((3, 3)), np.zeros((3, 3, 5), np.uint8), np.zeros((0, 3), np.uint8), np.zeros(3, np.uint8)):
        with pytest.raises(ValueError, match="image has"):
            codecs.encode_png(bad)


# ------------------------------------------------------------------------------------------- Radiance


def radiance_file(body, rows, columns, *, lines=(), resolution=None):
    head = b"#?RADIANCE\n# made by hand\nFORMAT=32-bit_rle_rgbe\n" + b"".join(line + b"\n" for line in lines)
    return head + b"\n" + (resolution or b"-Y %d +X %d" % (rows, columns)) + b"\n" + body


def rgbe(shape, rng):
    """Random normalised pixels with runs, dark ones among them."""
    pixels = rng.integers(0, 256, (*shape, 4)).astype(np.uint8)
    pixels[..., 0] |= 128
    pixels[..., 3] = rng.integers(100, 140, shape)
    pixels[:, 3:8] = pixels[:, 3:4]
    pixels[rng.random(shape) < 0.1] = 0
    return pixels


@pytest.mark.parametrize("columns", [1, 7, 8, 40, 300])
def test_hdr_of_plain_writers(columns, rng):
    """Flat pixels, old and new run lengths, and a file that changes over half-way."""
    pixels = rgbe((4, columns), rng)
    pixels[2:, : columns // 2] = pixels[2, 0]
    bodies = [pixels.tobytes(), plain.hdr_old_runs(pixels.reshape(-1, 4))]
    if columns >= 8:
        bodies += [plain.hdr_new_scanlines(pixels)]
        bodies += [plain.hdr_new_scanlines(pixels[:2]) + plain.hdr_old_runs(pixels[2:].reshape(-1, 4))]
    for body in bodies:
        image = codecs.decode_hdr(radiance_file(body, 4, columns))
        assert image.dtype == np.float32
        assert np.array_equal(image, plain.rgbe_to_float(pixels))


def test_hdr_long_old_runs():
    """Counts above 255 take several run pixels, each 256 times the one before."""
    pixels = np.repeat(np.array([[200, 3, 7, 129], [128, 0, 0, 128]], np.uint8), [70000, 530], axis=0)
    image = codecs.decode_hdr(radiance_file(plain.hdr_old_runs(pixels), 1, 70530))
    assert np.array_equal(image[0], plain.rgbe_to_float(pixels))


def test_hdr_orientations(rng):
    """The resolution line names the axes in the order of the file: -Y +X is rows from the top, from left to right."""
    upright = rng.integers(128, 256, (3, 9, 4)).astype(np.uint8)
    stored = {
        b"-Y 3 +X 9": upright,
        b"-Y 3 -X 9": upright[:, ::-1],
        b"+Y 3 +X 9": upright[::-1],
        b"+Y 3 -X 9": upright[::-1, ::-1],
        b"+X 9 -Y 3": upright.transpose(1, 0, 2),
        b"+X 9 +Y 3": upright[::-1].transpose(1, 0, 2),
        b"-X 9 -Y 3": upright[:, ::-1].transpose(1, 0, 2),
        b"-X 9 +Y 3": upright[::-1, ::-1].transpose(1, 0, 2),
    }
    for line, pixels in stored.items():
        image = codecs.decode_hdr(radiance_file(np.ascontiguousarray(pixels).tobytes(), 0, 0, resolution=line))
        assert np.array_equal(image, plain.rgbe_to_float(upright)), line


def test_hdr_exposure_and_xyz():
    pixels = np.array([[[128, 64, 32, 129], [200, 100, 50, 128]]], np.uint8)
    value = plain.rgbe_to_float(pixels)
    lines = (b"EXPOSURE=2", b"EXPOSURE= 0.25", b"COLORCORR=1 2 4")
    image = codecs.decode_hdr(radiance_file(pixels.tobytes(), 1, 2, lines=lines))
    np.testing.assert_allclose(image, value / 0.5 / np.array([1, 2, 4]), rtol=1e-7)
    # Equal-energy white in XYZ is white, and Y is the luminance of Radiance's primaries.
    white = np.array([[[200, 200, 200, 128]]], np.uint8).tobytes()
    data = radiance_file(white, 1, 1).replace(b"rle_rgbe", b"rle_xyze")
    np.testing.assert_allclose(codecs.decode_hdr(data)[0, 0], 200 / 256, rtol=2e-4)
    luminous = np.array([[[100, 220, 30, 128]]], np.uint8).tobytes()
    rgb = codecs.decode_hdr(radiance_file(luminous, 1, 1).replace(b"rle_rgbe", b"rle_xyze"))[0, 0]
    np.testing.assert_allclose(rgb @ [0.2651, 0.6701, 0.0648], 220 / 256, rtol=1e-3)


@pytest.mark.parametrize("shape", [(5, 40), (3, 7), (2, 1), (1, 300)])
def test_hdr_round_trip(shape, rng):
    image = np.exp(rng.normal(0, 4, (*shape, 3)))
    image[:, shape[1] // 3 : shape[1] // 2] = 0.75
    image[rng.random(shape) < 0.2] = 0
    back = codecs.decode_hdr(codecs.encode_hdr(image))
    largest = image.max(axis=-1, keepdims=True)
    assert np.all(np.abs(back - image) <= largest / 255)
    assert np.array_equal(codecs.decode_hdr(codecs.encode_hdr(back)), back)  # what is representable stays
    grey = codecs.decode_hdr(codecs.encode_hdr(back[..., 0]))
    assert np.array_equal(grey, np.repeat(back[..., :1], 3, axis=-1)) or np.all(
        np.abs(grey - back[..., :1]) <= back[..., :1] / 255
    )


def test_hdr_extremes():
    image = np.array([[[1e38, 0, 0], [3e38, 1, 1], [1e-37, 0, 0], [1e-45, 0, 0], [-1, 2, 3], [255.9, 255.9, 1]]])
    back = codecs.decode_hdr(codecs.encode_hdr(image))
    assert np.isfinite(back).all()
    np.testing.assert_allclose(back[0, :, 0], [1e38, 1.69e38, 1e-37, 0, 0, 256], rtol=1 / 250)
    np.testing.assert_allclose(back[0, 4], [0, 2, 3], rtol=1 / 250)


def test_hdr_errors(rng):
    good = codecs.encode_hdr(rng.random((4, 20, 3)))
    start = good.index(b"+X 20\n") + 6
    cases = {
        "starts with": b"#Radiance" + good,
        "header does not end": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe",
        "FORMAT is": good.replace(b"32-bit_rle_rgbe", b"16-bit"),
        "EXPOSURE is": good.replace(b"\n\n", b"\nEXPOSURE=0\n\n"),
        "COLORCORR is": good.replace(b"\n\n", b"\nCOLORCORR=1 2\n\n"),
        "resolution line": good.replace(b"-Y 4 +X 20", b"-Y 4 +Y 20"),
        "claims 0 x 20": good.replace(b"-Y 4", b"-Y 0"),
        "claims 99999999": good.replace(b"-Y 4", b"-Y 99999999"),
        "ends too early in scanline 3": good[:-3],
        "bad run length in scanline 0": good[: start + 4] + b"\0" + good[start + 5 :],
        "0 of 20 pixels are left": good[:start].replace(b"-Y 4", b"-Y 1"),
        "beyond the picture": good[:start].replace(b"-Y 4", b"-Y 1") + bytes((9, 9, 9, 9, 1, 1, 1, 100)),
    }
    for message, broken in cases.items():
        with pytest.raises(ValueError, match=message):
            codecs.decode_hdr(broken)
    for bad in (np.full((2, 2, 3), np.nan), np.zeros((2, 2, 4)), np.zeros((0, 2, 3))):
        with pytest.raises(ValueError, match="image h"):
            codecs.encode_hdr(bad)


# ------------------------------------------------------------------------------------------- TIFF

TYPES = ["u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f2", "f4", "f8"]
LAYOUTS = [
    {},
    {"rows": 3},
    {"rows": 100},
    {"tile": (16, 16)},
    {"tile": (16, 32), "planar": True},
    {"rows": 4, "planar": True},
]


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_tiff_of_a_plain_writer(layout, order, big, rng):
    for dtype in TYPES:
        for shape in ((19, 23, 1), (7, 5, 3), (1, 1, 1)):
            image = picture(dtype, shape, rng)
            for predictor in (1, 2, 3) if image.dtype.kind == "f" else (1, 2):
                data = plain.tiff_file(
                    image, order=order, big=big, deflate=predictor > 1, predictor=predictor, **layout
                )
                back = codecs.decode_tiff(data)
                assert back.dtype == image.dtype
                assert np.array_equal(back.reshape(shape), image), (dtype, shape, predictor)


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate", "tiff_deflate", "packbits", "zstd"])
def test_tiff_of_pillow(compression, rng):
    """libtiff as the writer, with its predictors."""
    for dtype in ("u1", "u2", "f4"):
        image = picture(dtype, (37, 53, 1), rng)[..., 0]
        for predictor in (1, 2, 3):
            if predictor > 1 and (compression in (None, "packbits") or (predictor == 3) != (dtype == "f4")):
                continue
            out = io.BytesIO()
            Image.fromarray(image).save(
                out, "TIFF", compression=compression, tiffinfo={317: predictor} if predictor > 1 else {}
            )
            assert np.array_equal(codecs.decode_tiff(out.getvalue()), image)


@pytest.mark.parametrize("shape", [(9, 14), (9, 14, 1), (3, 5, 2), (40, 11, 3), (1, 1, 4)])
def test_tiff_round_trip(shape, rng):
    image = rng.normal(size=shape).astype(np.float32)
    image.flat[0] = np.nan
    image.flat[-1] = -np.inf
    data = codecs.encode_tiff(image, spacing=(2, 0.5), nodata=-9999)
    assert np.array_equal(codecs.decode_tiff(data), image[..., 0] if shape[2:] == (1,) else image, equal_nan=True)
    assert codecs.tiff_georeference(data) == ((2.0, 0.5), -9999.0)
    assert codecs.tiff_georeference(codecs.encode_tiff(image)) == (None, None)
    if len(shape) == 2:
        assert np.array_equal(np.asarray(Image.open(io.BytesIO(data))), image, equal_nan=True)


def test_tiff_many_strips(rng):
    image = rng.normal(size=(300, 700, 1)).astype(np.float32)
    assert np.array_equal(codecs.decode_tiff(codecs.encode_tiff(image)), image[..., 0])


def test_tiff_white_is_zero(rng):
    image = picture("u2", (4, 5, 1), rng)
    data = plain.tiff_file(image).replace(struct.pack("<HHIH", 262, 3, 1, 1), struct.pack("<HHIH", 262, 3, 1, 0))
    assert np.array_equal(codecs.decode_tiff(data), 65535 - image[..., 0])


def test_tiff_georeference_of_a_geotiff(rng):
    extra = [(33550, "d", [30.0, 25.0, 0.0]), (42113, "s", b"-3.4028234663852886e+38\0")]
    data = plain.tiff_file(picture("f4", (3, 3, 1), rng), order=">", extra=extra)
    spacing, nodata = codecs.tiff_georeference(data)
    assert spacing == (30.0, 25.0)
    assert np.float32(nodata) == np.finfo(np.float32).min
    odd = plain.tiff_file(picture("f4", (3, 3, 1), rng), extra=[(42113, "s", b"none\0")])
    assert codecs.tiff_georeference(odd) == (None, None)


def test_tiff_errors(rng):
    image = picture("f4", (9, 8, 1), rng)
    good = plain.tiff_file(image, rows=4, deflate=True)
    plain_file = plain.tiff_file(image, rows=4)

    def entry(tag, kind, value):
        return struct.pack("<HHI" + kind, tag, {"H": 3, "I": 4}[kind], 1, value)

    cases = {
        "no TIFF signature": b"II\x2a\x01" + bytes(20),
        "ends within its directory": good[:8],
        "lie beyond the end": good[:-5],
        "cannot hold a picture of 8 x 9 x 1": plain_file.replace(entry(278, "I", 4), entry(278, "I", 2)),
        "ImageWidth is missing": good.replace(entry(256, "I", 8), entry(1256, "I", 8)),
        "cannot hold": good.replace(entry(256, "I", 8), entry(256, "I", 1 << 31)),
        "8 x 9 pixels of 0 channels": good.replace(entry(277, "H", 1), entry(277, "H", 0)),
        "bits per sample": good.replace(entry(258, "H", 32), entry(258, "H", 12)),
        "photometric": good.replace(entry(262, "H", 1), entry(262, "H", 3)),
        "compression 7": good.replace(entry(259, "H", 8), entry(259, "H", 7)),
        "predictor 9": good.replace(entry(317, "H", 1), entry(317, "H", 9)),
        "cannot be inflated": good.replace(good[8:20], b"x" * 12),
        "holds 128 of 288": plain_file.replace(entry(278, "I", 4), entry(278, "I", 9)),
        "say where the pixels are": plain_file.replace(entry(278, "I", 4), entry(278, "I", 0)),
    }
    for message, broken in cases.items():
        with pytest.raises(ValueError, match=message):
            codecs.decode_tiff(broken)
    lzw = good.replace(entry(259, "H", 8), entry(259, "H", 5))
    with pytest.raises(ValueError, match="TIFF: strip or tile 0"):
        codecs.decode_tiff(lzw)
    for bad in (np.zeros((2, 2), complex), np.zeros((2, 2, 5)), np.zeros((0, 2))):
        with pytest.raises(ValueError, match="image has"):
            codecs.encode_tiff(bad)


# ------------------------------------------------------------------------------------------- EXR


@pytest.mark.parametrize("shape", [(6, 9), (6, 9, 1), (6, 9, 3), (5, 4, 4)])
def test_exr_round_trip(shape, rng):
    image = rng.normal(size=shape).astype(np.float32)
    back = codecs.decode_exr(codecs.encode_exr(image))
    expected = image[..., 0] if shape[2:] == (1,) else image[..., :3] if len(shape) == 3 else image
    assert back.dtype == np.float32
    assert np.array_equal(back, expected)
    half = codecs.decode_exr(codecs.encode_exr(image * 1e5, half=True))
    limited = np.clip(expected.astype(np.float64) * 1e5, -65504, 65504)
    np.testing.assert_allclose(half, limited, rtol=2**-11)


def exr(channels, **header):
    import OpenEXR

    out = io.BytesIO()
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    OpenEXR.File(header, {k: np.ascontiguousarray(v, np.float32) for k, v in channels.items()}).write(out)
    return out.getvalue()


def test_exr_channel_names(rng):
    a, b, c, d = rng.normal(size=(4, 5, 6)).astype(np.float32)
    assert np.array_equal(codecs.decode_exr(exr({"Y": a})), a)
    assert np.array_equal(codecs.decode_exr(exr({"height": a})), a)
    assert np.array_equal(codecs.decode_exr(exr({"Y": a, "A": b})), a)
    assert np.array_equal(codecs.decode_exr(exr({"A": d, "B": c, "G": b, "R": a})), np.stack([a, b, c], -1))
    assert np.array_equal(codecs.decode_exr(exr({"X": a, "Y": b, "Z": c})), np.stack([a, b, c], -1))
    assert np.array_equal(codecs.decode_exr(exr({"N.X": a, "N.Y": b, "N.Z": c})), np.stack([a, b, c], -1))
    for channels in ({"p": a, "q": b}, {"m.R": a, "m.G": b, "m.B": c, "n.R": a, "n.G": b, "n.B": c}):
        with pytest.raises(ValueError, match="holds the channels"):
            codecs.decode_exr(exr(channels))
    with pytest.raises(ValueError, match="luminance-chroma"):
        codecs.decode_exr(exr({"Y": a, "RY": b, "BY": c}))


def test_exr_windows(rng):
    """The display window is the picture; the data window may be a part of it or reach beyond it."""
    data = rng.normal(size=(4, 6)).astype(np.float32)

    def windows(data_window, display_window):
        boxes = [(np.array(w[:2], np.int32), np.array(w[2:], np.int32)) for w in (data_window, display_window)]
        return codecs.decode_exr(exr({"Y": data}, dataWindow=boxes[0], displayWindow=boxes[1]))

    inside = windows((2, 1, 7, 4), (0, 0, 9, 5))
    assert inside.shape == (6, 10)
    assert np.array_equal(inside[1:5, 2:8], data)
    assert np.count_nonzero(inside) == np.count_nonzero(data)
    assert np.array_equal(windows((-2, -1, 3, 2), (0, 0, 2, 1)), data[1:3, 2:5])
    assert not windows((20, 20, 25, 23), (0, 0, 2, 1)).any()


def test_exr_without_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    for call in (lambda: codecs.decode_exr(b""), lambda: codecs.encode_exr(np.zeros((2, 2)))):
        with pytest.raises(ValueError, match=r"pip install 'shapeenh\[exr\]'"):
            call()


def test_exr_of_an_old_package(monkeypatch):
    import OpenEXR

    monkeypatch.setattr(OpenEXR, "__version__", "3.3.2")
    with pytest.raises(ValueError, match=r"3\.5 or newer.*installed is 3\.3\.2"):
        codecs.decode_exr(b"")


def test_exr_errors(capfd):
    good = codecs.encode_exr(np.zeros((40, 30, 3)))
    for broken in (b"", b"no picture", good[:200], good[:-40]):
        with pytest.raises(ValueError, match=r"^EXR: "):
            codecs.decode_exr(broken)
    with pytest.raises(ValueError, match="image is"):
        codecs.encode_exr(np.zeros((2, 2, 2)))


# ------------------------------------------------------------------------------------------- by suffix


def test_images_by_suffix(rng):
    linear = rng.random((12, 9, 3)).astype(np.float32)
    for suffix, tolerance in ((".tif", 0), (".TIFF", 0), (".exr", 0), (".hdr", 1 / 255)):
        assert np.abs(codecs.decode_image(codecs.encode_image(linear, suffix), suffix) - linear).max() <= tolerance
    for bits, dtype in ((8, np.uint8), (16, np.uint16)):
        stored = codecs.decode_image(codecs.encode_image(linear, ".png", bits=bits), ".PNG")
        assert stored.dtype == dtype
        assert np.abs(codecs.srgb_decode(stored / (2**bits - 1)) - linear).max() < 3 / 2**bits
    flat = np.full((16, 16, 3), 0.25, np.float32)
    jpeg = codecs.decode_image(codecs.encode_image(flat, ".jpg"), ".jpeg")
    assert np.abs(jpeg.astype(int) - round(255 * float(codecs.srgb_encode(0.25)))).max() <= 1


def test_alpha_is_not_gamma_encoded():
    image = np.full((2, 2, 4), 0.5)
    stored = codecs.decode_png(codecs.encode_image(image, ".png", bits=16))
    assert np.all(stored[..., 3] == 32768)
    assert np.all(stored[..., 0] == round(65535 * float(codecs.srgb_encode(0.5))))


def test_integers_are_written_as_they_are(rng):
    for dtype in (np.uint8, np.uint16):
        image = rng.integers(0, 256, (3, 4, 3)).astype(dtype)
        assert np.array_equal(codecs.decode_image(codecs.encode_image(image, ".png"), ".png"), image)


def test_clipping_and_nan():
    stored = codecs.decode_png(codecs.encode_image(np.array([[-1.0, 2.0, np.inf]]), ".png"))
    assert stored.tolist() == [[0, 255, 255]]
    with pytest.raises(ValueError, match="1 NaN"):
        codecs.encode_image(np.array([[np.nan, 0.0]]), ".png")


def test_srgb_is_the_standard_curve():
    assert np.allclose(codecs.srgb_encode(np.array([0.0, 0.0031308, 0.214041, 1.0])), [0, 0.04045, 0.5, 1], atol=2e-5)
    x = np.linspace(-0.2, 1.5, 1001)
    np.testing.assert_allclose(codecs.srgb_decode(codecs.srgb_encode(x)), x, atol=1e-7)


def test_suffix_errors(rng):
    with pytest.raises(ValueError, match="empty"):
        codecs.decode_image(b"", ".png")
    with pytest.raises(ValueError, match="no image that imageio can read"):
        codecs.decode_image(b"text", ".jpg")
    for suffix, bits, message in ((".gif", 8, "suffix is"), (".png", 12, "bits is 12"), (".jpg", 16, "bits is 16")):
        with pytest.raises(ValueError, match=message):
            codecs.encode_image(np.zeros((2, 2, 3)), suffix, bits=bits)
    with pytest.raises(ValueError, match="accepted for JPEG"):
        codecs.encode_image(np.zeros((2, 2, 4)), ".jpg")


def test_other_formats_by_imageio(rng):
    image = picture("u1", (6, 7, 3), rng)
    assert np.array_equal(codecs.decode_image(iio.imwrite("<bytes>", image, extension=".bmp"), ".bmp"), image)


# ------------------------------------------------------------------------------------------- corrupt files

_RNG = np.random.default_rng(7)
_NOISE = picture("f4", (12, 11, 3), _RNG)
VALID = {
    ".png": [
        plain.png_file(picture("u2", (9, 8, 3), _RNG), filters=(4, 3, 2, 1, 0)),
        plain.png_file(picture("u1", (9, 8, 4), _RNG), filters=(4, 1), interlaced=True),
    ],
    ".hdr": [
        codecs.encode_hdr(np.abs(_NOISE)),
        radiance_file(plain.hdr_old_runs(rgbe((3, 5), _RNG).reshape(-1, 4)), 3, 5),
    ],
    ".tif": [
        plain.tiff_file(_NOISE, rows=3, deflate=True, predictor=3),
        plain.tiff_file(_NOISE, order=">", tile=(16, 16), planar=True, big=True),
        codecs.encode_tiff(_NOISE, spacing=(1, 1), nodata=0),
    ],
}


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.data())
@pytest.mark.parametrize("suffix", list(VALID))
def test_corrupt_files_are_value_errors_of_one_line(suffix, data):
    """Whatever is changed, cut off or left out: an image, or one plain line that names the format."""
    raw = bytearray(data.draw(st.sampled_from(VALID[suffix])))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(raw) - 1))
        kind = data.draw(st.sampled_from(["flip", "cut", "drop", "fill"]))
        if kind == "flip":
            raw[at] = data.draw(st.integers(0, 255))
        elif kind == "cut":
            raw = raw[: max(at, 4)]
        elif kind == "drop":
            del raw[at : at + data.draw(st.integers(1, 9))]
        else:
            raw[at : at + 4] = data.draw(st.sampled_from([b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff"]))
        raw = raw or bytearray(b"x")
    if suffix == ".png":  # checksums put right, so that the pixels are reached
        raw = bytearray(_with_checksums(bytes(raw)))
    for read in (lambda: codecs.decode_image(bytes(raw), suffix), lambda: codecs.tiff_georeference(bytes(raw))):
        try:
            result, message = read(), None
        except ValueError as error:
            result, message = None, str(error)
        if message is None:
            assert isinstance(result, tuple) or result.ndim in (2, 3)
        else:
            assert message.startswith(("PNG: ", "HDR: ", "TIFF: "))
            assert "\n" not in message
            assert len(message) < 300


def _with_checksums(data):
    out, at = data[:8], 8
    while at + 12 <= len(data):
        length = struct.unpack_from(">I", data, at)[0]
        if at + 12 + length > len(data):
            break
        out += plain.png_chunk(data[at + 4 : at + 8], data[at + 8 : at + 8 + length])
        at += 12 + length
    return out + data[at:]
