"""The rig's time, common to all sensors, and frames: a scan with its images and events."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from lce_rig.core.data import Events, Image, Sample, Scan, Stream, join_events
from lce_rig.core.findings import Losses
from lce_rig.rig import Rig
from lce_rig.timing.findings import READ_NO_IMAGE_AT_SCAN, READ_NO_OTHER


def event_channel(rig: Rig, camera: str) -> str | None:
    """Return a camera's events channel; None without one."""
    return rig.cameras[camera].first_channel("events") if camera in rig.cameras else None


def stamp_of(sample: Sample) -> int | None:
    """Read a sample's timestamp, a packet's first, ns on the sensor's own clock; None without one."""
    if isinstance(sample, Events):
        return int(sample.t_ns[0]) if len(sample) else None
    return sample.stamp_ns


def stream_of(sample: Sample, rig: Rig) -> Stream:
    """Name the stream that a sample belongs to."""
    if isinstance(sample, Events):
        return Stream(sample.sensor, event_channel(rig, sample.sensor) or "", "events")
    if isinstance(sample, Image):
        return Stream(sample.sensor, sample.channel, "images")
    return Stream(sample.sensor, "", "scans")


def rig_offset_ns(stream: Stream, rig: Rig) -> int:
    """Return the profile's offset from a stream's timestamps to the rig's time."""
    if stream.kind == "scans":
        timestamps = rig.lidars[stream.sensor].timestamps
    else:
        timestamps = rig.cameras[stream.sensor].channels[stream.channel].timestamps
    return round(timestamps.expected_offset_s * 1e9)


def rig_time_ns(sample: Sample, rig: Rig) -> int | None:
    """Convert a sample's timestamp to the rig's time; None without a timestamp."""
    stamp_ns = stamp_of(sample)
    return None if stamp_ns is None else stamp_ns + rig_offset_ns(stream_of(sample, rig), rig)


BEFORE_NS = 1_200_000_000
"""Kept before a scan's first firing, for the network to settle ..."""
AFTER_NS = 150_000_000
"""... and after its last, for the board to be followed."""

# Largest step back of events that does not count as a restart: refitting a clock moves them by microseconds.
_MAX_BACK_NS = 1_000_000


@dataclass(frozen=True, eq=False)
class EventCut:
    """A range of one camera's stream.

    Attributes:
        packets: packets with its events, at least one event.
        start_ns, end_ns: bounds on the events' own clock.
        offset_ns: offset to add to its timestamps to get the rig's time.
        missing_ns: length of its beginning that lies before the stream; 0 if it is complete.
    """

    packets: tuple[Events, ...]
    start_ns: int
    end_ns: int
    offset_ns: int
    missing_ns: int

    @cached_property
    def events(self) -> Events:
        """Every event with start_ns <= t < end_ns; joined on first use, as most frames show no board."""
        # The arrival time is known for a packet's first event only.
        return replace(join_events(self.packets).between(self.start_ns, self.end_ns), host_ns=None)

    @property
    def last_ns(self) -> int:
        """The rig's time of its last event or, where packets reach further, of its end."""
        return min(int(self.packets[-1].t_ns[-1]), self.end_ns) + self.offset_ns

    @property
    def sensor(self) -> str:
        """The camera."""
        return self.packets[0].sensor

    def between(self, start_ns: int, end_ns: int) -> "EventCut | None":
        """Narrow it to start_ns <= t < end_ns, the rig's time; None without an event."""
        start_ns = max(start_ns - self.offset_ns, self.start_ns)
        end_ns = min(end_ns - self.offset_ns, self.end_ns)
        packets = _packets_between(self.packets, start_ns, end_ns)
        if not packets:
            return None
        return replace(self, packets=packets, start_ns=start_ns, end_ns=end_ns, missing_ns=0)

    def __len__(self) -> int:
        return len(self.events)


class EventBuffer:
    """Holds the packets of every event camera, and returns those around a scan without copying."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._streams: dict[str, _Stream] = {}

    def add(self, events: Events) -> None:
        """Take a camera's next packet, not empty; the stream restarts if its clock was set back."""
        first_ns, stream = int(events.t_ns[0]), self._streams.get(events.sensor)
        if stream is None or first_ns < stream.last_ns - _MAX_BACK_NS:
            offset_ns = rig_offset_ns(stream_of(events, self._rig), self._rig)
            stream = self._streams[events.sensor] = _Stream(offset_ns, first_ns)
        if first_ns < stream.last_ns:
            events = replace(events, t_ns=np.maximum(events.t_ns, stream.last_ns))
        stream.packets.append(events)
        stream.last_ns = int(events.t_ns[-1])

    def forget_before(self, time_ns: int) -> None:
        """Drop the packets before a time of the rig's clock, except the last of each stream."""
        for stream in self._streams.values():
            packets, until_ns = stream.packets, time_ns - stream.offset_ns
            while len(packets) > 1 and packets[0].t_ns[-1] < until_ns:
                packets.popleft()

    def clear(self) -> None:
        """Discard everything after a clock change."""
        self._streams.clear()

    def has_passed(self, time_ns: int) -> bool:
        """Check whether every stream heard of so far has reached a time of the rig's clock."""
        return all(stream.last_ns + stream.offset_ns >= time_ns for stream in self._streams.values())

    def cut(self, start_ns: int, end_ns: int) -> tuple[EventCut, ...]:
        """Cut start_ns <= t < end_ns, the rig's clock, out of every stream that has events in it."""
        cuts = []
        for _, stream in sorted(self._streams.items()):
            first_ns, end = start_ns - stream.offset_ns, end_ns - stream.offset_ns
            if packets := _packets_between(stream.packets, first_ns, end):
                missing_ns = max(0, stream.first_ns - first_ns)
                cuts.append(EventCut(packets, first_ns, end, stream.offset_ns, missing_ns))
        return tuple(cuts)


