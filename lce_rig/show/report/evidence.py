"""Residuals of a result's boards, point by point."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.features import extract_features
from lce_rig.calibrate.plane_and_ends import plane_residuals
from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, transform
from lce_rig.core.planar_pose import refine_pose
from lce_rig.core.results import Observation


@dataclass(frozen=True, eq=False)
class Evidence:
    """The LiDAR's points on all boards, and the corners in all images.

    Attributes:
        observations: of the C captures used, by name.
        capture: (N,) index of each point's capture.
        plane_m: (N,) signed distance from the camera's board plane, positive behind it.
        ring: (N,) of each point.
        points_px: (N, 2) where it falls onto the image; NaN outside of the lens's range.
        range_m: (C,) distance of each capture's board from the LiDAR.
        corners_px: (M, 2) as measured.
        corner_residuals_px: (M, 2) measured less predicted from the board's best pose in its image.
    """

    observations: tuple[Observation, ...]
    capture: NDArray[np.intp]
    plane_m: Array
    ring: NDArray[np.int16]
    points_px: Array
    range_m: Array
    corners_px: Array
    corner_residuals_px: Array


def gather(calibration: Calibration, board: Board, lens: Intrinsics) -> Evidence | None:
    """Measure the residuals of every point and corner; None if the result was read from a file."""
    observations = tuple(calibration.observations[name] for name in sorted(calibration.observations))
    if not observations:
        return None
    T = calibration.T_cam_lidar
    corners = board.corners()
    plane_m = [
        plane_residuals(extract_features(o, board, half_step=False), T, o.lidar.points) for o in observations
    ]
    points = np.concatenate([o.lidar.points for o in observations])
    residuals_px = []
    for o in observations:
        # A board that moved has its pose at the LiDAR's time; its corners are those of the image.
        T_cam_board, _ = refine_pose(o.image.T_cam_board, o.image.corners_px, corners, lens)
        residuals_px.append(o.image.corners_px - lens.project(transform(T_cam_board, corners))[0])
    return Evidence(
        observations,
        np.repeat(np.arange(len(observations)), [len(own) for own in plane_m]),
        np.concatenate(plane_m),
        np.concatenate([o.lidar.ring for o in observations]),
        lens.project(transform(T, points))[0],
        np.array([o.lidar.quality.distance_m for o in observations]),
        np.concatenate([o.image.corners_px for o in observations]),
        np.concatenate(residuals_px),
    )
