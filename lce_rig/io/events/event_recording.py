"""A recording of events, checked and sorted by time, with counted faults; the interface of its readers."""

import re
from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import MAX_TIME_NS, EventColumns, Events, join_events
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Losses
from lce_rig.io import findings
from lce_rig.io.findings import worded
from lce_rig.timing.clock import SINCE_1970_NS

NS_PER_US = 1000
MAX_EVENT_PIXELS = 1 << 22
"""Maximum pixels of one event camera: four times the largest on sale; a damaged file may declare more."""
# Maximum disorder of timestamps from multi-threaded recorders and out-of-order readout, ns.
REORDER_NS = 20_000_000
# Larger jumps count as a clock change, not as damaged timestamps, ns.
_CLOCK_SET_NS = 1_000_000_000
# Maximum fraction of events outside the sensor that counts as damage; more are another sensor's.
_MAX_OFF_SHARE = 0.01
_HOST_STRETCHES = 200


class NoEventsError(SourceError):
    """A valid recording without any events."""


NO_EVENTS = EventColumns(
    np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.bool_)
)


class EventStream:
    """One file or topic of events.

    Attributes:
        resolution_px: (width, height) declared by the file, or None.
        notes: choices and assumptions made on opening, in words.
        serial: the camera's serial number, or "".
    """

    resolution_px: tuple[int, int] | None
    notes: list[str]
    serial: str = ""

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events from the beginning, in file order; may be called repeatedly.

        Raises:
            SourceError: nothing more can be read for a reason the user can repair.
        """
        raise NotImplementedError


def parse_size(width: str, height: str) -> tuple[int, int] | None:
    """Read a resolution (px) from a file's text; None if implausible."""
    # No sensor has more than five digits of pixels, and int() takes quadratic time.
    if not all(re.fullmatch("[0-9]{1,5}", text) for text in (width, height)):
        return None
    size = int(width), int(height)
    return size if 0 < size[0] * size[1] <= MAX_EVENT_PIXELS else None


def to_ns(times_us: NDArray[Any], offset_us: int = 0) -> NDArray[np.int64]:
    """Convert whole microseconds; implausible times become MAX_TIME_NS, which `in_time_order` skips.

    Args:
        times_us: (N,) integers of any type, or finite numbers.
        offset_us: added to each.
    """
    limit_us = MAX_TIME_NS // NS_PER_US
    is_time = (times_us > -limit_us - offset_us) & (times_us < limit_us - offset_us)
    t_us = np.where(is_time, times_us, 0).astype(np.int64)
    return np.where(is_time, (t_us + offset_us) * NS_PER_US, MAX_TIME_NS)


class EventRecording:
    """Events of one camera from one file or topic.

    Iterating yields stretches of `Events` from the beginning, in order of time, with only a few of them in
    memory; it can be repeated. Timestamps are the sensor's own.

    Attributes:
        path: the file or folder.
        sensor: name of the camera.
        resolution_px: (width, height).
        serial: the camera's serial number, or "".
    """

    def __init__(
        self, path: Path, stream: EventStream, sensor: str, resolution_px: tuple[int, int] | None
    ) -> None:
        """Check the resolution and that the recording has events.

        Args:
            path: the file or folder, for messages.
            stream: the stream's reader.
            sensor: name of the camera.
            resolution_px: (width, height) of the profile; None takes the file's.

        Raises:
            NoEventsError: no events.
            SourceError: the events are of a camera of another resolution.
        """
        self.path = path
        self.sensor = sensor
        self.serial = stream.serial
        self._stream = stream
        self._losses = Losses()
        self._assumed: list[str] = []
        self._shift_ns = 0
        if not any(len(stretch) for stretch in stream.stretches(self._losses)):
            raise NoEventsError("; ".join([f"{path} holds no events", *worded(self._losses)]))
        self.resolution_px = self._settle_resolution(resolution_px)

    @property
    def notes(self) -> list[str]:
        """Assumptions, repairs and losses so far, as text; grows while the recording is read."""
        lines = self._assumed + worded(self._losses)
        return self._stream.notes + [f"{self.path.name}: {line}" for line in lines]

    @property
    def start_ns(self) -> int:
        """First timestamp; only the beginning is read."""
        first = next(iter(self), None)
        if first is None:
            what = f"{self.path} holds no events that can be sorted by time"
            raise SourceError("; ".join([what, *worded(self._losses)]))
        return int(first.t_ns[0])

    @cached_property
    def span_ns(self) -> tuple[int, int]:
        """First and last timestamp; the whole recording is read."""
        return self.start_ns, max(int(stretch.t_ns[-1]) for stretch in self)

    def tie_to_host(self) -> None:
        """Convert timestamps relative to the sensor's start to the host's clock, if arrivals are known.

        The shift is the smallest difference among the first packets, from the least delayed one.
        """
        start_ns = self.start_ns
        delays_ns = [
            stretch.host_ns - int(stretch.t_ns[0])
            for stretch in islice(self, _HOST_STRETCHES)
            if stretch.host_ns is not None
        ]
        if start_ns < SINCE_1970_NS and delays_ns and start_ns + min(delays_ns) >= SINCE_1970_NS:
            self._shift_ns = min(delays_ns) // NS_PER_US * NS_PER_US
            self._assumed.append(
                f"{self.sensor}'s events count from the sensor's start; {self._shift_ns * 1e-9:.6f} s added, "
                "from the arrival of their packets"
            )

    def __iter__(self) -> Iterator[Events]:
        """Yield the events from the beginning, in the order of time.

        Raises:
            SourceError: the timestamps go back permanently, or events lie off the sensor.
        """
        losses = Losses()
        try:
            for stretch in in_time_order(self.path, self._stream.stretches(losses), losses):
                on_sensor = self._on_sensor(stretch, losses)
                if len(on_sensor):
                    yield self._to_events(on_sensor)
        finally:
            self._losses.keep_more(losses)

    def _to_events(self, columns: EventColumns) -> Events:
        """Add the camera's name and resolution."""
        t_ns = columns.t_ns + self._shift_ns if self._shift_ns else columns.t_ns
        x, y, polarity = columns.x, columns.y, columns.polarity
        return Events(self.sensor, t_ns, x, y, polarity, *self.resolution_px, columns.host_ns)

    def _settle_resolution(self, profile_px: tuple[int, int] | None) -> tuple[int, int]:
        file_px = self._stream.resolution_px
        if profile_px and file_px and tuple(profile_px) != tuple(file_px):
            raise SourceError(
                f"{self.path}: its events are of a sensor of {_size(file_px)} pixels, "
                f"camera {self.sensor!r} has {_size(profile_px)}",
                "Give this camera's recording, or correct resolution_px in the profile.",
            )
        width, height = profile_px or file_px or (0, 0)
        if not (width and height):
            for stretch in self._stream.stretches(Losses()):
                if len(stretch):
                    width = max(width, int(stretch.x.max()) + 1)
                    height = max(height, int(stretch.y.max()) + 1)
            what = f"declares no resolution; {width}x{height}, the extent of its events, is used"
            self._assumed.append(what)
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
        losses.add(findings.EVENTS_OFF_SENSOR(where=f"column {right}, row {bottom}"), n_off)
        return stretch.select(is_on)