def _packets_between(packets: Iterable[Events], start_ns: int, end_ns: int) -> tuple[Events, ...]:
    """Return the packets that reach into start_ns <= t < end_ns; none without an event in it."""
    near = tuple(p for p in packets if p.t_ns[-1] >= start_ns and p.t_ns[0] < end_ns)
    return near if any(len(packet.between(start_ns, end_ns)) for packet in near) else ()


class _Stream:
    """One camera's packets.

    Attributes:
        offset_ns: offset to add to timestamps to get the rig's time.
        first_ns, last_ns: timestamps of the first event of all and of the last.
    """

    def __init__(self, offset_ns: int, first_ns: int) -> None:
        self.offset_ns = offset_ns
        self.first_ns = self.last_ns = first_ns
        self.packets: deque[Events] = deque()


PATIENCE_NS = 1_000_000_000
#: Time for which events are kept for scans, which in a bag may be up to two seconds late.
IN_BAGS_NS, LIVE_NS = 3 * PATIENCE_NS, 3 * PATIENCE_NS // 2
_Buffers: TypeAlias = dict[tuple[str, str], deque[tuple[int, Image | Scan]]]


@dataclass(frozen=True, eq=False)
class Frame:
    """The samples of all sensors at one time.

    Attributes:
        time_ns: middle of the first LiDAR's scan, or of a rig without LiDARs the first camera's image; rig
            time (timestamps plus the profile's expected offsets).
        images: the image of each camera channel that has one within the tolerance.
        scans: the scan of the first LiDAR, if there is one, and of each other with one within the tolerance.
        events: events of each event camera, from 1.2 s before the first scan's first firing to 0.15 s after
            its last.
    """

    time_ns: int
    images: tuple[Image, ...]
    scans: tuple[Scan, ...]
    events: tuple[EventCut, ...] = ()


def pair_by_time(
    samples: Iterable[Sample],
    rig: Rig,
    losses: Losses,
    events_wait_ns: int = IN_BAGS_NS,
    *,
    are_events_enough: bool = False,
) -> Iterator[Frame]:
    """Yield each scan of the first LiDAR heard with the nearest image of each camera channel and its events.

    For a rig without cameras, yield each with the nearest scans of other LiDARs; without LiDARs, each image
    of the first camera with the nearest ones of others.

    Samples come in order of receipt: a scan waits until every other sensor has passed its time, or for a
    second. If clocks are set back, waiting samples are dropped.

    Args:
        samples: images, scans and packets of events; each sensor's timestamps rise.
            rig: the profile, with time offsets and the tolerance of pairs.
            losses: counts the scans without an image within the tolerance, with the least time difference.
            events_wait_ns: time for which events are kept for scans that wait or come late.
            are_events_enough: whether a scan with events but without an image is a frame, too.
    """
    pairing = _Pairing(rig, losses, BEFORE_NS + AFTER_NS + events_wait_ns, are_events_enough)
    for sample in samples:
        pairing.take(sample)
        yield from pairing.due_frames()
    yield from pairing.remaining_frames()


