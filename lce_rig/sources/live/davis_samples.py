"""What dv-processing delivers, live or from a file, as samples: events, frames and trigger edges."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from lce_rig.core.data import Events, Image, Pulse
from lce_rig.core.errors import SourceError
from lce_rig.rig import CameraSettings
from lce_rig.sources.events.stream import NS_PER_US

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
        n_frames_lost: frames missing by their stamps, where the profile sets controls.frame_interval_us.
        n_resets: how often the camera's clock began anew.
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
