"""A DAVIS346 by dv-processing: events, frames and the edges at its trigger input.

External pulses cannot trigger its frames; the camera stamps their edges with its own clock, so that this
clock can be fitted to that of the sync board which sends them.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from lce_rig.core.data import Events, Image, LiveSample, Pulse
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices.davis.opened import OpenedCamera, open_davis
from lce_rig.devices.protocol import ClockState, SourceStatus
from lce_rig.devices.reading import LiveSource, RateMeter
from lce_rig.io.events.stream import NS_PER_US
from lce_rig.rig import CameraSettings

# What dv-processing delivers, live or from a file, as samples: events, frames and trigger edges.

_RISING, _RESET = "EXTERNAL_SIGNAL_RISING_EDGE", "TIMESTAMP_RESET"
_US_S = 1e6


class DavisSamples:
    """Turns dv-processing's objects into samples and counts them.

    Stamps are the camera's, Unix time in us; a frame's is moved from the start to the middle of its exposure.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.

    Attributes:
        n_events, n_frames, n_pulses: how many came.
        n_frames_lost: frames missing by their timestamps, where the profile sets controls.frame_interval_us.
        n_resets: how often the camera's clock restarted.
    """

    def __init__(self, sensor: str, settings: CameraSettings) -> None:
        self.n_events = self.n_frames = self.n_pulses = self.n_frames_lost = self.n_resets = 0
        self._sensor = sensor
        self._size = settings.resolution_px
        self._channel = settings.first_channel("frames") or "frames"
        interval_us = settings.driver.controls.get("frame_interval_us", 0)
        self._interval_us = float(interval_us) if isinstance(interval_us, int | float) else 0.0
        self._last_frame_us: int | None = None

    def to_events(self, store: Any, host_ns: int) -> Events:
        """Convert a store of events.

        Raises:
            SourceError: events lie off the sensor.
        """
        columns = store.numpy()
        x, y = columns["x"].astype(np.uint16), columns["y"].astype(np.uint16)
        width, height = self._size
        if len(x) and (x.max() >= width or y.max() >= height):
            raise self._wrong_size(f"events up to column {x.max()}, row {y.max()}")
        self.n_events += len(x)
        polarity = columns["polarity"] != 0
        return Events(self._sensor, columns["timestamp"] * NS_PER_US, x, y, polarity, width, height, host_ns)

    def to_image(self, frame: Any, host_ns: int) -> Image:
        """Convert a frame.

        Raises:
            SourceError: it has another size than the sensor.
        """
        pixels = np.array(frame.image, dtype=np.uint8)
        if pixels.shape[1::-1] != self._size:
            raise self._wrong_size(f"frames of {pixels.shape[1]}x{pixels.shape[0]} px")
        exposure_us = round(frame.exposure.total_seconds() * _US_S)
        stamp_ns = frame.timestamp * NS_PER_US + exposure_us * NS_PER_US // 2
        self._count_frame(frame.timestamp)
        return Image(self._sensor, self._channel, stamp_ns, pixels, host_ns)

    def to_pulses(self, triggers: Any, host_ns: int) -> Iterator[Pulse]:
        """Convert the rising edges among triggers; the others are of the camera's own making."""
        for trigger in triggers:
            if trigger.type.name == _RESET:
                self.n_resets += 1
            if trigger.type.name == _RISING:
                yield Pulse(self._sensor, trigger.timestamp * NS_PER_US, self.n_pulses, host_ns)
                self.n_pulses += 1

    def _count_frame(self, start_us: int) -> None:
        if self._last_frame_us is not None and self._interval_us > 0:
            n_intervals = round((start_us - self._last_frame_us) / self._interval_us)
            self.n_frames_lost += max(0, n_intervals - 1)
        self._last_frame_us = start_us
        self.n_frames += 1

    def _wrong_size(self, what: str) -> SourceError:
        width, height = self._size
        return SourceError(
            f"camera {self._sensor!r} sends {what}; the profile's has {width}x{height} px",
            "Is it another camera? Check driver.device and resolution_px.",
        )


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
        self._device = self._serial = ""
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
        self._device, self._serial = opened.device, opened.serial
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
            serial=self._serial,
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
        """Take IMU data off their queue, lest it grow; they are not used yet."""
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
