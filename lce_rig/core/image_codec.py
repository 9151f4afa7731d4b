"""Image files held in memory: their declared size is read and limited before OpenCV decodes them.

OpenCV takes memory for what a header declares. Its own limit comes from the environment when it is first
loaded, which may have been before this package; what formats it decodes depends on how it was built.
"""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.limits import MAX_FILE_BYTES, MAX_PIXELS

_TIFF_TAGS = {256: "width", 257: "height", 258: "bits", 277: "samples", 322: "tile_width", 323: "tile_height"}
_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}


class _Declared(NamedTuple):
    width_px: int
    height_px: int
    bytes_per_px: int = 3


def decode_pixels(data: bytes, flags: int) -> NDArray[Any]:
    """Decode a PNG, JPEG, BMP, TIFF, PNM, WebP or GIF image.

    Args:
        data: the file's bytes.
        flags: OpenCV's, of `imdecode`.

    Returns:
        (H, W) or (H, W, C), as OpenCV decodes it.

    Raises:
        ValueError: what is wrong with it, in words that follow the file's name.
    """
    import cv2

    if not data:
        raise ValueError("it is empty")
    # Older OpenCV fills what is missing from a torn JPEG or PNG with grey and says nothing.
    if data.startswith(b"\x89PNG") and b"IEND" not in data[-64:]:
        raise ValueError("it is a truncated PNG image")
    if data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-1024:]:
        raise ValueError("it is a truncated JPEG image")
    _check_declared(data)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError("it is damaged, or no image this program reads")
    return np.asarray(pixels)


def _check_declared(data: bytes) -> None:
    reader = next((read for magic, read in _READERS.items() if data.startswith(magic)), None)
    if reader is None or (reader is _webp and data[8:12] != b"WEBP"):
        raise ValueError("it is damaged, or no image this program reads")
    try:
        declared = reader(data)
    except (struct.error, IndexError, KeyError, OverflowError, ValueError):
        raise ValueError("it is damaged: its header declares no size") from None
    width, height, depth = declared
    if width < 1 or height < 1:
        raise ValueError(f"its header declares {width} x {height} pixels")
    if width * height > MAX_PIXELS:
        raise ValueError(f"it declares {width} x {height} pixels, at most {MAX_PIXELS} are read")
    if width * height * depth > MAX_FILE_BYTES:
        size = f"{width} x {height} pixels of {depth} bytes"
        raise ValueError(f"it declares {size}, at most {MAX_FILE_BYTES / 1e6:.0f} MB are read")


def _png(data: bytes) -> _Declared:
    # OpenCV takes memory for what a chunk declares, too.
    position, kinds = 8, list[bytes]()
    while position < len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        kinds.append(kind)
        position += 12 + length
        if kind == b"IEND":
            break
    if position > len(data) or kinds[0] != b"IHDR" or kinds.count(b"IHDR") > 1 or b"acTL" in kinds:
        raise ValueError
    width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
    samples = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}[colour]
    return _Declared(width, height, samples * (2 if bits == 16 else 1))


def _jpeg(data: bytes) -> _Declared:
    position = 2
    while True:
        position = data.index(b"\xff", position)
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width, samples = struct.unpack_from(">HHB", data, position + 5)
            return _Declared(width, height, max(samples, 1))
        elif marker == 0 or marker == 1 or 0xD0 <= marker <= 0xD8:
            position += 2
        elif marker in (0xD9, 0xDA):
            raise ValueError
        else:
            position += 2 + max(2, struct.unpack_from(">H", data, position + 2)[0])


def _bmp(data: bytes) -> _Declared:
    (header_size,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header_size == 12 else "<ii", data, 18)
    return _Declared(abs(width), abs(height))


def _gif(data: bytes) -> _Declared:
    width, height = struct.unpack_from("<HH", data, 6)
    return _Declared(width, height, 4)


def _pnm(data: bytes) -> _Declared:
    figures: list[int] = []
    lines = data[2:4096].split(b"\n")
    n_wanted = 2 if data[1:2] in b"14" else 3
    for line in lines:
        figures += [int(word) for word in line.split(b"#")[0].split()[: n_wanted - len(figures)]]
        if len(figures) == n_wanted:
            break
    deep = 2 if n_wanted == 3 and figures[2] > 255 else 1
    return _Declared(figures[0], figures[1], (3 if data[1:2] in b"36" else 1) * deep)


def _webp(data: bytes) -> _Declared:
    kind = data[12:16]
    if kind == b"VP8X":
        width = 1 + int.from_bytes(data[24:27], "little")
        return _Declared(width, 1 + int.from_bytes(data[27:30], "little"), 4)
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return _Declared(1 + (bits & 0x3FFF), 1 + ((bits >> 14) & 0x3FFF), 4)
    width, height = struct.unpack_from("<HH", data, 26)
    return _Declared(width & 0x3FFF, height & 0x3FFF)


def _tiff(data: bytes) -> _Declared:
    order = "<" if data[:2] == b"II" else ">"
    is_big = data[2:4] in (b"+\0", b"\0+")
    (start,) = struct.unpack_from(order + ("Q" if is_big else "I"), data, 8 if is_big else 4)
    (n_tags,) = struct.unpack_from(order + ("Q" if is_big else "H"), data, start)
    head, size = ("HHQ", 20) if is_big else ("HHI", 12)
    first = start + (8 if is_big else 2)
    found = {"bits": 8, "samples": 1, "tile_width": 0, "tile_height": 0}
    for position in range(first, first + min(n_tags, 1000) * size, size):
        tag, kind, count = struct.unpack_from(order + head, data, position)
        if tag in _TIFF_TAGS and kind in _TIFF_TYPES:
            form = order + _TIFF_TYPES[kind]
            place = position + struct.calcsize("=" + head)
            if struct.calcsize(form) * count > (8 if is_big else 4):
                (place,) = struct.unpack_from(order + ("Q" if is_big else "I"), data, place)
            found[_TIFF_TAGS[tag]] = struct.unpack_from(form, data, place)[0]
    depth = max(1, found["bits"] // 8) * max(1, found["samples"])
    if found["tile_width"] * found["tile_height"] > MAX_PIXELS:
        return _Declared(found["tile_width"], found["tile_height"], depth)
    return _Declared(found["width"], found["height"], depth)


_READERS: dict[bytes, Callable[[bytes], _Declared]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8": _jpeg,
    b"BM": _bmp,
    b"GIF8": _gif,
    b"RIFF": _webp,
    **{
        form + mark: _tiff
        for form, mark in ((b"II", b"*\0"), (b"MM", b"\0*"), (b"II", b"+\0"), (b"MM", b"\0+"))
    },
    **{b"P" + str(kind).encode(): _pnm for kind in range(1, 7)},
}
"""By the first bytes of a file; other files are not passed to OpenCV."""