class _Pairing:
    """Waiting samples of the first sensor, and recent samples of the others."""

    def __init__(self, rig: Rig, losses: Losses, kept_ns: int, are_events_enough: bool) -> None:
        self._rig = rig
        self._are_events_enough = are_events_enough
        self._losses = losses
        self._kept_ns = kept_ns
        self._nearest_ns: int | None = None
        self._waiting: deque[tuple[int, int, Image | Scan]] = deque()
        self._buffers: _Buffers = {}
        self._events = EventBuffer(rig)
        self._kind: type[Image | Scan] = Scan if rig.lidars else Image
        self._anchor: tuple[str, str] | None = None
        # Latest time of images and scans, and of all samples.
        self._newest_ns = self._position_ns = -(2**62)

    def take(self, sample: Sample) -> None:
        """Add a sample to the waiting ones or to its sensor's buffer."""
        time_ns = rig_time_ns(sample, self._rig)
        if time_ns is None:
            return
        if isinstance(sample, Events):
            self._events.add(sample)
        else:
            # Computed once per scan: samples come hundreds of times as often.
            half_ns = _half_sweep_ns(sample, self._rig) if isinstance(sample, Scan) else 0
            time_ns += half_ns
            if time_ns < self._newest_ns - 2 * PATIENCE_NS:
                self._waiting.clear()
                self._buffers.clear()
                self._events.clear()
                self._newest_ns = self._position_ns = time_ns
            self._newest_ns = max(self._newest_ns, time_ns)
            key = (sample.sensor, sample.channel if isinstance(sample, Image) else "")
            if isinstance(sample, self._kind) and key == (self._anchor or key):
                self._anchor = key
                self._waiting.append((time_ns, half_ns, sample))
            else:
                buffer = self._buffers.setdefault(key, deque())
                buffer.append((time_ns, sample))
                # Drop old samples of a recording whose scans come later, or never.
                while buffer[0][0] < time_ns - self._kept_ns:
                    buffer.popleft()
        self._position_ns = max(self._position_ns, time_ns)
        self._events.forget_before(self._position_ns - self._kept_ns)

    def due_frames(self) -> Iterator[Frame]:
        """Yield the frames that no further sample can change."""
        while self._waiting:
            time_ns, half_ns, _ = self._waiting[0]
            have_passed = all(buffer and buffer[-1][0] >= time_ns for buffer in self._buffers.values())
            is_complete = bool(self._buffers) and have_passed
            is_complete = is_complete and self._events.has_passed(time_ns + half_ns + AFTER_NS)
            if not is_complete and self._position_ns <= time_ns + PATIENCE_NS:
                return
            yield from self._frame(*self._waiting.popleft())

    def remaining_frames(self) -> Iterator[Frame]:
        """Yield the frames still waiting at the end of the streams."""
        while self._waiting:
            yield from self._frame(*self._waiting.popleft())

    def _frame(self, time_ns: int, half_ns: int, anchor: Image | Scan) -> Iterator[Frame]:
        images = [anchor] if isinstance(anchor, Image) else []
        scans = [anchor] if isinstance(anchor, Scan) else []
        nearest_ns: int | None = None
        for key in sorted(self._buffers):
            buffer = self._buffers[key]
            # Samples before the nearest one cannot be nearest to any later scan.
            while len(buffer) > 1 and abs(buffer[1][0] - time_ns) <= abs(buffer[0][0] - time_ns):
                buffer.popleft()
            if not buffer:
                continue
            apart_ns, sample = abs(buffer[0][0] - time_ns), buffer[0][1]
            if isinstance(sample, Image):
                nearest_ns = apart_ns if nearest_ns is None else min(apart_ns, nearest_ns)
            if apart_ns > tolerance_ns(sample, anchor, self._rig):
                continue
            if isinstance(sample, Image):
                images.append(sample)
            else:
                scans.append(sample)
        events: tuple[EventCut, ...] = ()
        if images or self._are_events_enough:
            events = self._events.cut(time_ns - half_ns - BEFORE_NS, time_ns + half_ns + AFTER_NS)
        is_of_one_kind = not self._rig.cameras or not self._rig.lidars
        if len(scans) + len(images) > 1 or (events and not is_of_one_kind):
            yield Frame(time_ns, tuple(images), tuple(scans), events)
        elif is_of_one_kind:
            self._losses.add(READ_NO_OTHER.refusal())
        else:
            is_best = nearest_ns is not None and nearest_ns < (self._nearest_ns or 2**62)
            nearest_s = None if nearest_ns is None else nearest_ns * 1e-9
            self._nearest_ns = nearest_ns if is_best else self._nearest_ns
            self._losses.add(READ_NO_IMAGE_AT_SCAN.refusal(nearest_s=nearest_s), is_best=is_best)


def middle_of_sweep_ns(scan: Scan, rig: Rig) -> int | None:
    """Find the rig's time at the middle of a scan; None without a timestamp."""
    time_ns = rig_time_ns(scan, rig)
    return None if time_ns is None else time_ns + _half_sweep_ns(scan, rig)


def _half_sweep_ns(scan: Scan, rig: Rig) -> int:
    if scan.offset_ns is None or not len(scan.offset_ns):
        return round(0.5e9 / rig.lidars[scan.sensor].rate_hz)
    return int(scan.offset_ns.max()) // 2


def tolerance_ns(one: Image | Scan, other: Image | Scan, rig: Rig) -> float:
    """Return how far two samples of one moment may lie apart, by the wider tolerance of their streams."""
    tolerances_s = [
        rig.cameras[each.sensor].channels[each.channel].timestamps.tolerance_s
        if isinstance(each, Image)
        else rig.lidars[each.sensor].timestamps.tolerance_s
        for each in (one, other)
    ]
    return max(tolerances_s) * 1e9
