"""Images in a stream of bytes, one behind the other: Y4M, PNM (PGM and PPM), JPEG, or raw.

References:
    https://wiki.multimedia.cx/index.php/YUV4MPEG2
    https://netpbm.sourceforge.net/doc/pgm.html, https://netpbm.sourceforge.net/doc/ppm.html
    ITU-T T.81, annex B (the segments of a JPEG)
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np

from lce_rig.core.limits import MAX_PIXELS
from lce_rig.devices.pixel_formats import FORMATS, PixelDecoder, Pixels
from lce_rig.io.folder.image_file import decode_image

_MAX_HEADER = 4096
_MAX_JPEG = 1 << 26
_PNM_HEADER = re.compile(rb"(P[56])\s+(?:#[^\n]*\n\s*)*(\d+)\s+(?:#[^\n]*\n\s*)*(\d+)\s+(\d+)\s")
_420 = ("420", "420jpeg", "420mpeg2", "420paldv")  # they differ in where a chroma sample sits
_SOI, _EOI, _SOS = b"\xff\xd8", b"\xff\xd9", 0xDA


class ImageStream(ABC):
    """Bytes in as they come, images out.

    Attributes:
        n_damaged: images that were there and could not be decoded.
    """

    def __init__(self) -> None:
        self.n_damaged = 0
        self._rest = bytearray()

    def feed(self, data: bytes) -> Iterator[Pixels]:
        """Take bytes and yield the images that they complete, (H, W) grey or (H, W, 3) BGR.

        Raises:
            ValueError: the stream is not what it began as.
        """
        self._rest += data
        while (payload := self._cut()) is not None:
            try:
                pixels = self._decode(payload)
            except ValueError:
                self.n_damaged += 1
                continue
            yield pixels

    @property
    def n_left(self) -> int:
        """Bytes of an image that is not complete yet."""
        return len(self._rest)

    @abstractmethod
    def _cut(self) -> bytes | None:
        """Take the next image's bytes off the rest; None where they have not all come."""

    @abstractmethod
    def _decode(self, payload: bytes) -> Pixels:
        """Decode one image; ValueError where it is damaged."""

    def _take(self, n_bytes: int) -> bytes:
        taken = bytes(self._rest[:n_bytes])
        del self._rest[:n_bytes]
        return taken

    def _line(self) -> str | None:
        end = self._rest.find(b"\n", 0, _MAX_HEADER)
        if end < 0:
            if len(self._rest) >= _MAX_HEADER:
                raise ValueError("a line of text was expected, other bytes came")
            return None
        return self._take(end + 1).decode("ascii", "backslashreplace").rstrip()


class RawImages(ImageStream):
    """Images of one pixel format and size, with nothing between them and no padding of rows.

    Attributes:
        row_bytes: length of a row.
    """

    def __init__(self, code: str, width: int, height: int) -> None:
        super().__init__()
        self.row_bytes = FORMATS[code].row_bytes(width)
        self._decoder = PixelDecoder(code, width, height)

    def _cut(self) -> bytes | None:
        n_bytes = self._decoder.n_bytes
        return self._take(n_bytes) if len(self._rest) >= n_bytes else None

    def _decode(self, payload: bytes) -> Pixels:
        return self._decoder.decode(payload)


class Y4mImages(ImageStream):
    """YUV4MPEG2 of 8 bits; of finer chroma than 4:2:0 every other sample is taken."""

    def __init__(self) -> None:
        super().__init__()
        self._decoder: PixelDecoder | None = None
        self._colour = ""
        self._size = 0, 0
        self._is_in_frame = False

    def _cut(self) -> bytes | None:
        if self._decoder is None:
            line = self._line()
            if line is None:
                return None
            self._decoder = self._read_header(line)
        if not self._is_in_frame:
            line = self._line()
            if line is None:
                return None
            if not line.startswith("FRAME"):
                width = self._size[0]
                known = (
                    f"; GStreamer writes broken Y4M at widths like {width}: use jpegenc" if width % 8 else ""
                )
                raise ValueError(f"a Y4M frame was expected, {line[:20]!r} came{known}")
            self._is_in_frame = True
        n_pixels = self._size[0] * self._size[1]
        finer = {"444": 3 * n_pixels, "422": 2 * n_pixels}
        n_bytes = finer.get(self._colour, self._decoder.n_bytes)
        if len(self._rest) < n_bytes:
            return None
        self._is_in_frame = False
        return self._take(n_bytes)

    def _decode(self, payload: bytes) -> Pixels:
        assert self._decoder is not None  # frames follow the header
        if self._colour in ("444", "422"):
            (width, height), step = self._size, 2 if self._colour == "444" else 1
            n_luma = width * height
            chroma = np.frombuffer(payload, np.uint8, offset=n_luma).reshape(2, height, -1)
            payload = payload[:n_luma] + chroma[:, ::2, ::step].tobytes()
        return self._decoder.decode(payload)

    def _read_header(self, line: str) -> PixelDecoder:
        fields = {word[0]: word[1:] for word in line.split(" ")[1:] if word}
        width, height = fields.get("W", ""), fields.get("H", "")
        colour = fields.get("C", "420")
        if not (width.isdigit() and height.isdigit() and 0 < int(width) < 65536 and 0 < int(height) < 65536):
            raise ValueError(f"the Y4M header tells no size: {line[:80]!r}")
        if colour not in ("mono", "444", "422", *_420):
            raise ValueError(f"Y4M colour {colour} is not read here: let the command write 4:2:0, 8 bit")
        if int(width) * int(height) > MAX_PIXELS:
            raise ValueError(f"Y4M images of {width}x{height} px are too large: at most {MAX_PIXELS} px")
        if colour != "mono" and (int(width) % 2 or int(height) % 2):
            raise ValueError(f"Y4M images of {width}x{height} px in colour: both must be even")
        self._colour, self._size = colour, (int(width), int(height))
        return PixelDecoder("GREY" if colour == "mono" else "YU12", *self._size)


