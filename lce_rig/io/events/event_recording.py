"""A recording of events: checked, sorted by time, with a count of faults."""

from collections.abc import Generator, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.core.data import EventColumns, Events, join_events
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses
from lce_rig.io.events.stream import (
    NO_EVENTS,
    NS_PER_US,
    EventStream,
    KnowsItsLength,
    NoEventsError,
    damage,
    seconds_in,
    worded,
)

# Sorting a stream of events by time, with minimal memory.

# Recorders with several threads, and readout that is not in order, mix timestamps by this much at most.
REORDER_NS = 20_000_000
# Counters of 31 and 32 bits of microseconds are common; they wrap after 36 and 72 minutes.
_WRAPS_NS = {
    "recording.clock_wrapped_31": (1 << 31) * NS_PER_US,
    "recording.clock_wrapped_32": (1 << 32) * NS_PER_US,
}
# Eight months.
_MAX_WRAPS = 10_000
_MAX_GAP_NS = 60_000_000_000
# Within 20 ms, a hundred million per second: more than cameras send.
_MAX_HELD_EVENTS = 1 << 21
# Cameras may send a little before their clock is set at the start.
_MAX_LEAD_NS = 1_000_000_000
# More stray timestamps than this are not scattered damage but a clock that was set.
_MAX_STRAY_SHARE = 0.01
_MAX_DAMAGED_SHARE = 0.25


def in_time_order(path: Path, stretches: Iterator[EventColumns], losses: Losses) -> Iterator[EventColumns]:
    """Yield stretches whose timestamps never decrease, within and from one to the next.

    Timestamps mixed within 20 ms are sorted; counters that wrap are unwrapped; stray timestamps are skipped.

    Raises:
        SourceError: the timestamps run back for good; everything before has been yielded.
    """
    clock = _Clock(path)
    sorter = _Sorter(path, losses)
    for stretch in stretches:
        sound = _on_any_clock(stretch, losses)
        if len(sound):
            yield from sorter.push(clock.unwrap(sound, losses))
    if sorter.held is not None:
        yield sorter.held


def _on_any_clock(stretch: EventColumns, losses: Losses) -> EventColumns:
    """Leave out timestamps so far from zero that their differences overflow."""
    t_ns = stretch.t_ns
    limit = limits.MAX_TIME_NS
    if not len(t_ns) or (t_ns.min() > -limit and t_ns.max() < limit):
        return stretch
    is_sound = (t_ns > -limit) & (t_ns < limit)
    losses.add(damage("recording.events_beyond_clocks"), int(np.count_nonzero(~is_sound)))
    return stretch.select(is_sound)


