"""Watch all sensors of a rig in parallel for some seconds; an absent one does not stop the others."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lce_rig.core.data import Events, Image, LiveSample, Pulse
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices import driver_of
from lce_rig.devices.reading import AttachedSensors, LiveSource, SourceStatus
from lce_rig.devices.sync_board import SyncBoard
from lce_rig.rig import Rig
from lce_rig.timing.clock import ClockModel

# Longest time for sensors to open, s: a sync board that is reset by opening takes some seconds to reply.
_OPENING_S = 10.0
_CLOSING_S = 3.0
_POLL_S = 0.05
_NO_PIXELS = np.zeros((1, 1), dtype=np.uint8)


@dataclass
class ObservedSensor:
    """Observations of one sensor.

    Attributes:
        sensor: the sensor's name in the profile.
        status: last status of its driver; None if it did not open, or ended before its first sample.
        failure: the error if it could not be opened, or ended early.
        watched_s: time for which it was open.
        ended_ns: end of that time, by the computer's time of day.
        arrivals_ns: arrival of each scan, image or batch with a timestamp, by "scans", "frames", "events".
        frames: every image, without its pixels.
        pulses: every pulse, of a board or seen by a camera.
        n_events: number of events.
        host_clock, utc_clock: a sync board's models of the computer's time and of UTC.
    """

    sensor: str
    status: SourceStatus | None = None
    failure: SourceError | None = None
    watched_s: float = 0.0
    ended_ns: int = 0
    arrivals_ns: dict[str, list[int]] = field(default_factory=dict)
    frames: list[Image] = field(default_factory=list)
    pulses: list[Pulse] = field(default_factory=list)
    n_events: int = 0
    host_clock: ClockModel | None = None
    utc_clock: ClockModel | None = None

    @property
    def is_utc(self) -> bool:
        """Whether its timestamps are from its own clock, synchronised with UTC."""
        return self.status is not None and self.status.is_utc

    def take(self, sample: LiveSample) -> None:
        """Note a sample."""
        if isinstance(sample, Pulse):
            self.pulses.append(sample)
        elif isinstance(sample, Events):
            if len(sample):
                self._note("events", int(sample.t_ns[-1]), sample.host_ns)
                self.n_events += len(sample)
        elif isinstance(sample, Image):
            self._note("frames", sample.stamp_ns, sample.host_ns)
            self.frames.append(replace(sample, pixels=_NO_PIXELS))
        else:
            self._note("scans", sample.stamp_ns, sample.host_ns)

    def _note(self, stream: str, stamp_ns: int | None, host_ns: int | None) -> None:
        if stamp_ns is not None and host_ns is not None:
            self.arrivals_ns.setdefault(stream, []).append(host_ns)


@dataclass(frozen=True, eq=False)
class Examination:
    """Observations of a rig.

    Attributes:
        rig: the profile.
        folder: folder of the sessions.
        seen: observations, by the sensor's name.
    """

    rig: Rig
    folder: Path = Path()
    seen: Mapping[str, ObservedSensor] = field(default_factory=dict)

    def problems(self, sensor: str, *families: str) -> list[Finding]:
        """Return the problems reported by a sensor's driver, for some families of codes."""
        status = self.seen[sensor].status
        return [] if status is None else [each for each in status.problems if each.family in families]

    def driver(self, sensor: str) -> str:
        """Name the driver that reads a sensor; "" without one."""
        try:
            return driver_of(self.rig, sensor)
        except SourceError:
            return ""


def observe(sources: Sequence[LiveSource], duration_s: float) -> dict[str, ObservedSensor]:
    """Open and watch every sensor; the time starts when the last one has opened or failed.

    If all sensors are lost, it returns early.

    Args:
        sources: live sources of the sensors.
        duration_s: time to watch the sensors, s.

    Returns:
        The observations by the sensor's name.
    """
    seen = {source.sensor: ObservedSensor(source.sensor) for source in sources}
    sensors = AttachedSensors(sources, reopen_every_s=None)

    def watch(until_s: float, is_over: Callable[[], bool]) -> None:
        while time.monotonic() < until_s and not is_over():
            came = sensors.take(_POLL_S)
            if came is not None:
                seen[came[0]].take(came[1])

    try:
        sensors.start()
        watch(time.monotonic() + _OPENING_S, lambda: all(source.wait(0) for source in sources))
        watch(time.monotonic() + duration_s, lambda: len(sensors.lost()) == len(sources))
        for source in sources:
            each = seen[source.sensor]
            each.failure = source.lost[0] if source.lost is not None else None
            # A sensor that never sent anything has no status.
            if source.opened_s is not None and (each.failure is None or each.arrivals_ns or each.pulses):
                each.status = source.status()
                each.watched_s, each.ended_ns = time.monotonic() - source.opened_s, time.time_ns()
                if isinstance(source, SyncBoard):
                    each.host_clock, each.utc_clock = source.host_clock, source.utc_clock
    finally:  # Also after Ctrl-C: no child process of a source may outlive this one.
        stuck = sensors.stop(_CLOSING_S)
    for name, each in seen.items():
        if each.failure is None and (each.status is None or name in stuck):
            hint = "Unplug it, plug it in again and repeat."
            each.failure = SourceError("it neither opens nor closes in time", hint)
    return seen
