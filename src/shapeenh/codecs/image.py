"""Any image by its suffix, and the sRGB curve (IEC 61966-2-1)."""

from __future__ import annotations

import io

import numpy as np

from shapeenh.codecs.exr import decode_exr, encode_exr
from shapeenh.codecs.png import decode_png, encode_png
from shapeenh.codecs.radiance import decode_hdr, encode_hdr
from shapeenh.codecs.tiff import decode_tiff, encode_tiff

DECODERS = {
    ".hdr": decode_hdr,
    ".pic": decode_hdr,
    ".rgbe": decode_hdr,
    ".png": decode_png,
    ".tif": decode_tiff,
    ".tiff": decode_tiff,
    ".exr": decode_exr,
}
FLOAT_ENCODERS = {".hdr": encode_hdr, ".tif": encode_tiff, ".tiff": encode_tiff, ".exr": encode_exr}


def decode_image(data: bytes, suffix: str) -> np.ndarray:
    """An image file in its own numbers.

    Args:
        data: the file.
        suffix: of its name, with the dot, any case. PNG, TIFF, HDR and EXR are decoded by the functions of those names,
            others (JPEG, BMP, ...) by imageio, as 8 bits.

    Returns: [h, w] or [h, w, C], uint8, uint16, or floats as in the file. Errors: ValueError.
    """
    suffix = suffix.lower()
    if not data:
        raise ValueError("the file is empty")
    if suffix in DECODERS:
        return DECODERS[suffix](data)
    import imageio.v3 as iio

    try:
        return np.asarray(iio.imread(io.BytesIO(data), extension=suffix, plugin="pillow"))
    except MemoryError:
        raise
    except Exception as error:  # Pillow's parsers let several kinds through
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"no image that imageio can read ({text})") from None


def encode_image(image, suffix: str, *, bits: int = 8) -> bytes:
    """An image file.

    Args:
        image: [h, w], [h, w, 3] or [h, w, 4]. For `.png`, `.jpg`, `.jpeg` linear RGB floats are clipped to [0, 1] and
            encoded as sRGB (alpha is only clipped), uint8 and uint16 written as they are; for `.exr`, `.hdr`, `.tif`,
            `.tiff` linear floats, untouched.
        suffix: with the dot, any case.
        bits: 8 or 16, for floats to PNG.

    Returns: the file. Errors: ValueError for another suffix, shape, dtype, `bits`, or NaN in an integer format.
    """
    image, suffix = np.asarray(image), suffix.lower()
    if suffix in FLOAT_ENCODERS:
        return FLOAT_ENCODERS[suffix](image)
    if suffix not in (".png", ".jpg", ".jpeg"):
        raise ValueError(f"suffix is {suffix!r}; accepted are .png, .jpg, {', '.join(FLOAT_ENCODERS)}")
    if bits not in (8, 16) or (bits == 16 and suffix != ".png"):
        raise ValueError(f"bits is {bits!r}; accepted are 8, and 16 for PNG")
    if image.dtype.kind == "f":
        image = _quantize(image, bits)
    if suffix == ".png":
        return encode_png(image)
    return _jpeg(image)


def _quantize(image, bits: int):
    """Linear floats to sRGB integers, rounded to nearest; alpha stays linear."""
    if np.isnan(image).any():
        raise ValueError(f"image holds {np.isnan(image).sum()} NaN value(s); accepted are numbers")
    image = np.clip(image.astype(np.float64), 0, 1)
    colors = 3 if image.ndim == 3 and image.shape[-1] == 4 else None
    if image.ndim == 3 and image.shape[-1] == 2:
        colors = 1
    encoded = srgb_encode(image)
    if colors is not None:
        encoded[..., colors:] = image[..., colors:]
    return np.rint(encoded * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


def _jpeg(image) -> bytes:
    if (
        image.dtype != np.uint8
        or image.ndim not in (2, 3)
        or (image.ndim == 3 and image.shape[2] != 3)
        or image.size == 0
    ):
        raise ValueError(f"image is {image.dtype} {image.shape}; accepted for JPEG are 8 bits, [h, w] or [h, w, 3]")
    import imageio.v3 as iio

    return iio.imwrite("<bytes>", image, extension=".jpg", plugin="pillow", quality=95)


def srgb_decode(encoded):
    """sRGB values in [0, 1] to linear light; a negative value is taken as its own mirror image."""
    x = np.abs(encoded)
    return np.copysign(np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4), encoded)


def srgb_encode(linear):
    """Linear light in [0, 1] to sRGB values; the inverse of `srgb_decode`."""
    x = np.abs(linear)
    return np.copysign(np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055), linear)
