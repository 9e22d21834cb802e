"""Image files as bytes: pure functions from bytes to NumPy arrays and back. Nothing here touches a file.

Arrays are `[h, w]` or `[h, w, C]`, row 0 at the top, in the numbers of the file: nothing is scaled, and only
`encode_image` applies the sRGB curve. What cannot be decoded is a ValueError of one line that says why.
Imports nothing of ours.
"""

from shapeenh.codecs.exr import decode_exr, encode_exr
from shapeenh.codecs.image import decode_image, encode_image, srgb_decode, srgb_encode
from shapeenh.codecs.png import decode_png, encode_png
from shapeenh.codecs.radiance import decode_hdr, encode_hdr
from shapeenh.codecs.tiff import decode_tiff, encode_tiff, tiff_georeference

__all__ = [
    "decode_exr",
    "decode_hdr",
    "decode_image",
    "decode_png",
    "decode_tiff",
    "encode_exr",
    "encode_hdr",
    "encode_image",
    "encode_png",
    "encode_tiff",
    "srgb_decode",
    "srgb_encode",
    "tiff_georeference",
]
