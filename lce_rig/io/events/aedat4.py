"""iniVation's AEDAT4 files: events and frames.

The file is read here, not by dv-processing: that library refuses recordings that were cut short and never
returns from some damaged ones. The table at the end of the file is not needed: packets are walked from the
front, as far as they go.

References:
    https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-4.0.html
    https://flatbuffers.dev/internals/
    https://gitlab.com/inivation/dv/dv-processing/-/blob/master/include/dv-processing/data/frame_base.hpp
"""

import re
import struct
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import MAX_TIME_NS, EventColumns
from lce_rig.core.errors import SourceError, reading, reason_of
from lce_rig.core.findings import Losses
from lce_rig.io import findings
from lce_rig.io.events.event_recording import NS_PER_US, EventStream, NoEventsError, parse_size, to_ns

MAGIC = b"#!AER-DAT4.0\r\n"
EVENT = np.dtype({"names": ["t", "x", "y", "on"], "formats": ["<i8", "<i2", "<i2", "?"], "itemsize": 16})
_LZ4_MAGIC, _ZSTD_MAGIC = b"\x04\x22\x4d\x18", b"\x28\xb5\x2f\xfd"
# A smaller flatbuffer has no room for its own identifier: zeros, as power cuts leave, are no packets.
_MIN_PACKET_BYTES = 8
_SOURCE = re.compile("(?:DAVIS|DV)[A-Za-z0-9]*_([A-Za-z0-9]{1,64})")
# Fields of a frame's table; 1 and 2 are of the read-out.
_TIMESTAMP, _EXPOSURE_START, _EXPOSURE_END, _FORMAT = 0, 3, 4, 5
_WIDTH, _HEIGHT, _PIXELS, _EXPOSURE = 6, 7, 10, 11
# OpenCV's type numbers of 8-bit images.
_CHANNELS = {0: 1, 16: 3, 24: 4}
_NOT_CLOSED = -1
_Content = TypeVar("_Content")


class Aedat4Frame(NamedTuple):
    """One image of a file.

    Attributes:
        mid_exposure_ns: device time; the frame's own timestamp if the exposure is unknown.
        exposure_ns: 0 if the file does not record it.
        pixels: (H, W) grey or (H, W, 3) BGR, uint8.
    """

    mid_exposure_ns: int
    exposure_ns: int
    pixels: NDArray[np.uint8]


class Aedat4File:
    """The streams of an AEDAT4 file and the places of their packets.

    Attributes:
        path: the file.
        streams: (type, attributes) by number: {0: ("EVTS", {"sizeX": "346", ...})}.
        places: (position, bytes) of every packet's content, by stream.
        notes: what is unusual about the file.
    """

    def __init__(self, path: Path) -> None:
        """Read the header, and the heads of all packets.

        Raises:
            SourceError: it is not an AEDAT4 file, or its header is damaged.
        """
        self.path = path
        self.notes: list[str] = []
        with reading(path), path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                hint = "Convert older files (AEDAT 2, 3) with DV first."
                raise SourceError(f"{path} is not an AEDAT4 file", hint)
            (size,) = struct.unpack("<I", file.read(4))
            table = file.read(size)
            begin, end = file.tell(), path.stat().st_size
            if table[4:8] != b"IOHE":
                raise ValueError("its header is cut off")
            table_at = _number(table, 1, "q", _NOT_CLOSED)
            at, n_bytes = _vector_at(table, 2)
            self.streams: dict[int, tuple[str, dict[str, str]]] = {}
            xml = ElementTree.fromstring(table[at : at + n_bytes].decode())
            for node in xml.iterfind("./node[@name='outInfo']/node"):
                entries = node.iterfind("./node[@name='info']/attr")
                attributes = {entry.get("key", ""): entry.text or "" for entry in entries}
                kind = node.findtext("./attr[@key='typeIdentifier']") or ""
                self.streams[int(node.get("name", ""))] = kind, attributes
            self.places: dict[int, list[tuple[int, int]]] = {number: [] for number in self.streams}
            self._torn = self._walk(file, begin, end if table_at < begin else min(table_at, end))

    @property
    def serial(self) -> str:
        """The camera's serial number, if a stream's source is named like DAVIS346_00000499, else ""."""
        sources = (attributes.get("source", "") for _, attributes in self.streams.values())
        named = (_SOURCE.fullmatch(source) for source in sources)
        return next((match[1] for match in named if match), "")

    def first_stream(self, kind: str) -> int | None:
        """Return the number of the first stream of a type, "EVTS" or "FRME"; other streams are noted."""
        numbers = [number for number, (named, _) in sorted(self.streams.items()) if named == kind]
        if len(numbers) > 1:
            what = {"EVTS": "events", "FRME": "frames"}[kind]
            self.notes.append(f"{self.path.name}: {what} of stream {numbers[0]}, the first of {len(numbers)}")
        return numbers[0] if numbers else None

    def packets(self, stream: int, losses: Losses, decode: Callable[[bytes], _Content]) -> Iterator[_Content]:
        """Yield the decoded packets of a stream; damaged ones are skipped."""
        with reading(self.path), self.path.open("rb") as file:
            for number, (at, n_bytes) in enumerate(self.places[stream]):
                file.seek(at)
                try:
                    data = file.read(n_bytes)
                    module = {_LZ4_MAGIC: "lz4.frame", _ZSTD_MAGIC: "compression.zstd"}.get(data[:4])
                    if module == "compression.zstd" and sys.version_info < (3, 14):
                        module = "backports.zstd"
                    content = decode((bytes(import_module(module).decompress(data)) if module else data)[4:])
                except OSError:
                    raise
                except Exception as error:  # of lz4, zstd, struct or numpy
                    where = f"packet {number} at byte {at - 8}: {reason_of(error)}"
                    losses.add(findings.BROKEN_PACKETS(where=where))
                    continue
                yield content
        if self._torn:
            losses.add(findings.TORN_END(where=self._torn))

    def _walk(self, file: BinaryIO, position: int, end: int) -> str:
        """Note the places of all packets; returns where a damaged head ends them, "" if none does."""
        while position < end:
            file.seek(position)
            head = file.read(8)
            number, size = struct.unpack("<ii", head) if len(head) == 8 else (-1, -1)
            if number not in self.streams or size < _MIN_PACKET_BYTES or position + 8 + size > end:
                return f"{end - position} bytes, from byte {position}"
            self.places[number].append((position + 8, size))
            position += 8 + size
        return ""


