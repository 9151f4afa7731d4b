"""The last seconds of every event camera's stream, and the stretch of it that belongs to a scan."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.data import Events
from lce_rig.rig import Rig
from lce_rig.sources.rig_time import rig_offset_ns, stream_of

BEFORE_NS = 1_200_000_000
"""Kept before a scan's first firing, for the network to settle ..."""
AFTER_NS = 150_000_000
"""... and after its last, for the board to be followed."""


@dataclass(frozen=True, eq=False)
class EventCut:
    """A stretch of one camera's stream; its parts share the stream's memory.

    Attributes:
        sensor: the camera.
        parts: every event with start_ns <= t < end_ns, in order of time.
        start_ns, end_ns: on the events' own clock.
        offset_ns: what brings their stamps to the rig's time.
        missing_ns: how much of the stretch's beginning lies before the stream; 0 where it is whole.
    """

    sensor: str
    parts: tuple[Events, ...]
    start_ns: int
    end_ns: int
    offset_ns: int
    missing_ns: int

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    def between(self, start_ns: int, end_ns: int) -> Events:
        """Cut out the events with start_ns <= t < end_ns, the events' own clock; the cut is not empty."""
        return join_events([part.between(start_ns, end_ns) for part in self.parts])

    def join(self) -> Events:
        """Put the parts together; the cut is not empty."""
        return join_events(self.parts)


class EventBuffer:
    """Holds packets of events, and hands out what lies around a scan without copying."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._packets: dict[str, list[Events]] = {}
        self._first_ns: dict[str, int] = {}
        self._offset_ns: dict[str, int] = {}

    def add(self, events: Events) -> None:
        """Take a camera's next packet, not empty."""
        camera = events.sensor
        if camera not in self._packets:
            self._packets[camera] = []
            self._offset_ns[camera] = rig_offset_ns(stream_of(events, self._rig), self._rig)
            self._first_ns[camera] = int(events.t_ns[0])
        self._packets[camera].append(events)

    def forget_before(self, time_ns: int) -> None:
        """Drop the packets that end before a time of the rig's clock."""
        for camera, packets in self._packets.items():
            own_ns = time_ns - self._offset_ns[camera]
            n_old = 0
            # The last packet stays, so that what the stream has passed is not forgotten.
            while n_old < len(packets) - 1 and packets[n_old].t_ns[-1] < own_ns:
                n_old += 1
            del packets[:n_old]

    def clear(self) -> None:
        """Forget everything: the clocks were set."""
        self._packets.clear()

    def has_passed(self, time_ns: int) -> bool:
        """Tell whether every stream heard of so far has reached a time of the rig's clock."""
        return all(
            packets[-1].t_ns[-1] + self._offset_ns[camera] >= time_ns
            for camera, packets in self._packets.items()
        )

    def cut(self, start_ns: int, end_ns: int) -> tuple[EventCut, ...]:
        """Cut start_ns <= t < end_ns, the rig's clock, out of every stream that has events in it."""
        cuts = []
        for camera, packets in sorted(self._packets.items()):
            offset_ns = self._offset_ns[camera]
            own_ns = start_ns - offset_ns, end_ns - offset_ns
            parts = tuple(_parts_between(packets, *own_ns))
            if parts:
                missing_ns = max(0, self._first_ns[camera] - own_ns[0])
                cuts.append(EventCut(camera, parts, *own_ns, offset_ns, missing_ns))
        return tuple(cuts)


def _parts_between(packets: list[Events], start_ns: int, end_ns: int) -> Iterator[Events]:
    """Cut packets in order of time; most lie wholly within or without, which their ends tell."""
    for packet in packets:
        first_ns, last_ns = packet.t_ns[0], packet.t_ns[-1]
        if start_ns <= first_ns and last_ns < end_ns:
            yield packet
        elif first_ns < end_ns and last_ns >= start_ns and len(part := packet.between(start_ns, end_ns)):
            yield part


def join_events(parts: list[Events] | tuple[Events, ...]) -> Events:
    """Put packets of one camera together, at least one; arrival at the host is not kept."""
    if len(parts) == 1:
        return replace(parts[0], host_ns=None)
    return replace(
        parts[0],
        t_ns=np.concatenate([part.t_ns for part in parts]),
        x=np.concatenate([part.x for part in parts]),
        y=np.concatenate([part.y for part in parts]),
        polarity=np.concatenate([part.polarity for part in parts]),
        host_ns=None,
    )