class _Sorter:
    """Holds a range back until the next one shows that nothing earlier follows.

    Attributes:
        held: ordered events that have not been yielded.
    """

    def __init__(self, path: Path, losses: Losses) -> None:
        self.held: EventColumns | None = None
        self._path = path
        self._losses = losses
        self._first_ns = 0
        self._delivered_ns: int | None = None

    def push(self, current: EventColumns) -> Iterator[EventColumns]:
        """Take the next stretch and yield what is in order by now."""
        if self.held is None:
            together = current
            self._first_ns = self._first_ns if self._delivered_ns is not None else int(current.t_ns[0])
        elif int(current.t_ns.min()) >= self.held.t_ns[-1]:
            yield self.held
            self._delivered_ns, together = int(self.held.t_ns[-1]), current
        else:
            together = join_events([self.held, current])
        if _never_falls(together.t_ns):
            self.held = together
            return
        reset = _find_reset(together.t_ns)
        if reset is not None:
            together = yield from self._begin_anew(together, reset)
        mixed = self._tidied(together)
        cut = int(np.searchsorted(mixed.t_ns, mixed.t_ns[-1] - REORDER_NS)) if len(mixed) else 0
        if cut:
            yield mixed.select(slice(0, cut))
            self._delivered_ns = int(mixed.t_ns[cut - 1])
        self.held = mixed.select(slice(cut, None)) if cut < len(mixed) else None
        if len(mixed) - cut > _MAX_HELD_EVENTS:
            raise SourceError(
                f"{self._path}: {len(mixed) - cut} events within 20 ms, out of order", "It is damaged."
            )

    def _begin_anew(self, together: EventColumns, reset: int) -> Generator[EventColumns, None, EventColumns]:
        """Drop what came before the clock was set, if that is next to nothing; else yield it and give up."""
        before_ns, after_ns = int(together.t_ns[:reset].max()), int(together.t_ns[reset])
        back_s = (before_ns - after_ns) * 1e-9
        where = f"{seconds_in(before_ns, self._first_ns)} the timestamps decrease by {back_s:.3f} s"
        if self._delivered_ns is None and before_ns - self._first_ns < _MAX_LEAD_NS:
            self._losses.add(damage("recording.events_before_clock_set", where), reset)
            self._first_ns = after_ns
            return together.select(slice(reset, None))
        sound = self._tidied(together.select(slice(0, reset)))
        if len(sound):
            yield sound
        raise SourceError(
            f"{self._path}: {where} and do not recover",
            "The clock was set, or two recordings were joined: split the recording there.",
        )

    def _tidied(self, events: EventColumns) -> EventColumns:
        """Leave out stray timestamps and sort the others."""
        stray = _stray(events.t_ns)
        n_stray = int(np.count_nonzero(stray))
        if n_stray:
            where = seconds_in(int(events.t_ns[max(int(np.argmax(stray)) - 1, 0)]), self._first_ns)
            self._losses.add(damage("recording.events_stray", where), n_stray)
            events = events.select(~stray)
        if self._delivered_ns is not None:
            is_late = events.t_ns < self._delivered_ns
            self._losses.add(damage("recording.events_late"), int(np.count_nonzero(is_late)))
            events = events.select(~is_late)
        n_back = int(np.count_nonzero(np.diff(events.t_ns) < 0))
        if n_back:
            self._losses.add(damage("recording.events_sorted"), n_back)
            events = events.select(np.argsort(events.t_ns, kind="stable"))
        return events


class _Clock:
    """Counts the wraps of a counter of microseconds."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last_ns: int | None = None
        self._shift_ns = 0
        self._n_wraps = 0

    def unwrap(self, stretch: EventColumns, losses: Losses) -> EventColumns:
        """Undo the wraps of the next stretch.

        Raises:
            SourceError: it wraps more often than any recording is long.
        """
        raw = stretch.t_ns
        steps = np.diff(raw, prepend=raw[0] if self._last_ns is None else self._last_ns)
        self._last_ns = int(raw[-1])
        shifts = np.zeros(0, np.int64)
        if steps.min() < _MAX_GAP_NS - min(_WRAPS_NS.values()):
            shifts = np.zeros(len(raw), np.int64)
            for code, wrap_ns in _WRAPS_NS.items():
                wrapped = (steps < _MAX_GAP_NS - wrap_ns) & (steps >= -wrap_ns)
                shifts[wrapped] = wrap_ns
                n_wraps = int(np.count_nonzero(wrapped))
                self._n_wraps += n_wraps
                losses.add(damage(code), n_wraps)
            if self._n_wraps > _MAX_WRAPS:
                raise SourceError(
                    f"{self._path}: its clock wraps more than {_MAX_WRAPS} times", "It is damaged."
                )
            shifts = np.cumsum(shifts)
        if not len(shifts) and not self._shift_ns:
            return stretch
        t_ns = raw + self._shift_ns + (shifts if len(shifts) else 0)
        self._shift_ns += int(shifts[-1]) if len(shifts) else 0
        return EventColumns(t_ns, stretch.x, stretch.y, stretch.polarity, stretch.host_ns)


def _never_falls(t_ns: NDArray[np.int64]) -> bool:
    return bool(np.all(t_ns[1:] >= t_ns[:-1]))


def _stray(t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Find the timestamps that do not fit the others, (N,)."""
    late = np.maximum.accumulate(t_ns) - t_ns > REORDER_NS
    early = t_ns - np.minimum.accumulate(t_ns[::-1])[::-1] > REORDER_NS
    # A timestamp too far ahead makes all that follow look late, and the other way round: the the fewer are
    # stray.
    return min(late, early, key=np.count_nonzero)


