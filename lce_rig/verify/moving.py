"""Boards that moved between picture and sweep, brought together as the calibration brought them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate import Clocks
from lce_rig.calibrate.motion import fit_motions
from lce_rig.calibrate.shared_scans import SharedScan, sample_scans
from lce_rig.calibrate.time_offsets import at_sweep_time, deskew_points
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.results import Calibration, ImageBoard, LidarBoard, Observation


@dataclass(frozen=True, eq=False)
class Meeting:
    """One capture's board, seen by both sensors at one time.

    Attributes:
        measured: as either sensor saw it, in its own time.
        at_sweep: both as they were when the LiDAR saw the board: for residuals.
        in_picture: the LiDAR's as it was when the picture was taken: for drawing.
    """

    measured: Observation
    at_sweep: Observation
    in_picture: LidarBoard

    @property
    def way_m(self) -> float:
        """How far the board's middle moved between sweep and picture."""
        before, after = self.measured.lidar.T_lidar_board, self.in_picture.T_lidar_board
        return float(np.linalg.norm(after[:3, 3] - before[:3, 3]))


def bring_together(
    observations: Mapping[str, Sequence[Observation]], channel: str, calibration: Calibration, clocks: Clocks
) -> dict[str, Meeting]:
    """Take out of each capture what the board moved between a channel's picture and the sweep.

    Args:
        observations: by channel of the calibration; other channels tell how boards moved.
        channel: whose captures are wanted.
        calibration: with its channels' time offsets; without any, boards are taken to have stood still.
        clocks: as the calibration had them.

    Returns:
        By name of the capture.
    """
    results = {result.channel: result for result in calibration.channel_results}
    timed = {name: items for name, items in observations.items() if name in results}
    if channel not in timed or any(results[name].time_offset_s is None for name in timed):
        return {o.capture: Meeting(o, o, o.lidar) for o in observations.get(channel, ())}
    scans, own = _join(timed, channel, sorted(timed, key=lambda name: results[name].noise_px))
    if not own:
        return {}
    samples = sample_scans(scans, clocks, {name: results[name].noise_px for name in timed})
    offset_s = np.array([results[name].time_offset_s for name in samples.channels], dtype=np.float64)
    only = channel if len(samples.channels) > 1 else None
    motions = fit_motions(samples, offset_s, only)
    swept = deskew_points(at_sweep_time(own, motions, clocks.sweep_s), motions, calibration.T_cam_lidar)
    return {
        o.capture: Meeting(o, moved, _in_picture(moved, o.image, calibration.T_cam_lidar))
        for o, moved in zip(own, swept, strict=True)
    }


def _join(
    observations: Mapping[str, Sequence[Observation]], channel: str, steadiest_first: Sequence[str]
) -> tuple[list[SharedScan], list[Observation]]:
    """Gather, for each of a channel's observations, the pictures of all channels that go with its scan."""
    by_scan: dict[bytes, dict[str, ImageBoard]] = {}
    for name in steadiest_first:
        for o in observations[name]:
            by_scan.setdefault(o.lidar.points.tobytes(), {}).setdefault(name, o.image)
    own = list(observations[channel])
    scans = []
    for o in own:
        # This capture's own picture, where several hold the same scan.
        images = {**by_scan[o.lidar.points.tobytes()], channel: o.image}
        scans.append(SharedScan(o.capture, images, o.lidar))
    return scans, own


def _in_picture(swept: Observation, image: ImageBoard, T_cam_lidar: Array) -> LidarBoard:
    """Carry the LiDAR's board from the time of the sweep to that of the picture."""
    moved = invert(T_cam_lidar) @ image.T_cam_board @ invert(swept.image.T_cam_board) @ T_cam_lidar
    lidar = swept.lidar
    return replace(
        lidar,
        points=transform(moved, lidar.points),
        edge_points=transform(moved, lidar.edge_points),
        T_lidar_board=moved @ lidar.T_lidar_board,
    )
