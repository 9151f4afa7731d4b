"""Writing AEDAT4 files of events that DV and dv-processing open, without their library.

dv-processing takes events one by one, at a microsecond each; the flatbuffers are few and fixed, so they are
laid out by hand. Until it is closed the file carries no table, as after a crash, and is readable as it is.

References:
    https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-4.0.html
    https://flatbuffers.dev/internals/
"""

import struct
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO
from xml.sax.saxutils import escape

import numpy as np

from lce_rig.core.data import Events
from lce_rig.io.events.aedat4 import EVENT, MAGIC
from lce_rig.io.events.stream import NS_PER_US

# DV's own packets hold 10 ms; smaller ones are read slowly, larger ones late.
_PACKET_EVENTS = 1 << 13
_LZ4 = 1
_END_AT = len(MAGIC) + 32
_NOT_CLOSED = -1
# Where a table lies in its buffer fixes every field: positions count from the buffer's size prefix.
_RECORD = np.dtype(
    {
        "names": ["vtable", "to_vtable", "stream", "size", "at", "n", "start_us", "end_us"],
        "formats": ["(7,)<u2", "<i4", "<i4", "<i4", "<i8", "<i8", "<i8", "<i8"],
        "offsets": [6, 20, 24, 28, 32, 40, 48, 56],
        "itemsize": 64,
    }
)
_RECORD_VTABLE = (14, 44, 12, 4, 20, 28, 36)
_XML = """<dv version="2.0">
 <node name="outInfo" path="/mainloop/Recorder/outInfo/">
  <node name="0" path="/mainloop/Recorder/outInfo/0/">
   <attr key="compression" type="string">LZ4</attr>
   <attr key="originalModuleName" type="string">lce-rig</attr>
   <attr key="originalOutputName" type="string">events</attr>
   <attr key="typeDescription" type="string">Array of events (polarity ON/OFF).</attr>
   <attr key="typeIdentifier" type="string">EVTS</attr>
   <node name="info" path="/mainloop/Recorder/outInfo/0/info/">
    <attr key="sizeX" type="int">{width}</attr>
    <attr key="sizeY" type="int">{height}</attr>
    <attr key="source" type="string">{camera}</attr>
    <attr key="tsOffset" type="long">0</attr>
   </node>
  </node>
 </node>
</dv>
"""


class Aedat4Writer:
    """An AEDAT4 file with one stream of events; a context manager.

    Raises:
        FileExistsError: the file is there already.
    """

    def __init__(self, path: Path, resolution_px: tuple[int, int], camera_name: str = "lce_rig") -> None:
        self._file: BinaryIO = path.open("xb")
        self._resolution_px = resolution_px
        self._records: list[tuple[int, int, int, int, int]] = []
        width, height = resolution_px
        text = _XML.format(width=width, height=height, camera=escape(camera_name)).encode()
        self._file.write(MAGIC + _header(text))

    def write(self, events: Events) -> None:
        """Append events, which follow those written before in time.

        Raises:
            ValueError: they are of another resolution.
        """
        if (events.width_px, events.height_px) != self._resolution_px:
            size = f"{events.width_px}x{events.height_px}"
            raise ValueError(f"events of {size} pixels for a file of {self._resolution_px}")
        from lz4.frame import compress  # type: ignore[import-untyped]

        for begin in range(0, len(events), _PACKET_EVENTS):
            cut = slice(begin, begin + _PACKET_EVENTS)
            raw = np.zeros(len(events.t_ns[cut]), EVENT)
            raw["t"] = events.t_ns[cut] // NS_PER_US
            raw["x"], raw["y"], raw["on"] = events.x[cut], events.y[cut], events.polarity[cut]
            data = compress(_packet(raw.tobytes(), len(raw)))
            self._file.write(struct.pack("<ii", 0, len(data)))
            self._records.append(
                (len(data), self._file.tell(), len(raw), int(raw["t"][0]), int(raw["t"][-1]))
            )
            self._file.write(data)

    def close(self) -> None:
        """Write the table of packets and say where it is; the file is closed even where the disk is full."""
        if self._file.closed:
            return
        from lz4.frame import compress

        with self._file as file:
            end = file.tell()
            file.write(compress(_table(self._records)))
            file.seek(_END_AT)
            file.write(struct.pack("<q", end))

    def __enter__(self) -> "Aedat4Writer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        with suppress(OSError):
            self.close()


def write_aedat4(path: Path, stretches: Iterable[Events], camera_name: str = "lce_rig") -> None:
    """Write a recording of events, at least one stretch, as AEDAT4; timestamps are cut to microseconds.

    Raises:
        FileExistsError: the file is there already.
        ValueError: no stretch, or some of different resolutions.
    """
    iterator = iter(stretches)
    first = next(iterator, None)
    if first is None:
        raise ValueError("no events to write")
    with Aedat4Writer(path, (first.width_px, first.height_px), camera_name) as writer:
        writer.write(first)
        for stretch in iterator:
            writer.write(stretch)


def _sized(body: bytes) -> bytes:
    return struct.pack("<I", len(body)) + body


def _header(text: bytes) -> bytes:
    """Lay out IOHeader {compression, dataTablePosition, infoNode}."""
    vtable = struct.pack("<5H2x", 10, 20, 16, 8, 4)
    table = struct.pack("<iIqi", 12, 16, _NOT_CLOSED, _LZ4)
    return _sized(struct.pack("<I4s", 20, b"IOHE") + vtable + table + _sized(text) + b"\0")


def _list(identifier: bytes, n: int) -> bytes:
    """Lay out a table whose only field is a vector of n, up to the vector's first element."""
    return struct.pack("<I4s2x3HiII", 16, identifier, 6, 8, 4, 6, 4, n)


def _packet(events: bytes, n: int) -> bytes:
    """Lay out EventPacket {elements}."""
    return _sized(_list(b"EVTS", n) + events)


def _table(records: list[tuple[int, int, int, int, int]]) -> bytes:
    """Lay out FileDataTable {[ByteOffset, PacketInfo, NumElements, TimestampStart, TimestampEnd]}."""
    filled = np.zeros(len(records), _RECORD)
    filled["vtable"], filled["to_vtable"] = _RECORD_VTABLE, _RECORD_VTABLE[0]
    columns = zip(*records, strict=True) if records else ((),) * 5
    for name, column in zip(("size", "at", "n", "start_us", "end_us"), columns, strict=True):
        filled[name] = column
    head = _list(b"FTAB", len(records))
    entries_at = 4 + len(head)
    records_at = -(-(entries_at + 4 * len(records)) // 8) * 8
    index = np.arange(len(records))
    offsets = records_at + _RECORD.itemsize * index + 20 - (entries_at + 4 * index)
    padding = bytes(records_at - entries_at - 4 * len(records))
    return _sized(head + offsets.astype("<u4").tobytes() + padding + filled.tobytes())
