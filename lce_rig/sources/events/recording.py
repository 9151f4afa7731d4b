"""A recording of events: checked, sorted by time, with a count of faults."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from lce_rig.core import limits
from lce_rig.core.data import Events
from lce_rig.core.errors import SourceError
from lce_rig.sources.events.order import in_time_order
from lce_rig.sources.events.stream import (
    NO_EVENTS,
    EventColumns,
    EventStream,
    Findings,
    KnowsItsLength,
    NoEventsError,
    join,
)

# More events off the sensor than this are another sensor's; fewer are damage.
_MAX_OFF_SHARE = 0.01
_HOST_STRETCHES = 200


class EventRecording:
    """Events of one camera from one file or topic.

    Iterating yields stretches of `Events` from the beginning, in the order of time, and holds only a few of
    them in memory; it may be done again and again. `read` cuts out windows; windows that go forward in time
    are read in one pass through the file.

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
        self._findings = Findings()
        self._assumed: list[str] = []
        self._span_ns: tuple[int, int] | None = None
        self._window = _Window(self)
        if not any(len(stretch) for stretch in self._stretches(self._findings)):
            said = "; ".join(self._findings.lines())
            raise NoEventsError(f"{path} holds no events" + (f": {said}" if said else ""))
        self.resolution_px = self._settle_resolution(resolution_px)

    @property
    def notes(self) -> list[str]:
        """What was assumed, repaired or skipped so far, in words; grows while the recording is read."""
        found = self._assumed + self._findings.lines()
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
        said = "; ".join(self._findings.lines())
        what = f"{self.path} holds no events that could be put in order"
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
        findings = Findings()
        first_ns = last_ns = None
        try:
            for stretch in in_time_order(self.path, self._stretches(findings), findings):
                on_sensor = self._on_sensor(stretch, findings)
                if len(on_sensor):
                    first_ns = int(on_sensor.t_ns[0]) if first_ns is None else first_ns
                    last_ns = int(on_sensor.t_ns[-1])
                    yield self.to_events(on_sensor)
        finally:
            self._findings.merge(findings)
        if first_ns is not None and last_ns is not None:
            self._span_ns = first_ns, last_ns

    def read(self, start_ns: int, end_ns: int) -> Events:
        """Read the events with start_ns <= t < end_ns, device time; there may be none.

        Raises:
            SourceError: as iterating does.
        """
        return self._window.read(start_ns, end_ns)

    def _stretches(self, findings: Findings) -> Iterator[EventColumns]:
        """Read the stream; a disk that fails is an error the user can repair."""
        try:
            yield from self._stream.stretches(findings)
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
                "Is it another camera's recording? Else correct resolution_px in the profile.",
            )
        if file_px and file_px[0] * file_px[1] > limits.MAX_EVENT_PIXELS:
            raise SourceError(
                f"{self.path} declares a sensor of {_size(file_px)} pixels",
                "No event camera has so many pixels: the file is damaged.",
            )
        if profile_px or file_px:
            return profile_px or file_px or (0, 0)
        width = height = 0
        for stretch in self._stretches(Findings()):
            if len(stretch):
                width = max(width, int(stretch.x.max()) + 1)
                height = max(height, int(stretch.y.max()) + 1)
        if width * height > limits.MAX_EVENT_PIXELS:
            raise SourceError(
                f"{self.path} declares no resolution; its events reach column {width - 1}, row {height - 1}",
                "No event camera has so many pixels: the file is damaged.",
            )
        self._assumed.append(f"declares no resolution; {width}x{height}, the extent of its events, is taken")
        return width, height

    def _on_sensor(self, stretch: EventColumns, findings: Findings) -> EventColumns:
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
                "Is it another camera's recording? Else correct resolution_px in the profile.",
            )
        findings.add("events off the sensor left out", f"column {right}, row {bottom}", n_off)
        return stretch.select(is_on)


class _Window:
    """The ranges of the last window, and the pass through the recording that continues there."""

    def __init__(self, recording: EventRecording) -> None:
        self._recording = recording
        self._rest: Iterator[Events] = iter(())
        self._kept: list[Events] = []
        self._from_ns: int | None = None

    def read(self, start_ns: int, end_ns: int) -> Events:
        if self._from_ns is None or start_ns < self._from_ns:
            self._rest, self._kept = iter(self._recording), []
        self._from_ns = start_ns
        self._kept = [stretch for stretch in self._kept if stretch.t_ns[-1] >= start_ns]
        while not self._kept or self._kept[-1].t_ns[-1] < end_ns:
            stretch = next(self._rest, None)
            if stretch is None:
                break
            if stretch.t_ns[-1] >= start_ns:
                self._kept.append(stretch)
        return self._join([stretch.between(start_ns, end_ns) for stretch in self._kept])

    def _join(self, parts: list[Events]) -> Events:
        # Arrival is known of a stretch's first event, not of a window's.
        columns = [EventColumns(p.t_ns, p.x, p.y, p.polarity) for p in parts if len(p)]
        return self._recording.to_events(join(columns or [NO_EVENTS]))


def _size(resolution_px: tuple[int, int]) -> str:
    return f"{resolution_px[0]}x{resolution_px[1]}"
