"""iniVation's AEDAT4 files, read without iniVation's library: a flatbuffer of events in each packet.

The table at the end of the file is not needed: the packets are walked from the front, so that a file whose
recorder was killed is read as far as it goes.

References:
    https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-4.0.html
    https://flatbuffers.dev/internals/
"""

import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lce_rig.core.errors import SourceError
from lce_rig.sources.events.stream import NS_PER_US, EventColumns, Findings, join_small

MAGIC = b"#!AER-DAT4.0\r\n"
EVENT = np.dtype({"names": ["t", "x", "y", "on"], "formats": ["<i8", "<i2", "<i2", "?"], "itemsize": 16})
_LZ4_MAGIC, _ZSTD_MAGIC = b"\x04\x22\x4d\x18", b"\x28\xb5\x2f\xfd"
_MAX_PACKET_BYTES = 1 << 30
_STRETCH_EVENTS = 1 << 16
_SEARCH_BYTES = 1 << 24


@dataclass(frozen=True)
class Aedat4Header:
    """What the head of a file says.

    Attributes:
        begin: where the packets begin.
        end: where they end, as the recorder noted on closing; None where it did not get to.
        streams: (type, attributes) by number: {0: ("EVTS", {"sizeX": "346", ...})}.
    """

    begin: int
    end: int | None
    streams: dict[int, tuple[str, dict[str, str]]]


class Aedat4Events:
    """Events of an AEDAT4 file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the header and take the first stream of events.

        Raises:
            SourceError: it is no AEDAT4 file, or has no events.
        """
        self._path = path
        self.notes: list[str] = []
        self._header = read_header(path)
        numbers = [n for n, (kind, _) in sorted(self._header.streams.items()) if kind == "EVTS"]
        if not numbers:
            kinds = ", ".join(kind for kind, _ in self._header.streams.values()) or "none"
            raise SourceError(f"{path} holds no stream of events; its streams: {kinds}")
        self._number = numbers[0]
        _, attributes = self._header.streams[self._number]
        if len(numbers) > 1:
            self.notes.append(f"{path.name}: events of stream {self._number}, the first of {len(numbers)}")
        if self._header.end is None:
            self.notes.append(f"{path.name}: was never closed; read as far as it goes")
        size = attributes.get("sizeX", ""), attributes.get("sizeY", "")
        is_sized = size[0].isdigit() and size[1].isdigit()
        self.resolution_px = (int(size[0]), int(size[1])) if is_sized else None

    def stretches(self, findings: Findings) -> Iterator[EventColumns]:
        """Yield the events, some packets at a time."""
        yield from join_small(self._packets(findings), _STRETCH_EVENTS)

    def _packets(self, findings: Findings) -> Iterator[EventColumns]:
        n_bytes = self._path.stat().st_size
        end = min(self._header.end or n_bytes, n_bytes)
        position, n_packets = self._header.begin, 0
        with self._path.open("rb") as file:
            while position < end:
                where = f"packet {n_packets} at byte {position}"
                number, size = self._packet_head(file, position, end)
                if size is None:
                    following = self._next_packet(file, position + 1, end)
                    if following is None:
                        findings.add("torn ends of the file left out", f"{end - position} bytes, {where}")
                        return
                    findings.add("broken packets left out", f"{where}: its head is damaged")
                    position, n_packets = following, n_packets + 1
                    continue
                if number == self._number:
                    try:
                        yield _decode_packet(file.read(size))
                    except Exception as error:  # A damaged packet fails in any way: lz4, zstd, struct, sizes.
                        what = str(error) or type(error).__name__
                        findings.add("broken packets left out", f"{where}: {what}")
                position += 8 + size
                n_packets += 1

    def _packet_head(self, file: BinaryIO, position: int, end: int) -> tuple[int, int | None]:
        """Read stream and size of a packet; no size where it cannot be one."""
        file.seek(position)
        head = file.read(8)
        number, size = struct.unpack("<ii", head) if len(head) == 8 else (-1, -1)
        is_whole = 0 <= size <= _MAX_PACKET_BYTES and position + 8 + size <= end
        return number, size if is_whole and number in self._header.streams else None

    def _next_packet(self, file: BinaryIO, position: int, end: int) -> int | None:
        """Find the next packet behind a damaged head by what compressed data begins with."""
        file.seek(position)
        data = file.read(min(end - position, _SEARCH_BYTES))
        for match in re.finditer(re.escape(_LZ4_MAGIC) + b"|" + re.escape(_ZSTD_MAGIC), data):
            found = position + match.start() - 8
            if match.start() >= 8 and self._packet_head(file, found, end)[1] is not None:
                return found
        return None


