"""The truth of a simulation as JSON values, for files beside the simulated data."""

from typing import Any

import numpy as np

from lce_rig.core.data import Scan
from lce_rig.core.geometry import invert, transform
from lce_rig.rig import Rig
from lce_rig.simulate.captures import SimulatedCapture
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.simulated_recording import SimulatedRecording
from lce_rig.simulate.stage import truth_extrinsics

_TRACK_EVERY_NS = 10_000_000
# Range noise, and mixed returns at the border, do not count as the board's.
_ON_BOARD_M = 0.05


def rig_truth(rig: Rig, seed: int, options: SimulationOptions) -> dict[str, Any]:
    """Return the extrinsics and clocks of a simulated rig.

    Returns:
        `pairs` of camera and lidar with T_cam_lidar (p_cam = T p_lidar), the first pair's alone, and how much
        more the timestamps of images and events read than the rig's clock, which is the LiDAR's.
    """
    pairs = [
        {"camera": camera, "lidar": lidar, "T_cam_lidar": T.tolist()}
        for (camera, lidar), T in sorted(truth_extrinsics(rig, seed, options).items())
    ]
    return {
        "seed": seed,
        "mounting_seed": options.mounting_of(seed),
        "T_cam_lidar": pairs[0]["T_cam_lidar"],
        "pairs": pairs,
        "motion": options.motion,
        "frame_offset_s": options.frame_offset_s,
        "event_offset_s": options.event_offset_s,
    }


def capture_truth(rig: Rig, capture: SimulatedCapture, options: SimulationOptions) -> dict[str, Any]:
    """Return where the board was when each sensor saw it.

    Returns:
        `boards`: by sensor `t_ns`, on the rig's clock, and `T_sensor_board` then; `speed_mps` of the board's
        middle when the LiDAR that it was placed for met it. A LiDAR's time is the mean firing time of its
        returns from the board, a camera's the middle of its image's exposure, or that of the LiDAR where it
        takes none.
    """
    times_ns = {scan.sensor: board_time_ns(rig, capture, scan) for scan in capture.scans}
    middle_ns = times_ns[capture.target[1]]
    times_ns |= dict.fromkeys(rig.cameras, middle_ns)
    for image in capture.images:
        times_ns[image.sensor] = (image.stamp_ns or 0) - round(1e9 * options.frame_offset_s)
    return {
        "speed_mps": round(float(capture.trajectory.speed_mps(middle_ns)), 6),
        "boards": {
            sensor: {"t_ns": t_ns, "T_sensor_board": capture.T_sensor_board(sensor, t_ns).tolist()}
            for sensor, t_ns in times_ns.items()
        },
    }


def recording_truth(recording: SimulatedRecording) -> dict[str, Any]:
    """Return where the board is before the first LiDAR, 100 times per second.

    Returns:
        `boards`: by LiDAR `t_ns` (K), on the rig's clock, and `T_sensor_board` (K, 4, 4).
    """
    lidar = next(iter(recording.stage.rig.lidars))
    t_ns = np.arange(recording.start_ns, recording.end_ns + _TRACK_EVERY_NS, _TRACK_EVERY_NS)
    track = {"t_ns": t_ns.tolist(), "T_sensor_board": recording.T_sensor_board(lidar, t_ns).tolist()}
    return {"boards": {lidar: track}}


def board_time_ns(rig: Rig, capture: SimulatedCapture, scan: Scan) -> int:
    """Find the mean firing time of a scan's board returns; half a scan after its timestamp without any.

    Each return is compared with the board where it was at that return's own time.
    """
    first_ns = scan.stamp_ns or 0
    middle_ns = first_ns + round(0.5e9 / rig.lidars[scan.sensor].rate_hz)
    if scan.offset_ns is None:
        return middle_ns
    board = rig.board.to_board()
    T_lidar_board = capture.T_sensor_board(scan.sensor, middle_ns)
    reach_m = 0.3 + 0.5 * np.hypot(board.width_m, board.height_m)
    near = np.linalg.norm(scan.points - T_lidar_board[:3, 3], axis=1) < reach_m
    offset_ns = scan.offset_ns[near]
    T_board_lidar = invert(capture.T_sensor_board(scan.sensor, first_ns + offset_ns))
    points = transform(T_board_lidar, scan.points[near, None].astype(np.float64))[:, 0]
    is_on = np.all(np.abs(points) < [board.width_m / 2, board.height_m / 2, _ON_BOARD_M], axis=1)
    return first_ns + round(offset_ns[is_on].mean()) if is_on.any() else middle_ns