class PnmImages(ImageStream):
    """PGM and PPM files of 8 or 16 bits, one behind the other."""

    def _cut(self) -> bytes | None:
        match = _PNM_HEADER.match(self._rest, 0, _MAX_HEADER)
        if match is None:
            if len(self._rest) >= _MAX_HEADER or bytes(self._rest[:2]) not in (b"", b"P", b"P5", b"P6"):
                raise ValueError(f"a PGM or PPM image was expected, {bytes(self._rest[:20])!r} came")
            return None
        width, height, most = (int(text) for text in match.groups()[1:])
        n_channels = 3 if match.group(1) == b"P6" else 1
        n_bytes = match.end() + width * height * n_channels * (1 if most < 256 else 2)
        return self._take(n_bytes) if len(self._rest) >= n_bytes else None

    def _decode(self, payload: bytes) -> Pixels:
        match = _PNM_HEADER.match(payload)
        assert match is not None  # it was cut by this
        width, height, most = (int(text) for text in match.groups()[1:])
        if not 0 < most < 65536 or width * height == 0:
            raise ValueError(f"{width}x{height} px with values up to {most} is no image")
        shape = (height, width, 3) if match.group(1) == b"P6" else (height, width)
        values = np.frombuffer(payload, ">u2" if most > 255 else "u1", offset=match.end()).reshape(shape)
        if most != 255:
            values = np.rint(np.minimum(values * (255.0 / most), 255)).astype(np.uint8)
        return np.array(values if values.ndim == 2 else values[:, :, ::-1])


class JpegImages(ImageStream):
    """JPEG files, one behind the other; anything between them is skipped."""

    def __init__(self) -> None:
        super().__init__()
        self._searched = 0

    def _cut(self) -> bytes | None:
        start = self._rest.find(_SOI + b"\xff")
        if start < 0:
            del self._rest[: max(0, len(self._rest) - 2)]
            return None
        if start:
            del self._rest[:start]
            self._searched = 0
        end = self._find_end()
        if end is None:
            if len(self._rest) > _MAX_JPEG:
                raise ValueError(f"a JPEG image does not end within {_MAX_JPEG >> 20} MiB")
            return None
        self._searched = 0
        return self._take(end)

    def _find_end(self) -> int | None:
        """Walk the segments, which may hold small images, to the data, which ends at the first EOI."""
        at = 2
        while at + 4 <= len(self._rest) and self._rest[at] == 0xFF:
            kind, n_bytes = self._rest[at + 1], int.from_bytes(self._rest[at + 2 : at + 4], "big")
            at += 2 + n_bytes
            if kind == _SOS:
                found = self._rest.find(_EOI, max(at, self._searched - 1))
                self._searched = len(self._rest)
                return None if found < 0 else found + 2
        if at + 4 <= len(self._rest):  # damaged: go on at the next image
            following = self._rest.find(_SOI + b"\xff", 2)
            return following if following > 0 else None
        return None

    def _decode(self, payload: bytes) -> Pixels:
        return decode_image(payload)


def find_stream(begin: bytes) -> ImageStream | None:
    """Tell by its first bytes what a stream holds; None where they do not tell."""
    if begin.startswith(b"YUV4MPEG2 "):
        return Y4mImages()
    if begin.startswith((b"P5", b"P6")):
        return PnmImages()
    if begin.startswith(_SOI) or begin.startswith(b"--"):  # "--": the boundary of a multipart stream
        return JpegImages()
    return None