def _find_reset(t_ns: NDArray[np.int64]) -> int | None:
    """Find where a clock was set back: that divides a stream; damage lies between continuous timestamps."""
    stray = _stray(t_ns)
    n_stray = int(np.count_nonzero(stray))
    is_between = not (stray[0] or stray[-1]) and n_stray <= _MAX_DAMAGED_SHARE * len(t_ns)
    if is_between or n_stray <= max(1, _MAX_STRAY_SHARE * len(t_ns)):
        return None
    return int(np.argmax(np.maximum.accumulate(t_ns) - t_ns > REORDER_NS))


# More events off the sensor than this are another sensor's; fewer are damage.
_MAX_OFF_SHARE = 0.01
_HOST_STRETCHES = 200


class EventRecording:
    """Events of one camera from one file or topic.

    Iterating yields stretches of `Events` from the beginning, in the order of time, and holds only a few of
    them in memory; it may be done again and again. `read` cuts out a window.

    Attributes:
        path: the file or folder.
        sensor: name of the camera.
        resolution_px: (width, height).
    """

    def __init__(
        self, path: Path, stream: EventStream, sensor: str, resolution_px: tuple[int, int] | None
    ) -> None:
        """Check the resolution, and that there are events.

        Args:
            path: the file or folder, for messages.
            stream: its reader.
            sensor: name of the camera.
            resolution_px: (width, height) of the profile; None takes the file's.

        Raises:
            NoEventsError: no events.
            SourceError: those of a camera of another resolution.
        """
        self.path = path
        self.sensor = sensor
        self._stream = stream
        self._losses = Losses()
        self._assumed: list[str] = []
        self._span_ns: tuple[int, int] | None = None
        if not any(len(stretch) for stretch in self._stretches(self._losses)):
            said = "; ".join(worded(self._losses))
            raise NoEventsError(f"{path} holds no events" + (f": {said}" if said else ""))
        self.resolution_px = self._settle_resolution(resolution_px)

    @property
    def notes(self) -> list[str]:
        """What was assumed, repaired or skipped so far, in words; grows while the recording is read."""
        found = self._assumed + worded(self._losses)
        return self._stream.notes + [f"{self.path.name}: {line}" for line in found]

    @property
    def start_ns(self) -> int:
        """First timestamp, device time; only the beginning is read."""
        first = next(iter(self), None)
        if first is None:
            raise self._unordered()
        return int(first.t_ns[0])

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last timestamp, device time; the first call reads the whole recording."""
        if self._span_ns is None:
            for _ in self:
                pass
        if self._span_ns is None:
            raise self._unordered()
        return self._span_ns

    def _unordered(self) -> SourceError:
        said = "; ".join(worded(self._losses))
        what = f"{self.path} holds no events that can be sorted by time"
        return SourceError(what + (f": {said}" if said else ""))

    def extent_ns(self) -> tuple[int, int]:
        """First and last timestamp; the last may be off by some ms where that saves reading the recording."""
        duration_ns = self._stream.duration_ns() if isinstance(self._stream, KnowsItsLength) else None
        if self._span_ns is not None or duration_ns is None:
            return self.span_ns
        start_ns = self.start_ns
        return start_ns, start_ns + duration_ns

    @property
    def duration_s(self) -> float:
        """From the first event to the last; the first call reads the whole recording."""
        first_ns, last_ns = self.span_ns
        return (last_ns - first_ns) * 1e-9

    def host_offset_ns(self) -> int | None:
        """Find what to add to device timestamps to come to the host's clock; None where arrivals are unknown.

        The least difference among the first packets: the one that waited least.
        """
        delays = [
            stretch.host_ns - int(stretch.t_ns[0])
            for stretch in islice(self, _HOST_STRETCHES)
            if stretch.host_ns is not None
        ]
        return min(delays, default=None)

    def __iter__(self) -> Iterator[Events]:
        """Yield the events from the beginning, in the order of time.

        Raises:
            SourceError: the timestamps run back for good, or events lie off the sensor.
        """
        losses = Losses()
        first_ns = last_ns = None
        try:
            for stretch in in_time_order(self.path, self._stretches(losses), losses):
                on_sensor = self._on_sensor(stretch, losses)
                if len(on_sensor):
                    first_ns = int(on_sensor.t_ns[0]) if first_ns is None else first_ns
                    last_ns = int(on_sensor.t_ns[-1])
                    yield self.to_events(on_sensor)
        finally:
            self._losses.keep_more(losses)
        if first_ns is not None and last_ns is not None:
            self._span_ns = first_ns, last_ns

    def read(self, start_ns: int, end_ns: int) -> Events:
        """Read the events with start_ns <= t < end_ns, device time; there may be none.

        Raises:
            SourceError: as iterating does.
        """
        parts = [self.to_events(NO_EVENTS)]
        for stretch in self:
            if stretch.t_ns[-1] >= start_ns:
                parts.append(stretch.between(start_ns, end_ns))
            if stretch.t_ns[-1] >= end_ns:
                break
        # Arrival is known of a stretch's first event, not of a window's.
        return replace(join_events(parts), host_ns=None)

    def _stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Read the stream; a disk that fails is an error the user can repair."""
        try:
            yield from self._stream.stretches(losses)
        except OSError as error:
            raise SourceError(f"{self.path} cannot be read: {error.strerror or error}") from None

    def to_events(self, columns: EventColumns) -> Events:
        """Say whose events they are."""
        return Events(
            self.sensor,
            columns.t_ns,
            columns.x,
            columns.y,
            columns.polarity,
            *self.resolution_px,
            columns.host_ns,
        )

    def _settle_resolution(self, profile_px: tuple[int, int] | None) -> tuple[int, int]:
        file_px = self._stream.resolution_px
        if profile_px and file_px and tuple(profile_px) != tuple(file_px):
            raise SourceError(
                f"{self.path}: its events are of a sensor of {_size(file_px)} pixels, "
                f"camera {self.sensor!r} has {_size(profile_px)}",
                "Give this camera's recording, or correct resolution_px in the profile.",
            )
        if file_px and file_px[0] * file_px[1] > limits.MAX_EVENT_PIXELS:
            raise SourceError(
                f"{self.path} declares a sensor of {_size(file_px)} pixels",
                "No event camera has so many pixels: the file is damaged.",
            )
        if profile_px or file_px:
            return profile_px or file_px or (0, 0)
        width = height = 0
        for stretch in self._stretches(Losses()):
            if len(stretch):
                width = max(width, int(stretch.x.max()) + 1)
                height = max(height, int(stretch.y.max()) + 1)
        if width * height > limits.MAX_EVENT_PIXELS:
            raise SourceError(
                f"{self.path} declares no resolution; its events reach column {width - 1}, row {height - 1}",
                "No event camera has so many pixels: the file is damaged.",
            )
        self._assumed.append(f"declares no resolution; {width}x{height}, the extent of its events, is used")
        return width, height

    def _on_sensor(self, stretch: EventColumns, losses: Losses) -> EventColumns:
        width, height = self.resolution_px
        right, bottom = int(stretch.x.max()), int(stretch.y.max())
        if right < width and bottom < height:
            return stretch
        is_on = (stretch.x < width) & (stretch.y < height)
        n_off = int(np.count_nonzero(~is_on))
        if n_off > max(1, _MAX_OFF_SHARE * len(stretch)):
            raise SourceError(
                f"{self.path}: {n_off} of {len(stretch)} events lie off the sensor, up to column {right}, "
                f"row {bottom}; camera {self.sensor!r} has {_size(self.resolution_px)} pixels",
                "Give this camera's recording, or correct resolution_px in the profile.",
            )
        losses.add(damage("recording.events_off_sensor", f"column {right}, row {bottom}"), n_off)
        return stretch.select(is_on)


def _size(resolution_px: tuple[int, int]) -> str:
    return f"{resolution_px[0]}x{resolution_px[1]}"
