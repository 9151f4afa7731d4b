"""The size that an image file declares is told, and no memory taken for it."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from lce_rig.core.image_codec import decode_pixels


def _png(width: int, height: int, bits: int = 8, colour: int = 0) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")


def _encoded(suffix: str) -> bytearray:
    return bytearray(cv2.imencode(suffix, np.zeros((16, 16), np.uint8))[1].tobytes())


def _jpeg(width: int, height: int) -> bytes:
    data = _encoded(".jpg")
    place = data.index(b"\xff\xc0") + 5
    data[place : place + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def _bmp(width: int, height: int) -> bytes:
    data = _encoded(".bmp")
    data[18:26] = struct.pack("<ii", width, -height)
    return bytes(data)


def _tiff(width: int, height: int) -> bytes:
    data = _encoded(".tiff")
    start = struct.unpack_from("<I", data, 4)[0]
    for k in range(struct.unpack_from("<H", data, start)[0]):
        tag = struct.unpack_from("<H", data, start + 2 + 12 * k)[0]
        if tag in (256, 257):
            struct.pack_into("<HHII", data, start + 2 + 12 * k, tag, 4, 1, width if tag == 256 else height)
    return bytes(data)


def _webp(width: int, height: int) -> bytes:
    sizes = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"RIFF" + bytes(4) + b"WEBPVP8X" + bytes(8) + sizes


ABSURD = {
    "png": _png(30_000, 50_000),
    "jpeg": _jpeg(30_000, 50_000),
    "bmp": _bmp(30_000, 50_000),
    "tiff": _tiff(30_000, 50_000),
    "pgm": b"P5\n# a comment\n30000 50000\n255\n" + bytes(50),
    "webp": _webp(30_000, 50_000),
    "gif": b"GIF89a" + struct.pack("<HH", 30_000, 50_000) + bytes(9),
}


@pytest.mark.parametrize("kind", ABSURD)
def test_an_image_of_absurd_size_is_refused_with_its_size(kind):
    with pytest.raises(ValueError, match="declares 30000 x 50000 pixels, at most 67108864"):
        decode_pixels(ABSURD[kind], cv2.IMREAD_UNCHANGED)


def test_many_bytes_a_pixel_count_too():
    with pytest.raises(ValueError, match="8000 x 8000 pixels of 8 bytes"):
        decode_pixels(_png(8000, 8000, 16, 6), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize(
    "data", [b"RIFF0000WAVE", b"\x00" * 50, b"\x89PNG\r\n\x1a\nIEND", b"P5\nx", b"II*\0\xff"]
)
def test_a_header_that_says_nothing_is_refused(data):
    with pytest.raises(ValueError, match="damaged"):
        decode_pixels(data, cv2.IMREAD_UNCHANGED)


def test_opencv_itself_is_limited_where_this_package_was_imported_first():
    import os

    import lce_rig  # noqa: F401
    from lce_rig.core.limits import MAX_PIXELS

    assert int(os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"]) == MAX_PIXELS
