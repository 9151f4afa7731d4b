"""Corner to corner: the plate's four corners in both sensors, brought together by iterated closest points.

The LiDAR's corners are those of the outline registered with its returns, the camera's those of the plate in
the pose of the print. Pairs of nearest corners within each capture give the pose in closed form (2), which
may change the pairs (1), until they stay the same:

    j(i) = argmin_j |c_j - R l_i - t|                                                                  (1)
    R, t = argmin sum |c_j(i) - R l_i - t|^2                                                           (2)

References:
    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE TPAMI,
    1991; Jiao et al., "LCE-Calib", 2023, which takes corners checked by hand for its ground truth.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.baselines.refinement import placement_covariance, point_rows
from lce_rig.calibrate.baselines.start import start_from_planes
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.options import CalibrateOptions
from lce_rig.calibrate.report import report_estimate
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, pose, transform
from lce_rig.core.results import Observation
from lce_rig.solvers.registration import moment_matrix, rotation_from_directions

MAX_ROUNDS = 50


def calibrate_by_corners(
    observations: Sequence[Observation],
    board: Board,
    options: CalibrateOptions,
    progress: Callable[[int, int], None] | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from the plate's corners.

    Args:
        observations: one a capture.
        board: its specification.
        options: the method has no switches of its own.
        progress: not called: there is one solution.

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    features, T_planes = start_from_planes(observations, board, options)
    outline = board.outline()
    corners_lidar = np.stack([transform(o.lidar.T_lidar_board, outline) for o in observations])
    corners_cam = np.stack([transform(o.image.T_cam_board, outline) for o in observations])
    T, paired = align_corners(corners_lidar, corners_cam, T_planes)
    rows = np.stack([point_rows(c, p) for c, p in zip(paired, corners_lidar, strict=True)])
    moments = moment_matrix(rows, np.ones(rows.shape[:2]))
    distances_m = np.linalg.norm(paired - (corners_lidar @ T[:3, :3].T + T[:3, 3]), axis=-1)
    return report_estimate(
        T,
        placement_covariance(moments, T, observations),
        observations,
        features,
        board,
        refused={},
        diagnostics={"corner_rms_m": float(np.sqrt(np.mean(distances_m**2)))},
    )


def align_corners(corners_lidar: Array, corners_cam: Array, T_start: Array) -> tuple[Array, Array]:
    """Iterate (1) and (2).

    Args:
        corners_lidar: (F, 4, 3) by capture, m.
        corners_cam: (F, 4, 3) by capture, m.
        T_start: (4, 4) T_cam_lidar.

    Returns:
        T_cam_lidar (4, 4), and the camera's corner (F, 4, 3) of each of the LiDAR's.
    """
    T, pairs = T_start, np.full(corners_lidar.shape[:2], -1)
    for _ in range(MAX_ROUNDS):
        moved = corners_lidar @ T[:3, :3].T + T[:3, 3]
        nearest = np.argmin(np.linalg.norm(moved[:, :, None] - corners_cam[:, None], axis=-1), axis=2)
        if np.array_equal(nearest, pairs):
            break
        pairs = nearest
        T = align_points(_chosen(corners_cam, pairs).reshape(-1, 3), corners_lidar.reshape(-1, 3))
    return T, _chosen(corners_cam, pairs)


def _chosen(corners: Array, pairs: NDArray[np.intp]) -> Array:
    return np.take_along_axis(corners, pairs[..., None], axis=1)


def align_points(targets: Array, sources: Array) -> Array:
    """Find the pose (4, 4) that takes points (N, 3) nearest to others (N, 3) in the mean square."""
    centre, centre_source = targets.mean(axis=0), sources.mean(axis=0)
    R = rotation_from_directions(targets - centre, sources - centre_source)
    return np.asarray(pose(R, centre - R @ centre_source))
