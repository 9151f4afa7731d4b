"""Observations of the board: images of all channels that share one scan, and placements of the board."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.findings import TWO_PLACES
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import BoardSurface, ImageBoard, LidarBoard, Observation
from lce_rig.rig import Rig

SAME_PLACE_M, SAME_TURN_RAD = 0.03, np.radians(3.0)
"""Distance and angle of boards, m and rad, below which captures show one placement: not independent."""


@dataclass(frozen=True)
class Clocks:
    """The profile's clock settings.

    Attributes:
        sweep_s: duration of a revolution.
        lidar_offset_s: offset from the LiDAR's timestamps to the rig's time.
        channel_offset_s: the same for each channel.
        tolerance_s: remaining tolerance of each channel's timestamps.
    """

    sweep_s: float = 0.1
    lidar_offset_s: float = 0.0
    channel_offset_s: Mapping[str, float] = field(default_factory=dict)
    tolerance_s: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, rig: Rig, camera: str, lidar: str) -> "Clocks":
        """Read the settings of a camera and a LiDAR; the first of two LiDARs has no channels.

        Boards before two cameras stand still.
        """
        if lidar in rig.cameras:
            return cls()
        channels = rig.cameras[camera].channels if camera in rig.cameras else {}
        stamps = {name: channel.timestamps for name, channel in channels.items()}
        return cls(
            sweep_s=1 / rig.lidars[lidar].rate_hz,
            lidar_offset_s=rig.lidars[lidar].timestamps.expected_offset_s,
            channel_offset_s={name: settings.expected_offset_s for name, settings in stamps.items()},
            tolerance_s={name: settings.tolerance_s for name, settings in stamps.items()},
        )

    def after_scan_s(self, channel: str, image: ImageBoard, lidar: LidarBoard) -> float:
        """Compute how long after a scan's first firing an image was taken; 0 if timestamps are missing."""
        if image.stamp_ns is None or lidar.stamp_ns is None:
            return 0.0
        apart_s = (image.stamp_ns - lidar.stamp_ns) * 1e-9
        return apart_s + self.channel_offset_s.get(channel, 0.0) - self.lidar_offset_s


@dataclass(frozen=True, eq=False)
class SharedScan:
    """One scan of the board and its images.

    Attributes:
        captures: names of the captures with this scan or a copy of it, sorted; its images may be in several.
        images: the board by channel, at least one.
        lidar: the board in the scan.
    """

    captures: tuple[str, ...]
    images: Mapping[str, ImageBoard]
    lidar: LidarBoard

    @property
    def capture(self) -> str:
        """Name of the capture that represents all of them."""
        return self.captures[0]

    def observation(self, channel: str | None = None) -> Observation:
        """Pair the scan with a channel's image, by default the first's."""
        image = self.images[channel or next(iter(self.images))]
        return Observation(self.capture, image, self.lidar)


def join_scans(
    agreed: Mapping[str, Sequence[Observation]], candidates: Mapping[str, Sequence[Observation]]
) -> tuple[list[SharedScan], dict[str, Refusal]]:
    """Group the channels' observations by scan, across captures.

    Recordings often have one folder per channel, with its images and copies of the same scans.

    Args:
        agreed: observations of each channel that agree, the most trusted channel first.
        candidates: observations of each channel, with all places that each scan offers.

    Returns:
        The scans by name, and refusals of images that match another surface of the scan than those of the
        channel before.
    """
    scan_of = {(channel, o.capture): scan_key(o) for channel, items in candidates.items() for o in items}
    groups: dict[bytes, dict[str, Observation]] = {}
    refused: dict[str, Refusal] = {}
    for channel, observations in agreed.items():
        for observation in observations:
            group = groups.setdefault(scan_of[channel, observation.capture], {})
            first = next(iter(group.values()), observation)
            if scan_key(first) != scan_key(observation):
                refused[observation.capture] = TWO_PLACES.refusal(first=next(iter(group)), second=channel)
            elif channel not in group:
                group[channel] = observation
    scans = []
    for group in groups.values():
        captures = tuple(sorted({o.capture for o in group.values()}))
        first = next(iter(group.values()))
        images = {channel: o.image for channel, o in group.items()}
        scans.append(SharedScan(captures, images, first.lidar))
    return sorted(scans, key=lambda scan: scan.capture), refused


def scan_key(observation: Observation) -> bytes:
    """Identify the board seen by the second sensor from its points."""
    return board_key(observation.surface)


def board_key(surface: BoardSurface) -> bytes:
    """Identify a board from the points on it."""
    return surface.points.tobytes()


def group_placements(observations: Sequence[Observation]) -> NDArray[np.intp]:
    """Number the board placements (F,) of captures, from the board poses of the first sensor."""
    poses = np.array([observation.pose.T_cam_board for observation in observations])
    return group_poses(poses.reshape(-1, 4, 4))


def group_poses(T: Array) -> NDArray[np.intp]:
    """Number the board placements of captures; captures at the same place share a number.

    A capture joins the first placement whose first capture has its centre and normal nearby.

    Args:
        T: (F, 4, 4) of the board, in the frame of one sensor.

    Returns:
        (F,) numbers from 0.
    """
    numbers = np.zeros(len(T), dtype=np.intp)
    firsts: list[int] = []
    for k, T_sensor_board in enumerate(T):
        apart = np.linalg.norm(T[firsts] - T_sensor_board, axis=1)
        is_same = (apart[:, 3] < SAME_PLACE_M) & (apart[:, 2] < SAME_TURN_RAD)
        if is_same.any():
            numbers[k] = np.argmax(is_same)
        else:
            numbers[k] = len(firsts)
            firsts.append(k)
    return numbers
