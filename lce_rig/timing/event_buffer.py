"""The last seconds of every event camera's stream, and the stretch of it that belongs to a scan."""

from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lce_rig.core.data import Events, join_events
from lce_rig.rig import Rig
from lce_rig.timing.rig_time import rig_offset_ns, stream_of

BEFORE_NS = 1_200_000_000
"""Kept before a scan's first firing, for the network to settle ..."""
AFTER_NS = 150_000_000
"""... and after its last, for the board to be followed."""

# A clock that is fitted again while events come may move them back by microseconds.
_MAX_BACK_NS = 1_000_000


@dataclass(frozen=True, eq=False)
class EventCut:
    """A stretch of one camera's stream.

    Attributes:
        packets: those with its events, at least one event.
        start_ns, end_ns: on the events' own clock.
        offset_ns: what brings their timestamps to the rig's time.
        missing_ns: how much of the stretch's beginning lies before the stream; 0 where it is whole.
    """

    packets: tuple[Events, ...]
    start_ns: int
    end_ns: int
    offset_ns: int
    missing_ns: int

    @cached_property
    def events(self) -> Events:
        """Every event with start_ns <= t < end_ns; joined only when wanted, as most frames show no board."""
        # Arrival is known of a packet's first event, not of a stretch's.
        return replace(join_events(self.packets).between(self.start_ns, self.end_ns), host_ns=None)

    @property
    def sensor(self) -> str:
        """The camera."""
        return self.packets[0].sensor

    def __len__(self) -> int:
        return len(self.events)


class EventBuffer:
    """Holds the packets of every event camera, and hands out those around a scan without copying."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._streams: dict[str, _Stream] = {}

    def add(self, events: Events) -> None:
        """Take a camera's next packet, not empty; a clock that was set back begins its stream again."""
        first_ns, stream = int(events.t_ns[0]), self._streams.get(events.sensor)
        if stream is None or first_ns < stream.last_ns - _MAX_BACK_NS:
            offset_ns = rig_offset_ns(stream_of(events, self._rig), self._rig)
            stream = self._streams[events.sensor] = _Stream(offset_ns, first_ns)
        if first_ns < stream.last_ns:
            events = replace(events, t_ns=np.maximum(events.t_ns, stream.last_ns))
        stream.packets.append(events)
        stream.last_ns = int(events.t_ns[-1])

    def forget_before(self, time_ns: int) -> None:
        """Drop the packets before a time of the rig's clock, but the last of each stream."""
        for stream in self._streams.values():
            packets, until_ns = stream.packets, time_ns - stream.offset_ns
            while len(packets) > 1 and packets[0].t_ns[-1] < until_ns:
                packets.popleft()

    def clear(self) -> None:
        """Forget everything: the clocks were set."""
        self._streams.clear()

    def has_passed(self, time_ns: int) -> bool:
        """Check whether every stream heard of so far has reached a time of the rig's clock."""
        return all(stream.last_ns + stream.offset_ns >= time_ns for stream in self._streams.values())

    def cut(self, start_ns: int, end_ns: int) -> tuple[EventCut, ...]:
        """Cut start_ns <= t < end_ns, the rig's clock, out of every stream that has events in it."""
        cuts = []
        for _, stream in sorted(self._streams.items()):
            first_ns, end = start_ns - stream.offset_ns, end_ns - stream.offset_ns
            packets = tuple(p for p in stream.packets if p.t_ns[-1] >= first_ns and p.t_ns[0] < end)
            if any(len(packet.between(first_ns, end)) for packet in packets):
                missing_ns = max(0, stream.first_ns - first_ns)
                cuts.append(EventCut(packets, first_ns, end, stream.offset_ns, missing_ns))
        return tuple(cuts)


class _Stream:
    """One camera's packets.

    Attributes:
        offset_ns: what brings timestamps to the rig's time.
        first_ns, last_ns: timestamps of the first event of all and of the last.
    """

    def __init__(self, offset_ns: int, first_ns: int) -> None:
        self.offset_ns = offset_ns
        self.first_ns = self.last_ns = first_ns
        self.packets: deque[Events] = deque()