def _size(resolution_px: tuple[int, int]) -> str:
    return f"{resolution_px[0]}x{resolution_px[1]}"


def in_time_order(path: Path, stretches: Iterator[EventColumns], losses: Losses) -> Iterator[EventColumns]:
    """Yield batches with ascending timestamps, within and between batches.

    Timestamps mixed within 20 ms are sorted; stray ones are skipped.
    Events are held back until the next stretch shows that nothing earlier follows.

    Raises:
        SourceError: the timestamps go back permanently; everything before has been yielded.
    """
    held, delivered_ns = NO_EVENTS, 1 - MAX_TIME_NS
    for stretch in stretches:
        keep = (stretch.t_ns >= delivered_ns) & (stretch.t_ns < MAX_TIME_NS)
        current = stretch if keep.all() else stretch.select(keep)
        if not len(current):
            if len(stretch) and len(held) and int(stretch.t_ns.max()) < delivered_ns - _CLOCK_SET_NS:
                yield held
                back_s = (int(held.t_ns[-1]) - int(stretch.t_ns[0])) * 1e-9
                what = f"{path}: the timestamps decrease by {back_s:.3f} s and do not recover"
                hint = "The clock was set, or two recordings were joined: split the recording there."
                raise SourceError(what, hint)
            losses.add(findings.EVENTS_STRAY(where="too late, or beyond any clock"), len(stretch))
            continue
        losses.add(findings.EVENTS_STRAY(where="too late, or beyond any clock"), len(stretch) - len(current))
        if len(held) and int(current.t_ns.min()) >= held.t_ns[-1]:
            yield held
            delivered_ns, held = int(held.t_ns[-1]), current
        else:
            held = join_events([held, current])
        if np.all(held.t_ns[1:] >= held.t_ns[:-1]):
            continue
        late = np.maximum.accumulate(held.t_ns) - held.t_ns > REORDER_NS
        early = held.t_ns - np.minimum.accumulate(held.t_ns[::-1])[::-1] > REORDER_NS
        # A single early timestamp makes all that follow look late, and vice versa: the minority is stray.
        stray = min(late, early, key=np.count_nonzero)
        if stray.any():
            where = f"after {held.t_ns[max(int(np.argmax(stray)) - 1, 0)] * 1e-9:.3f} s"
            losses.add(findings.EVENTS_STRAY(where=where), int(np.count_nonzero(stray)))
        held = held.select(~stray)
        held = held.select(np.argsort(held.t_ns, kind="stable"))
        cut = int(np.searchsorted(held.t_ns, held.t_ns[-1] - REORDER_NS))
        if cut:
            yield held.select(slice(0, cut))
            delivered_ns, held = int(held.t_ns[cut - 1]), held.select(slice(cut, None))
    if len(held):
        yield held
