"""Sensor data as frozen samples."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import shortened

MAX_TIME_NS = 1 << 62
"""No valid timestamp is so far from zero: year 2116 on clocks counted from 1970. Differences fit 64 bits."""
NO_RING = -1
"""Ring of every point of a LiDAR that scans in no rings."""


@dataclass(frozen=True, eq=False)
class Image:
    """One image.

    Attributes:
        sensor: name of the camera in the rig profile.
        channel: channel of that camera ("frames", "events").
        stamp_ns: mid exposure, device time; None if the recording carries no time.
        host_ns: arrival at the host; None if unknown.
        pixels: (H, W) grey or (H, W, 3) BGR, uint8.
        count: the camera's running number of the image; gaps are lost ones; None if it does not count.
        png: PNG file of the pixels, which a session stores unchanged; None to encode them.
    """

    sensor: str
    channel: str
    stamp_ns: int | None
    pixels: NDArray[np.uint8]
    host_ns: int | None = None
    count: int | None = None
    png: bytes | None = None

    @property
    def grey(self) -> NDArray[np.uint8]:
        """The image as (H, W) uint8 grey values (ITU-R BT.601 weights)."""
        if self.pixels.ndim == 2:
            return self.pixels
        import cv2  # Slow to import, and not needed by commands without images.

        return np.asarray(cv2.cvtColor(self.pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Scan:
    """One LiDAR revolution.

    Attributes:
        sensor: name of the LiDAR in the rig profile.
        stamp_ns: first firing, device time; None if the recording carries no time.
        points: (N, 3) float32 m, frame lidar (x forward, y left, z up); finite, no zero ranges.
        intensity: (N,) float32; zeros where the recording has none.
        ring: (N,) int16, 0 = lowest elevation; `NO_RING` throughout without rings.
        offset_ns: (N,) int64 firing time after stamp_ns; None if the recording carries none.
        host_ns: arrival at the host; None if unknown.
        range_offset_m: already subtracted from the ranges; 0 for a scan as recorded.
    """

    sensor: str
    stamp_ns: int | None
    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    ring: NDArray[np.int16]
    offset_ns: NDArray[np.int64] | None = None
    host_ns: int | None = None
    range_offset_m: float = 0.0

    def corrected(self, range_offset_m: float) -> "Scan":
        """Subtract a constant from all recorded ranges of a scan, along each ray from the origin.

        A scan corrected by the same offset is returned unchanged, so that it is not subtracted twice.
        Returns not beyond the offset are dropped.

        Args:
            range_offset_m: positive where the driver's ranges are too long.
        """
        excess_m = range_offset_m - self.range_offset_m
        if excess_m == 0:
            return self
        points = shortened(self.points, excess_m).astype(np.float32)
        moved = replace(self, points=points, range_offset_m=range_offset_m)
        # False for NaN.
        is_behind = np.linalg.norm(self.points.astype(np.float64), axis=1) <= max(excess_m, 0.0)
        return moved.select(~is_behind) if is_behind.any() else moved

    def select(self, keep: NDArray[Any]) -> "Scan":
        """Keep the points of a mask or index (N,) or (M,)."""
        offset = None if self.offset_ns is None else self.offset_ns[keep]
        columns = {name: getattr(self, name)[keep] for name in ("points", "intensity", "ring")}
        return replace(self, offset_ns=offset, **columns)


@dataclass(frozen=True, eq=False)
class EventColumns:
    """Events as read: not checked against a resolution, not sorted.

    Attributes:
        t_ns: (N,) int64 device time.
        x, y: (N,) uint16 px.
        polarity: (N,) bool, True for brighter.
        host_ns: arrival of the first event at the host; None where unknown.
    """

    t_ns: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    polarity: NDArray[np.bool_]
    host_ns: int | None = None

    def __len__(self) -> int:
        return len(self.t_ns)

    def select(self, keep: NDArray[Any] | slice) -> "EventColumns":
        """Keep the events of a mask, an index or a slice."""
        return EventColumns(self.t_ns[keep], self.x[keep], self.y[keep], self.polarity[keep], self.host_ns)


@dataclass(frozen=True, eq=False)
class Events:
    """A range of an event camera's stream.

    Attributes:
        sensor: name of the camera in the rig profile.
        t_ns: (N,) int64 device time, never decreasing; microsecond timestamps times 1000, kept exactly.
        x: (N,) uint16 column.
        y: (N,) uint16 row.
        polarity: (N,) bool, True for brighter.
        width_px, height_px: resolution of the sensor.
        host_ns: arrival of the first event at the host; None if unknown.
    """

    sensor: str
    t_ns: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    polarity: NDArray[np.bool_]
    width_px: int
    height_px: int
    host_ns: int | None = None

    def __len__(self) -> int:
        return len(self.t_ns)

    def between(self, start_ns: int, end_ns: int) -> "Events":
        """Cut out the events with start_ns <= t < end_ns, without copying."""
        first, last = np.searchsorted(self.t_ns, (start_ns, end_ns))
        return self.select(slice(int(first), int(last)))

    def select(self, keep: NDArray[Any] | slice) -> "Events":
        """Keep the events of a mask, an index or a slice, in their order."""
        columns = {name: getattr(self, name)[keep] for name in ("t_ns", "x", "y", "polarity")}
        return replace(self, **columns)


_Stretch = TypeVar("_Stretch", Events, EventColumns)


def join_events(parts: Sequence[_Stretch]) -> _Stretch:
    """Join ranges of one camera's stream (at least one) in order of time."""
    filled = [part for part in parts if len(part)] or parts[:1]
    if len(filled) == 1:
        return filled[0]
    return replace(
        filled[0],
        t_ns=np.concatenate([part.t_ns for part in filled]),
        x=np.concatenate([part.x for part in filled]),
        y=np.concatenate([part.y for part in filled]),
        polarity=np.concatenate([part.polarity for part in filled]),
    )


@dataclass(frozen=True)
class Pulse:
    """An edge sent on a trigger line or detected by a sensor.

    Attributes:
        sensor: name of the line: a camera that it triggers, or the sensor that saw it.
        stamp_ns: device time of the board or sensor that reports it.
        count: running number of its line; gaps are lost pulses.
        host_ns: arrival at the host.
    """

    sensor: str
    stamp_ns: int
    count: int
    host_ns: int


@dataclass(frozen=True, order=True)
class Stream:
    """One stream of a sensor.

    Attributes:
        sensor: the camera or LiDAR.
        channel: channel of a camera; "" for a LiDAR.
        kind: kind of the data; channels of events may also contain images reconstructed by other programs.
    """

    sensor: str
    channel: str
    kind: Literal["images", "events", "scans"]

    def __str__(self) -> str:
        return f"{self.sensor}.{self.channel}" if self.channel else self.sensor


Sample: TypeAlias = Image | Scan | Events
LiveSample: TypeAlias = Image | Scan | Events | Pulse
