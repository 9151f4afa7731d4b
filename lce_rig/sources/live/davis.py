"""A DAVIS346 by dv-processing: events, frames and the edges at its trigger input.

External pulses cannot trigger its frames; the camera stamps their edges with its own clock, so that this
clock can be fitted to that of the sync board which sends them.
"""

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from lce_rig.core.data import LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.rig import CameraSettings
from lce_rig.sources.live.base import ClockState, SourceStatus
from lce_rig.sources.live.davis_device import OpenedCamera, open_davis
from lce_rig.sources.live.davis_samples import DavisSamples
from lce_rig.sources.live.reading import LiveSource, RateMeter

# A batch of events lasts 10 ms: ten seconds of a taker's absence at three streams.
_N_SLOTS = 2048
_PAUSE_S = 0.002
_MAX_CLOCK_ERROR_MS = 500.0
_SILENT_HINT = "Check the USB cable; unplug the camera for some seconds and start again."


class DavisSource(LiveSource):
    """A DAVIS346; see `LiveSource`. Yields `Events`, `Image` and `Pulse`.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.
        open_camera: opens anything of dv-processing that has getNextEventBatch and its like; None opens the
            attached camera.
        silence_s: so long without anything is an error.
    """

    def __init__(
        self,
        sensor: str,
        settings: CameraSettings,
        open_camera: Callable[[str, CameraSettings], OpenedCamera] | None = None,
        silence_s: float = 5.0,
    ) -> None:
        super().__init__(sensor, f"camera {sensor!r}", _N_SLOTS, silence_s, _SILENT_HINT)
        self._settings = settings
        self._open_camera = open_camera or open_davis
        self._samples = DavisSamples(sensor, settings)
        self._polls: list[Callable[[int], list[LiveSample]]] = []
        self._notes: tuple[Finding, ...] = ()
        self._device = ""
        self._n_imu = 0
        self._rates = {"events": RateMeter(), "frames": RateMeter(), "pulses": RateMeter()}
        self._delays_ns: deque[int] = deque(maxlen=100)

    def open(self) -> None:
        """Open and set up the camera.

        Raises:
            SourceError: it is absent, busy, another model, or cannot do what the profile wants.
        """
        opened = self._open_camera(self.sensor, self._settings)
        self._input: Any = opened.input
        self._notes = opened.notes
        self._device = opened.device
        self._polls = self._find_streams()

    def close(self) -> None:
        """Close the camera."""
        # dv-processing closes a device with its last reference.
        self._input = None
        self._polls = []

    def describe(self) -> SourceStatus:
        """Say how the camera does."""
        counted = self._samples
        figures = {
            "pulses_hz": self._rates["pulses"].rate_hz,
            "n_events": float(counted.n_events),
            "n_frames": float(counted.n_frames),
            "n_pulses": float(counted.n_pulses),
            "n_imu": float(self._n_imu),
        }
        return SourceStatus(
            self.sensor,
            n_lost=counted.n_frames_lost,
            clock=ClockState(Finding("clock.davis", "note", figures={"delay_ms": self._delay_ms()})),
            problems=tuple(self._problems()),
            figures=figures,
            device=self._device,
            rates_hz={kind: self._rates[kind].rate_hz for kind in ("events", "frames")},
        )

    def _find_streams(self) -> list[Callable[[int], list[LiveSample]]]:
        """List how to ask for each stream that the camera has.

        Raises:
            SourceError: it lacks one that the profile has.
        """
        has = {
            "events": self._input.isEventStreamAvailable(),
            "frames": self._input.isFrameStreamAvailable(),
        }
        for name, channel in self._settings.channels.items():
            if not has[channel.kind]:
                what = f"camera {self.sensor!r}: {self._device} has no {channel.kind} for channel {name!r}"
                raise SourceError(what, "Is it another model? Check driver.device, or delete the channel.")
        polls: list[Callable[[int], list[LiveSample]]] = [self._next_events] if has["events"] else []
        polls += [self._next_frame] if has["frames"] else []
        polls += [self._next_pulses] if self._input.isTriggerStreamAvailable() else []
        polls += [self._next_imu] if self._input.isImuStreamAvailable() else []
        return polls

    def read(self) -> list[LiveSample]:
        """Ask every stream once: between them there is no order of time."""
        host_ns = time.time_ns()
        samples = [sample for poll in self._polls for sample in poll(host_ns)]
        if not samples:
            # A file has ended when its last stream has, a camera is gone when any is.
            is_running = getattr(self._input, "isRunningAny", self._input.isRunning)
            if not is_running():
                hint = "Was it unplugged? Check cable and power; then start again."
                raise SourceError(f"camera {self.sensor!r}: {self._device} is gone", hint)
            time.sleep(_PAUSE_S)
        return samples

    def _next_events(self, host_ns: int) -> list[LiveSample]:
        store = self._input.getNextEventBatch()
        if store is None or len(store) == 0:
            return []
        events = self._samples.to_events(store, host_ns)
        self._rates["events"].add(len(events))
        self._delays_ns.append(host_ns - int(events.t_ns[-1]))
        return [events]

    def _next_frame(self, host_ns: int) -> list[LiveSample]:
        frame = self._input.getNextFrame()
        if frame is None:
            return []
        self._rates["frames"].add(1)
        return [self._samples.to_image(frame, host_ns)]

    def _next_pulses(self, host_ns: int) -> list[LiveSample]:
        pulses: list[LiveSample] = list(
            self._samples.to_pulses(self._input.getNextTriggerBatch() or (), host_ns)
        )
        if pulses:
            self._rates["pulses"].add(len(pulses))
        return pulses

    def _next_imu(self, host_ns: int) -> list[LiveSample]:
        """Take IMU data off their queue, lest it grow; nobody wants them yet."""
        batch = self._input.getNextImuBatch()
        self._n_imu += 0 if batch is None else len(batch)
        return []

    def _delay_ms(self) -> float | None:
        """Give how old the freshest of the last events were on arrival; None before any came."""
        delay_ns = min(self._delays_ns.copy(), default=None)
        return None if delay_ns is None else delay_ns * 1e-6

    def _problems(self) -> list[Finding]:
        found = list(self._notes)
        delay_ms = self._delay_ms()
        if delay_ms is not None and abs(delay_ms) > _MAX_CLOCK_ERROR_MS:
            figures = {"difference_s": abs(delay_ms) / 1000}
            found.append(Finding("clock.differs_from_computer", "warning", figures=figures))
        if self._samples.n_resets:
            found.append(Finding("clock.restarted", "warning", figures={"n": self._samples.n_resets}))
        return found
