"""Images of all channels of one camera that share one scan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lce_rig.calibrate.consensus import Consensus
from lce_rig.calibrate.motion.board_motion import PoseSamples, sample_poses
from lce_rig.calibrate.options import CaptureCandidates
from lce_rig.core.findings import Refusal
from lce_rig.core.results import ImageBoard, LidarBoard, Observation

# Images without timestamps may be at any time around the scan they were saved with.
NO_STAMPS_SIGMA_S = 0.15


@dataclass(frozen=True)
class Clocks:
    """The profile's settings of time.

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
        captures: names of those that hold it, sorted; its images may lie in several, with copies of it.
        images: the board by channel, at least one.
        lidar: the board in the scan.
        session: where captures are of several.
    """

    captures: tuple[str, ...]
    images: Mapping[str, ImageBoard]
    lidar: LidarBoard
    session: str = ""

    @property
    def capture(self) -> str:
        """The capture that stands for all of them."""
        return self.captures[0]

    def observation(self, channel: str | None = None) -> Observation:
        """Pair the scan with a channel's image, by default the first's."""
        image = self.images[channel or next(iter(self.images))]
        return Observation(self.capture, image, self.lidar, self.session)


def join_scans(
    agreed: Mapping[str, Consensus], candidates: Mapping[str, Sequence[CaptureCandidates]]
) -> tuple[list[SharedScan], dict[str, Refusal]]:
    """Group the channels' observations by scan, in any captures.

    Recordings often hold the images of each channel in a folder of its own, with copies of the same scans.

    Args:
        agreed: consensus of each channel, the most trusted first.
        candidates: of each channel, all places that each scan offers.

    Returns:
        The scans by name, and refusals of images that match another surface of the scan than those of the
        channel before.
    """
    scan_of = {
        (channel, item.capture): item.lidar[0].points.tobytes()
        for channel, items in candidates.items()
        for item in items
        if item.lidar
    }
    groups: dict[bytes, dict[str, Observation]] = {}
    refused: dict[str, Refusal] = {}
    for channel, consensus in agreed.items():
        for observation in consensus.observations:
            group = groups.setdefault(scan_of[channel, observation.capture], {})
            first = next(iter(group.values()), observation)
            if not np.array_equal(first.lidar.points, observation.lidar.points):
                figures = {"first": next(iter(group)), "second": channel}
                refused[observation.capture] = Refusal("pair.two_places", figures=figures)
            elif channel not in group:
                group[channel] = observation
    scans = [
        SharedScan(
            tuple(sorted({o.capture for o in group.values()})),
            {channel: o.image for channel, o in group.items()},
            next(iter(group.values())).lidar,
            next(iter(group.values())).session,
        )
        for group in groups.values()
    ]
    return sorted(scans, key=lambda scan: scan.capture), refused


def sample_scans(scans: Sequence[SharedScan], clocks: Clocks, noise_px: Mapping[str, float]) -> PoseSamples:
    """Collect the poses and times of each scan's images."""
    return sample_poses(
        [
            [
                (channel, image, clocks.after_scan_s(channel, image, scan.lidar))
                for channel, image in scan.images.items()
            ]
            for scan in scans
        ],
        noise_px,
    )


def time_sigmas_s(scans: Sequence[SharedScan], clocks: Clocks, channels: Sequence[str]) -> list[float]:
    """Return the time tolerance of each channel: the profile's, or more if timestamps are missing."""
    sigmas = []
    for channel in channels:
        stamped = [
            scan.images[channel].stamp_ns is not None and scan.lidar.stamp_ns is not None
            for scan in scans
            if channel in scan.images
        ]
        sigmas.append(clocks.tolerance_s.get(channel, 0.05) if all(stamped) else NO_STAMPS_SIGMA_S)
    return sigmas


def scan_key(observation: Observation) -> bytes:
    """Identify the board of a scan by its points."""
    return observation.lidar.points.tobytes()


def pooled_noise_px(images: Sequence[ImageBoard]) -> float:
    """Estimate a channel's corner noise per coordinate from the residuals of all its boards."""
    return float(np.sqrt(np.mean([image.sigma_px**2 for image in images])))
