"""Images in a stream of bytes, one behind the other: Y4M, PNM (PGM and PPM), JPEG, or raw.

References:
    https://wiki.multimedia.cx/index.php/YUV4MPEG2
    https://netpbm.sourceforge.net/doc/pgm.html, https://netpbm.sourceforge.net/doc/ppm.html
    ITU-T T.81, annex B (the segments of a JPEG)
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator

from lce_rig.devices.pixel_formats import FORMATS, PixelDecoder, Pixels
from lce_rig.io.folder.decoding import decode_image
from lce_rig.rig.sensors import MAX_PIXELS

_MAX_HEADER = 4096
_MAX_JPEG = 1 << 26
_PNM_HEADER = re.compile(rb"(P[56])\s+(?:#[^\n]*\n\s*)*(\d+)\s+(?:#[^\n]*\n\s*)*(\d+)\s+(\d+)\s")
# They differ in where a chroma sample sits.
_Y4M_COLOURS = ("mono", "420", "420jpeg", "420mpeg2", "420paldv")
_SOI, _EOI, _SOS = b"\xff\xd8", b"\xff\xd9", 0xDA


class ImageStream(ABC):
    """Bytes in as they come, images out.

    Attributes:
        n_damaged: images that were there and could not be decoded.
    """

    def __init__(self, decode: Callable[[bytes], Pixels] = decode_image) -> None:
        self.n_damaged = 0
        self._decode = decode
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

    def _take(self, n_bytes: int) -> bytes | None:
        if len(self._rest) < n_bytes:
            return None
        taken = bytes(self._rest[:n_bytes])
        del self._rest[:n_bytes]
        return taken


class RawImages(ImageStream):
    """Images of one pixel format and size, with nothing between them and no padding of rows.

    Attributes:
        row_bytes: length of a row.
    """

    def __init__(self, code: str, width: int, height: int) -> None:
        decoder = PixelDecoder(code, width, height)
        super().__init__(decoder.decode)
        self.row_bytes = FORMATS[code].row_bytes(width)
        self._n_bytes = decoder.n_bytes

    def _cut(self) -> bytes | None:
        return self._take(self._n_bytes)


class Y4mImages(ImageStream):
    """YUV4MPEG2 of 8 bits, grey or 4:2:0."""

    def __init__(self) -> None:
        super().__init__()
        self._width = self._n_bytes = 0
        self._is_in_frame = False

    def _cut(self) -> bytes | None:
        if not self._n_bytes:
            header = self._line()
            if header is None:
                return None
            self._read_header(header)
        if not self._is_in_frame:
            line = self._line()
            if line is None:
                return None
            if not line.startswith("FRAME"):
                hint = f"; GStreamer writes broken Y4M at widths like {self._width}: use jpegenc"
                is_odd = self._width % 8 != 0
                raise ValueError(f"a Y4M frame was expected, {line[:20]!r} came{hint if is_odd else ''}")
            self._is_in_frame = True
        payload = self._take(self._n_bytes)
        self._is_in_frame = payload is None
        return payload

    def _line(self) -> str | None:
        end = self._rest.find(b"\n", 0, _MAX_HEADER)
        if end < 0 and len(self._rest) >= _MAX_HEADER:
            raise ValueError("a line of text was expected, other bytes came")
        line = self._take(end + 1) if end >= 0 else None
        return None if line is None else line.decode("ascii", "backslashreplace").rstrip()

    def _read_header(self, line: str) -> None:
        fields = {word[0]: word[1:] for word in line.split(" ")[1:] if word}
        sides, colour = (fields.get("W", ""), fields.get("H", "")), fields.get("C", "420")
        if not all(side.isdigit() and 0 < int(side) < 65536 for side in sides):
            raise ValueError(f"the Y4M header holds no size: {line[:80]!r}")
        if colour not in _Y4M_COLOURS:
            raise ValueError(f"Y4M colour {colour} is not read here: let the command write 4:2:0, 8 bit")
        width, height = (int(side) for side in sides)
        if width * height > MAX_PIXELS:
            raise ValueError(f"Y4M images of {width}x{height} px are too large: at most {MAX_PIXELS} px")
        if colour != "mono" and (width % 2 or height % 2):
            raise ValueError(f"Y4M images of {width}x{height} px in colour: both must be even")
        decoder = PixelDecoder("GREY" if colour == "mono" else "YU12", width, height)
        self._width, self._n_bytes, self._decode = width, decoder.n_bytes, decoder.decode


class PnmImages(ImageStream):
    """PGM and PPM files of 8 bits, one behind the other."""

    def _cut(self) -> bytes | None:
        match = _PNM_HEADER.match(self._rest, 0, _MAX_HEADER)
        if match is None:
            if len(self._rest) >= _MAX_HEADER or bytes(self._rest[:2]) not in (b"", b"P", b"P5", b"P6"):
                raise ValueError(f"a PGM or PPM image was expected, {bytes(self._rest[:20])!r} came")
            return None
        width, height, most = (int(text) for text in match.groups()[1:])
        if most > 255:
            raise ValueError(
                f"PGM or PPM with values up to {most} is not read here: let the command write 8 bit"
            )
        return self._take(match.end() + width * height * (3 if match.group(1) == b"P6" else 1))


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


def find_stream(begin: bytes) -> ImageStream | None:
    """Choose the kind of a stream by its first bytes; None where they fit none."""
    if begin.startswith(b"YUV4MPEG2 "):
        return Y4mImages()
    if begin.startswith((b"P5", b"P6")):
        return PnmImages()
    if begin.startswith(_SOI) or begin.startswith(b"--"):  # "--": the boundary of a multipart stream
        return JpegImages()
    return None