def read_header(path: Path) -> Aedat4Header:
    """Read what an AEDAT4 file says about its streams.

    Raises:
        SourceError: it is no AEDAT4 file, or its head is damaged.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise SourceError(f"{path} is no AEDAT4 file", "Convert older files (AEDAT 2, 3) with DV first.")
        try:
            return _parse_header(file)
        except (struct.error, ValueError, ElementTree.ParseError) as error:
            raise SourceError(f"{path}: the head of the file is damaged: {error}") from None


def _parse_header(file: BinaryIO) -> Aedat4Header:
    (size,) = struct.unpack("<I", file.read(4))
    table = file.read(size)
    begin = file.tell()
    if size > _MAX_PACKET_BYTES or len(table) != size or table[4:8] != b"IOHE":
        raise ValueError("it is cut off")
    end_at, text_at = _field(table, 1), _field(table, 2)
    end = -1 if end_at is None else struct.unpack_from("<q", table, end_at)[0]
    if text_at is None:
        raise ValueError("it describes no streams")
    text_at += struct.unpack_from("<I", table, text_at)[0]
    (n_text,) = struct.unpack_from("<I", table, text_at)
    root = ElementTree.fromstring(table[text_at + 4 : text_at + 4 + n_text])
    streams = {}
    for node in root.iterfind("./node[@name='outInfo']/node"):
        name, kind = node.get("name", ""), node.findtext("./attr[@key='typeIdentifier']") or ""
        info = {a.get("key", ""): a.text or "" for a in node.iterfind("./node[@name='info']/attr")}
        streams[int(name)] = kind, info
    return Aedat4Header(begin, None if end < begin else end, streams)


def _decode_packet(data: bytes) -> EventColumns:
    """Decode one packet of events, compressed or not.

    Raises:
        ValueError: it holds no events.
    """
    table = _decompress(data)[4:]
    if table[4:8] != b"EVTS":
        raise ValueError(f"it holds {bytes(table[4:8])!r}, not events")
    at = _field(table, 0)
    if at is None:
        events = np.empty(0, EVENT)
    else:
        at += struct.unpack_from("<I", table, at)[0]
        (n_events,) = struct.unpack_from("<I", table, at)
        events = np.frombuffer(table, EVENT, n_events, at + 4)
    x, y = events["x"].astype(np.uint16), events["y"].astype(np.uint16)
    return EventColumns(events["t"] * NS_PER_US, x, y, events["on"].copy())


def _decompress(data: bytes) -> bytes:
    if data[:4] == _LZ4_MAGIC:
        from lz4.frame import decompress as decompress_lz4  # type: ignore[import-untyped]

        return bytes(decompress_lz4(data))
    if data[:4] == _ZSTD_MAGIC:
        return bytes(_zstd().decompress(data))
    return data


def _zstd() -> Any:
    """Import the Zstandard that this Python or rosbags brings."""
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")


def _field(table: bytes, index: int) -> int | None:
    """Find where a field of a flatbuffer's root table lies; None where it has its default."""
    (root,) = struct.unpack_from("<I", table, 0)
    vtable = root - struct.unpack_from("<i", table, root)[0]
    n_bytes = struct.unpack_from("<H", table, vtable)[0]
    if 4 + 2 * index >= n_bytes:
        return None
    offset: int = struct.unpack_from("<H", table, vtable + 4 + 2 * index)[0]
    return root + offset if offset else None
