"""The container of AEDAT4 files: a head that names the streams, and packets of flatbuffers behind it.

The table at the end of the file is not needed: the packets are walked from the front, so that a file whose
recorder was killed is read as far as it goes.

References:
    https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-4.0.html
    https://flatbuffers.dev/internals/
"""

import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeVar

from lce_rig.core import limits, unpacking
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses
from lce_rig.io.events.stream import damage, open_recorded

MAGIC = b"#!AER-DAT4.0\r\n"
_LZ4_MAGIC, _ZSTD_MAGIC = b"\x04\x22\x4d\x18", b"\x28\xb5\x2f\xfd"
# Recorders write a kilobyte a stream.
_MAX_HEAD_BYTES = 1 << 20
# A smaller flatbuffer has no room for what it is; zeros, as power cuts leave, are no row of empty packets.
_MIN_PACKET_BYTES = 8
_SEARCH_BYTES = 1 << 24
_SEARCH_STEP_BYTES = 1 << 16
_Content = TypeVar("_Content")
_SOURCE = re.compile("(?:DAVIS|DV)[A-Za-z0-9]*_([A-Za-z0-9]{1,64})")
_STREAM_NUMBER = re.compile("[0-9]{1,9}")


@dataclass(frozen=True)
class Aedat4Header:
    """The header of a file.

    Attributes:
        begin: where the packets begin.
        end: where they end, as the recorder noted on closing; None where it did not get to.
        streams: (type, attributes) by number: {0: ("EVTS", {"sizeX": "346", ...})}.
    """

    begin: int
    end: int | None
    streams: dict[int, tuple[str, dict[str, str]]]


@dataclass(frozen=True)
class PacketPlace:
    """The position of a packet.

    Attributes:
        stream: number of its stream.
        at, n_bytes: of its content, without its header.
        where: "packet 12 at byte 4711", for messages.
    """

    stream: int
    at: int
    n_bytes: int
    where: str


class Aedat4File:
    """An AEDAT4 file, walked packet by packet as often as wanted.

    Attributes:
        path: the file.
        header: what its head says.
        notes: what is unusual about it, in words.
    """

    def __init__(self, path: Path) -> None:
        """Read the head.

        Raises:
            SourceError: it is not an AEDAT4 file, or its header is damaged.
        """
        self.path = path
        self.header = read_header(path)
        self.notes: list[str] = []
        if self.header.end is None:
            self.notes.append(f"{path.name}: was never closed; read up to its end")

    @property
    def serial(self) -> str:
        """The camera's serial number, where a stream's source is named like DAVIS346_00000499, else ""."""
        sources = (attributes.get("source", "") for _, attributes in self.header.streams.values())
        named = (_SOURCE.fullmatch(source) for source in sources)
        return next((match[1] for match in named if match), "")

    def first_stream(self, kind: str) -> int | None:
        """Name the first stream of a type, "EVTS" or "FRME"; None where there is none. Others are noted."""
        numbers = [n for n, (found, _) in sorted(self.header.streams.items()) if found == kind]
        if len(numbers) > 1:
            what = {"EVTS": "events", "FRME": "frames"}[kind]
            self.notes.append(f"{self.path.name}: {what} of stream {numbers[0]}, the first of {len(numbers)}")
        return numbers[0] if numbers else None

    def packets(self, stream: int, losses: Losses, decode: Callable[[bytes], _Content]) -> Iterator[_Content]:
        """Yield the packets of a stream, decoded from their flatbuffers; damaged ones are skipped."""
        with open_recorded(self.path) as file:
            for place in self._places(file, losses):
                if place.stream != stream:
                    continue
                file.seek(place.at)
                try:
                    content = decode(_decompress(file.read(place.n_bytes))[4:])
                except Exception as error:  # Damage shows in any way: lz4, zstd, struct, sizes.
                    where = f"{place.where}: {str(error) or type(error).__name__}"
                    losses.add(damage("recording.broken_packets", where))
                    continue
                yield content

    def n_packets(self, stream: int) -> int:
        """Count the packets of a stream; only their heads are read."""
        with open_recorded(self.path) as file:
            return sum(place.stream == stream for place in self._places(file, Losses()))

    def last_packet(self, stream: int, decode: Callable[[bytes], _Content]) -> _Content | None:
        """Decode the last whole packet of a stream, not those before it; None where there is none."""
        with open_recorded(self.path) as file:
            places = [place for place in self._places(file, Losses()) if place.stream == stream]
            for place in reversed(places):
                file.seek(place.at)
                try:
                    return decode(_decompress(file.read(place.n_bytes))[4:])
                except Exception:  # As above; the one before it will do.
                    continue
        return None

    def _places(self, file: BinaryIO, losses: Losses) -> Iterator[PacketPlace]:
        n_bytes = self.path.stat().st_size
        end = min(self.header.end or n_bytes, n_bytes)
        position, n_packets = self.header.begin, 0
        while position < end:
            where = f"packet {n_packets} at byte {position}"
            number, size = self._packet_head(file, position, end)
            if size is None:
                following = self._next_packet(file, position + 1, end)
                if following is None:
                    losses.add(damage("recording.torn_end", f"{end - position} bytes, {where}"))
                    return
                losses.add(damage("recording.broken_packets", f"{where}: its head is damaged"))
                position, n_packets = following, n_packets + 1
                continue
            yield PacketPlace(number, position + 8, size, where)
            position += 8 + size
            n_packets += 1

    def _packet_head(self, file: BinaryIO, position: int, end: int) -> tuple[int, int | None]:
        """Read stream and size of a packet; no size where it cannot be one."""
        file.seek(position)
        head = file.read(8)
        number, size = struct.unpack("<ii", head) if len(head) == 8 else (-1, -1)
        is_whole = _MIN_PACKET_BYTES <= size <= limits.MAX_CHUNK_BYTES and position + 8 + size <= end
        return number, size if is_whole and number in self.header.streams else None

    def _next_packet(self, file: BinaryIO, position: int, end: int) -> int | None:
        """Find the next packet behind a damaged head by what compressed data begins with."""
        end_search = min(end, position + _SEARCH_BYTES)
        # In steps, that overlap by a head and a magic: most often the next packet is near.
        for begin in range(position, end_search, _SEARCH_STEP_BYTES):
            file.seek(begin)
            data = file.read(min(end_search - begin, _SEARCH_STEP_BYTES + 11))
            for match in re.finditer(re.escape(_LZ4_MAGIC) + b"|" + re.escape(_ZSTD_MAGIC), data):
                found = begin + match.start() - 8
                if match.start() >= 8 and self._packet_head(file, found, end)[1] is not None:
                    return found
        return None


