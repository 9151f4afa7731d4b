"""The last seconds of every event camera's stream, and the stretch of it that belongs to a scan."""

from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.data import Events
from lce_rig.rig import Rig
from lce_rig.timing.rig_time import rig_offset_ns, stream_of

BEFORE_NS = 1_200_000_000
"""Kept before a scan's first firing, for the network to settle ..."""
AFTER_NS = 150_000_000
"""... and after its last, for the board to be followed."""

_LEAST_EVENTS = 1 << 16
# Factor of the buffered events: more room costs memory, less of it copies more often.
_ROOM = 1.5
# A clock that is fitted again while events come may move them back by microseconds.
_MAX_BACK_NS = 1_000_000


@dataclass(frozen=True, eq=False)
class EventCut:
    """A stretch of one camera's stream.

    Attributes:
        events: every event with start_ns <= t < end_ns, at least one; they share the stream's memory.
        start_ns, end_ns: on the events' own clock.
        offset_ns: what brings their timestamps to the rig's time.
        missing_ns: how much of the stretch's beginning lies before the stream; 0 where it is whole.
    """

    events: Events
    start_ns: int
    end_ns: int
    offset_ns: int
    missing_ns: int

    @property
    def sensor(self) -> str:
        """The camera."""
        return self.events.sensor

    def __len__(self) -> int:
        return len(self.events)


class EventBuffer:
    """Holds the events of every camera, and hands out what lies around a scan without copying."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._streams: dict[str, _Stream] = {}

    def add(self, events: Events) -> None:
        """Take a camera's next packet, not empty."""
        stream = self._streams.get(events.sensor)
        if stream is None:
            offset_ns = rig_offset_ns(stream_of(events, self._rig), self._rig)
            stream = self._streams[events.sensor] = _Stream(events, offset_ns)
        stream.add(events)

    def forget_before(self, time_ns: int) -> None:
        """Drop the events before a time of the rig's clock, but the last of each stream."""
        for stream in self._streams.values():
            stream.forget_before(time_ns - stream.offset_ns)

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
            own_ns = start_ns - stream.offset_ns, end_ns - stream.offset_ns
            events = stream.between(*own_ns)
            if len(events):
                missing_ns = max(0, stream.first_ns - own_ns[0])
                cuts.append(EventCut(events, *own_ns, stream.offset_ns, missing_ns))
        return tuple(cuts)


class _Stream:
    """One camera's events in columns that packets are appended to.

    A full block is left to the cuts that were taken of it, and a new one begun with what is still needed: no
    event of a cut is ever moved or overwritten.

    Attributes:
        offset_ns: what brings timestamps to the rig's time.
        first_ns: stamp of the first event of all.
        last_ns: of the last.
    """

    def __init__(self, first: Events, offset_ns: int) -> None:
        self.offset_ns = offset_ns
        self.first_ns = self.last_ns = int(first.t_ns[0])
        self._block = _block_like(first, 0)
        self._start = self._end = 0

    def add(self, events: Events) -> None:
        """Append a packet; a clock that was set back begins the stream again."""
        t_ns, first_ns = events.t_ns, int(events.t_ns[0])
        if first_ns < self.last_ns - _MAX_BACK_NS:
            self.first_ns, self._start = first_ns, self._end
        elif first_ns < self.last_ns:
            t_ns = np.maximum(t_ns, self.last_ns)
        if self._end + len(events) > len(self._block):
            self._begin_block(len(events))
        _write(self._block, self._end, replace(events, t_ns=t_ns))
        self._end += len(events)
        self.last_ns = int(t_ns[-1])

    def forget_before(self, time_ns: int) -> None:
        """Drop what comes before a timestamp, but the last event."""
        t_ns = self._block.t_ns[self._start : self._end]
        self._start += min(int(np.searchsorted(t_ns, time_ns)), len(t_ns) - 1)

    def between(self, start_ns: int, end_ns: int) -> Events:
        """Return the events with start_ns <= t < end_ns."""
        return self._held().between(start_ns, end_ns)

    def _held(self) -> Events:
        return self._block.select(slice(self._start, self._end))

    def _begin_block(self, n_more: int) -> None:
        held = self._held()
        self._block = _block_like(held, max(_LEAST_EVENTS, round(_ROOM * (len(held) + n_more))))
        _write(self._block, 0, held)
        self._start, self._end = 0, len(held)


def _block_like(events: Events, n: int) -> Events:
    """Make room for events of the same camera."""
    blank = (np.empty(n, np.int64), np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.bool_))
    return Events(events.sensor, *blank, events.width_px, events.height_px)


def _write(block: Events, start: int, events: Events) -> None:
    place = slice(start, start + len(events))
    block.t_ns[place], block.x[place], block.y[place] = events.t_ns, events.x, events.y
    block.polarity[place] = events.polarity