class Aedat4Events(EventStream):
    """Events of an AEDAT4 file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the header and take the first stream of events.

        Raises:
            NoEventsError: it has no events.
            SourceError: it is not an AEDAT4 file.
        """
        self._file = Aedat4File(path)
        number = self._file.first_stream("EVTS")
        if number is None:
            kinds = ", ".join(kind for kind, _ in self._file.streams.values()) or "none"
            raise NoEventsError(f"{path} holds no stream of events; its streams: {kinds}")
        self._number = number
        self.notes = self._file.notes
        _, attributes = self._file.streams[number]
        self.resolution_px = parse_size(attributes.get("sizeX", ""), attributes.get("sizeY", ""))

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events, a packet at a time."""
        return self._file.packets(self._number, losses, _decode_events)


def decode_frame(table: bytes) -> Aedat4Frame:
    """Decode one packet.

    A frame's own timestamp is the middle of its exposure in DV's files and its start in dv-processing's. Both
    also write start and end of the exposure, which are used.

    Raises:
        ValueError: it holds no frame, or one of an unknown kind.
    """
    if table[4:8] != b"FRME":
        raise ValueError(f"it holds {bytes(table[4:8])!r}, not a frame")
    start_us, end_us = _number(table, _EXPOSURE_START, "q"), _number(table, _EXPOSURE_END, "q")
    exposure_us = end_us - start_us if end_us > start_us > 0 else _number(table, _EXPOSURE, "q")
    begin_us = start_us if end_us > start_us > 0 else _number(table, _TIMESTAMP, "q")
    mid_ns = begin_us * NS_PER_US + exposure_us * NS_PER_US // 2
    if abs(mid_ns) >= MAX_TIME_NS:
        raise ValueError("its timestamp is beyond any clock")
    width, height = _number(table, _WIDTH, "h"), _number(table, _HEIGHT, "h")
    n_channels = _CHANNELS[_number(table, _FORMAT, "b")]
    at, n_bytes = _vector_at(table, _PIXELS)
    if n_bytes != width * height * n_channels or not n_bytes:
        raise ValueError(f"{n_bytes} bytes are not an image of {width}x{height} pixels")
    pixels = np.frombuffer(table, np.uint8, n_bytes, at).reshape(height, width, n_channels)
    image = np.array(pixels[..., 0] if n_channels == 1 else pixels[..., :3])
    return Aedat4Frame(mid_ns, exposure_us * NS_PER_US, image)


def _decode_events(table: bytes) -> EventColumns:
    """Decode one packet.

    Raises:
        ValueError: it holds no events.
    """
    if table[4:8] != b"EVTS":
        raise ValueError(f"it holds {bytes(table[4:8])!r}, not events")
    at, n_events = _vector_at(table, 0)
    events = np.frombuffer(table, EVENT, n_events, at) if n_events else np.empty(0, EVENT)
    x, y = events["x"].astype(np.uint16), events["y"].astype(np.uint16)
    return EventColumns(to_ns(events["t"]), x, y, events["on"].view(np.uint8) != 0)


def _field_at(table: bytes, index: int) -> int | None:
    """Find a field of a flatbuffer's root table; None if it has its default."""
    (root,) = struct.unpack_from("<I", table, 0)
    vtable = root - struct.unpack_from("<i", table, root)[0]
    if 4 + 2 * index >= struct.unpack_from("<H", table, vtable)[0]:
        return None
    offset: int = struct.unpack_from("<H", table, vtable + 4 + 2 * index)[0]
    return root + offset if offset else None


def _number(table: bytes, index: int, kind: str, default: int = 0) -> int:
    at = _field_at(table, index)
    return default if at is None else int(struct.unpack_from(f"<{kind}", table, at)[0])


def _vector_at(table: bytes, index: int) -> tuple[int, int]:
    """Find a vector of a flatbuffer's root table: its first element and its length; 0, 0 if it is absent."""
    at = _field_at(table, index)
    if at is None:
        return 0, 0
    at += struct.unpack_from("<I", table, at)[0]
    return at + 4, int(struct.unpack_from("<I", table, at)[0])