def read_header(path: Path) -> Aedat4Header:
    """Read what an AEDAT4 file says about its streams.

    Raises:
        SourceError: it is not an AEDAT4 file, or its header is damaged.
    """
    with open_recorded(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise SourceError(
                f"{path} is not an AEDAT4 file", "Convert older files (AEDAT 2, 3) with DV first."
            )
        try:
            return _parse_header(file)
        except (struct.error, ValueError, ElementTree.ParseError) as error:
            raise SourceError(f"{path}: the head of the file is damaged: {error}") from None


def field_at(table: bytes, index: int) -> int | None:
    """Find where a field of a flatbuffer's root table lies; None where it has its default."""
    (root,) = struct.unpack_from("<I", table, 0)
    vtable = root - struct.unpack_from("<i", table, root)[0]
    n_bytes = struct.unpack_from("<H", table, vtable)[0]
    if 4 + 2 * index >= n_bytes:
        return None
    offset: int = struct.unpack_from("<H", table, vtable + 4 + 2 * index)[0]
    return root + offset if offset else None


def vector_at(table: bytes, index: int) -> tuple[int, int]:
    """Find a vector of a flatbuffer's root table: where it begins, and its length; 0, 0 where it is not."""
    at = field_at(table, index)
    if at is None:
        return 0, 0
    at += struct.unpack_from("<I", table, at)[0]
    (length,) = struct.unpack_from("<I", table, at)
    return at + 4, int(length)


def _parse_header(file: BinaryIO) -> Aedat4Header:
    (size,) = struct.unpack("<I", file.read(4))
    table = file.read(limits.check_size(size, "it", _MAX_HEAD_BYTES))
    begin = file.tell()
    if len(table) != size or table[4:8] != b"IOHE":
        raise ValueError("it is cut off")
    end_at, (text_at, n_text) = field_at(table, 1), vector_at(table, 2)
    end = -1 if end_at is None else struct.unpack_from("<q", table, end_at)[0]
    if not text_at:
        raise ValueError("it describes no streams")
    text = table[text_at : text_at + n_text].decode("utf-8")
    if "<!DOCTYPE" in text:
        raise ValueError("its XML declares entities, which no recorder does")
    root = ElementTree.fromstring(text)
    streams = {}
    for node in root.iterfind("./node[@name='outInfo']/node"):
        name, kind = node.get("name", ""), node.findtext("./attr[@key='typeIdentifier']") or ""
        if not _STREAM_NUMBER.fullmatch(name):
            raise ValueError(f"its stream {limits.describe(name)} has no number")
        info = {a.get("key", ""): a.text or "" for a in node.iterfind("./node[@name='info']/attr")}
        streams[int(name)] = kind, info
    return Aedat4Header(begin, None if end < begin else end, streams)


def _decompress(data: bytes) -> bytes:
    kind = {_LZ4_MAGIC: "lz4", _ZSTD_MAGIC: "zstd"}.get(data[:4])
    if kind is None:
        return data
    max_bytes = min(limits.MAX_CHUNK_BYTES, unpacking.unpacked_limit(len(data)))
    return unpacking.decompress(unpacking.new_decompressor(kind), data, max_bytes)
