"""Events of iniVation's AEDAT4 files, read without iniVation's library."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lce_rig.recordings.events.aedat4_file import MAGIC, Aedat4File, add_broken, read_header, vector_at
from lce_rig.recordings.events.stream import (
    DamageCounts,
    EventColumns,
    NoEventsError,
    join_small,
    parse_size,
    to_ns,
)

__all__ = ["EVENT", "MAGIC", "Aedat4Events", "read_header"]

EVENT = np.dtype({"names": ["t", "x", "y", "on"], "formats": ["<i8", "<i2", "<i2", "?"], "itemsize": 16})
_STRETCH_EVENTS = 1 << 16


class Aedat4Events:
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
            kinds = ", ".join(kind for kind, _ in self._file.header.streams.values()) or "none"
            raise NoEventsError(f"{path} holds no stream of events; its streams: {kinds}")
        self._number = number
        self.notes = self._file.notes
        _, attributes = self._file.header.streams[number]
        self.resolution_px = parse_size(attributes.get("sizeX", ""), attributes.get("sizeY", ""))

    def stretches(self, findings: DamageCounts) -> Iterator[EventColumns]:
        """Yield the events, some packets at a time."""
        yield from join_small(self._packets(findings), _STRETCH_EVENTS)

    def duration_ns(self) -> int | None:
        """Compare the first packet with the last; None where they are damaged."""
        table = self._file.last_packet(self._number)
        try:
            last = None if table is None else _decode_packet(table)
        except Exception:  # As below.
            return None
        first = next((packet for packet in self._packets(DamageCounts()) if len(packet)), None)
        return int(last.t_ns[-1]) - int(first.t_ns[0]) if first is not None and last else None

    def _packets(self, findings: DamageCounts) -> Iterator[EventColumns]:
        for where, table in self._file.packets(self._number, findings):
            try:
                events = _decode_packet(table)
            except Exception as error:  # A damaged packet fails in any way: struct, sizes.
                add_broken(findings, where, error)
                continue
            yield events


def _decode_packet(table: bytes) -> EventColumns:
    """Decode one packet of events.

    Raises:
        ValueError: it holds no events.
    """
    if table[4:8] != b"EVTS":
        raise ValueError(f"it holds {bytes(table[4:8])!r}, not events")
    at, n_events = vector_at(table, 0)
    events = np.frombuffer(table, EVENT, n_events, at) if n_events else np.empty(0, EVENT)
    x, y = events["x"].astype(np.uint16), events["y"].astype(np.uint16)
    return EventColumns(to_ns(events["t"]), x, y, events["on"].view(np.uint8) != 0)
