"""All sensors of a rig watched side by side for some seconds; one that is absent keeps no other from it."""

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events, Image, LiveSample, Pulse, Scan
from lce_rig.core.errors import SourceError
from lce_rig.devices.protocol import SourceStatus
from lce_rig.devices.reading import LiveSource
from lce_rig.devices.sync_board import SyncBoard
from lce_rig.timing.clock import ClockModel

# A sync board that its port's opening resets takes some seconds to speak; the wait ends then.
PATIENCE_S = 3.0
_POLL_S = 0.05
# The network that makes images from events remembers about a second.
_EVENTS_KEPT_NS = 1_500_000_000
_NO_PIXELS = np.zeros((1, 1), dtype=np.uint8)


@dataclass
class ObservedSensor:
    """Observations of one sensor.

    Attributes:
        sensor: its name in the profile.
        status: the last that its driver said; None where it did not open, or ended before anything came.
        failure: why it could not be opened, or ended early.
        watched_s: for how long it was open.
        ended_ns: when that ended, by the computer's time of day.
        timestamps: (timestamp, arrival) ns of each scan, image or batch, by "scans", "frames", "events".
        frames: every image, without its pixels.
        pulses: every pulse, of a board or seen by a camera.
        scan, images, events: the last scan, the last image of each channel, the last 1.5 s of events.
        n_events: how many events came in all.
        host_clock, utc_clock: a sync board's models of the computer's time and of UTC.
    """

    sensor: str
    status: SourceStatus | None = None
    failure: SourceError | None = None
    watched_s: float = 0.0
    ended_ns: int = 0
    stamps: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    frames: list[Image] = field(default_factory=list)
    pulses: list[Pulse] = field(default_factory=list)
    scan: Scan | None = None
    images: dict[str, Image] = field(default_factory=dict)
    events: deque[Events] = field(default_factory=deque)
    n_events: int = 0
    host_clock: ClockModel | None = None
    utc_clock: ClockModel | None = None

    @property
    def has_opened(self) -> bool:
        """Whether it opened, and did not end at once."""
        return self.status is not None

    def times(self, stream: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the timestamps (N,) and arrivals (N,) of a stream, ns."""
        pairs = np.array(self.stamps.get(stream, []), dtype=np.int64).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def take(self, sample: LiveSample) -> None:
        """Note a sample."""
        if isinstance(sample, Pulse):
            self.pulses.append(sample)
        elif isinstance(sample, Events):
            if not len(sample):
                return
            self._note("events", int(sample.t_ns[-1]), sample.host_ns)
            self.n_events += len(sample)
            self.events.append(sample)
            while self.events[0].t_ns[-1] < sample.t_ns[-1] - _EVENTS_KEPT_NS:
                self.events.popleft()
        elif isinstance(sample, Image):
            self._note("frames", sample.stamp_ns, sample.host_ns)
            self.frames.append(replace(sample, pixels=_NO_PIXELS))
            self.images[sample.channel] = sample
        else:
            self._note("scans", sample.stamp_ns, sample.host_ns)
            self.scan = sample

    def _note(self, stream: str, stamp_ns: int | None, host_ns: int | None) -> None:
        if stamp_ns is not None and host_ns is not None:
            self.stamps.setdefault(stream, []).append((stamp_ns, host_ns))


def observe(
    sources: Mapping[str, Callable[[], LiveSource]],
    duration_s: float,
    meanwhile: Sequence[Callable[[], None]] = (),
) -> dict[str, ObservedSensor]:
    """Open every sensor and watch it.

    Sensors that take their time to open are waited for, 3 s beyond the duration at most, and then watched
    for half of it. Where none is open, nothing is waited for.

    Args:
        sources: makes each sensor's source, by its name; may raise SourceError.
        duration_s: how long to watch.
        meanwhile: what else is to be done in that time, in this thread.

    Returns:
        What was seen, by the sensor's name.
    """
    start_s = time.monotonic()
    watches = {sensor: _Watch(sensor, make) for sensor, make in sources.items()}
    try:
        for work in meanwhile:
            work()
        while (now_s := time.monotonic()) < start_s + duration_s + PATIENCE_S:
            open_s = [now_s - watch.opened_s for watch in watches.values() if watch.opened_s is not None]
            is_any_opening = any(watch.opened_s is None and not watch.is_over for watch in watches.values())
            has_watched = not is_any_opening and all(each_s >= duration_s / 2 for each_s in open_s)
            is_due = now_s >= start_s + duration_s and has_watched
            if is_due or all(watch.is_over for watch in watches.values()):
                break
            time.sleep(_POLL_S)
    except BaseException:  # Ctrl-C too: what a source has started must not outlive the program.
        for watch in watches.values():
            watch.stop.set()
        for watch in watches.values():
            watch.result(PATIENCE_S)
        raise
    for watch in watches.values():
        watch.stop.set()
    limit_s = max(duration_s, time.monotonic() - start_s) + PATIENCE_S
    return {sensor: watch.result(start_s + limit_s - time.monotonic()) for sensor, watch in watches.items()}


class _Watch:
    """One sensor's thread: opens it, takes samples, and closes it.

    Attributes:
        stop: set to end the watch.
        opened_s: when it opened, by the steady clock; None before.
        is_over: whether it has failed or been closed.
    """

    def __init__(self, sensor: str, make: Callable[[], LiveSource]) -> None:
        self.stop = threading.Event()
        self.opened_s: float | None = None
        self.is_over = False
        self._seen = ObservedSensor(sensor)
        self._make = make
        self._thread = threading.Thread(target=self._run, name=f"watch {sensor}", daemon=True)
        self._thread.start()

    def result(self, timeout_s: float) -> ObservedSensor:
        """Wait for the sensor to close, and give what was seen."""
        self._thread.join(max(timeout_s, _POLL_S))
        if self._thread.is_alive() and self._seen.failure is None:
            hint = "Unplug it, plug it in again and repeat."
            self._seen.failure = SourceError("it neither opens nor closes in time", hint)
        return self._seen

    def _run(self) -> None:
        try:
            with self._make() as source:
                self.opened_s = time.monotonic()
                try:
                    while not self.stop.is_set():
                        sample = source.take(_POLL_S)
                        if sample is not None:
                            self._seen.take(sample)
                except SourceError as error:
                    self._seen.failure = error
                # Nothing of one that never sent anything.
                if self._seen.failure is None or self._seen.stamps or self._seen.pulses:
                    self._seen.status = source.status()
                    self._seen.watched_s = time.monotonic() - self.opened_s
                    self._seen.ended_ns = time.time_ns()
                    if isinstance(source, SyncBoard):
                        self._seen.host_clock, self._seen.utc_clock = source.host_clock, source.utc_clock
        except SourceError as error:
            self._seen.failure = self._seen.failure or error
        except Exception as error:  # A bug in one driver must not hide what is known of the others.
            self._seen.failure = SourceError(f"its driver failed: {error!r}", "This is a bug: report it.")
        finally:
            self.is_over = True
