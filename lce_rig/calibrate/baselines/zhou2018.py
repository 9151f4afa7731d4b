"""Line and plane correspondences: the boards' planes and border lines, closed form, then least squares.

Each capture gives a plane (normal n, a point g) and up to four border lines (direction d, a point a) in the
camera, and in the LiDAR the same plane (normal m, N points p) and lines (direction e, K points q). With
A = I - d d^T the pose satisfies

    n = R m,    d = R e,    n . (R p + t - g) = 0,    A (R q + t - a) = 0                             (1)

R follows in closed form from the first two (Wahba's problem), t by linear least squares from the others with
the means of p and q. Both are refined together on

    sum_captures |n - R m|^2 + sum_lines |d - R e|^2 + mean_p (n . (R p + t - g))^2
                 + sum_lines mean_q |A (R q + t - a)|^2                                                (2)

in rad and m. The paper tells the plate's borders apart by how it is hung; here a first pose from the planes
alone tells which way up the LiDAR's rectangle is.

References:
    Zhou, Li, Kaess, "Automatic Extrinsic Calibration of a Camera and a 3D LiDAR using Line and Plane
    Correspondences", IROS, 2018.
"""

from collections.abc import Callable, Sequence

import numpy as np

from lce_rig.calibrate.baselines.board_lines import LinePair, pair_lines
from lce_rig.calibrate.baselines.refinement import direction_rows, placement_covariance, refine
from lce_rig.calibrate.baselines.start import start_from_planes
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.options import CalibrateOptions
from lce_rig.calibrate.report import report_estimate
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, pose
from lce_rig.core.results import Observation
from lce_rig.residuals.plane_and_ends import residual_rows
from lce_rig.solvers.registration import rotation_from_directions


def calibrate_by_lines_and_planes(
    observations: Sequence[Observation],
    board: Board,
    options: CalibrateOptions,
    progress: Callable[[int, int], None] | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar as Zhou, Li and Kaess do.

    Args:
        observations: one a capture.
        board: its specification.
        options: the method has no switches of its own.
        progress: not called: there is one solution.

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    features, T_planes = start_from_planes(observations, board, options)
    lines = [pair_lines(observation, board, T_planes) for observation in observations]
    T_start = solve_closed_form(observations, lines)
    moments = np.stack([_moments(o, own) for o, own in zip(observations, lines, strict=True)])
    T = refine(moments, T_start)
    return report_estimate(
        T,
        placement_covariance(moments, T, observations),
        observations,
        features,
        board,
        refused={},
        diagnostics={"n_lines": float(sum(len(own) for own in lines))},
    )


def solve_closed_form(observations: Sequence[Observation], lines: Sequence[Sequence[LinePair]]) -> Array:
    """Solve (1) for R, then for t: T_cam_lidar (4, 4).

    Args:
        observations: of the captures.
        lines: the line pairs of each.
    """
    every = [line for own in lines for line in own]
    targets = [o.image.T_cam_board[:3, 2] for o in observations] + [line.direction for line in every]
    sources = [o.lidar.plane[:3] for o in observations] + [line.direction_lidar for line in every]
    R = rotation_from_directions(np.array(targets), np.array(sources))
    A, b = [], []
    for observation in observations:
        n, anchor = observation.image.T_cam_board[:3, 2], observation.image.T_cam_board[:3, 3]
        A.append(n[None])
        b.append(n[None] @ (anchor - R @ observation.lidar.points.mean(axis=0)))
    for line in every:
        across = _across(line.direction)
        A.append(across)
        b.append(across @ (line.anchor - R @ line.points.mean(axis=0)))
    return np.asarray(pose(R, np.linalg.lstsq(np.concatenate(A), np.concatenate(b))[0]))


def _moments(observation: Observation, lines: Sequence[LinePair]) -> Array:
    """Sum one capture's part of (2) as x^T M x, M (13, 13)."""
    T_cam_board, lidar = observation.image.T_cam_board, observation.lidar
    planar = residual_rows(T_cam_board[:3, 2], T_cam_board[:3, 3], lidar.points)
    directions = direction_rows(
        np.array([T_cam_board[:3, 2], *(line.direction for line in lines)]),
        np.array([lidar.plane[:3], *(line.direction_lidar for line in lines)]),
    )
    M = directions.T @ directions + planar.T @ planar / len(planar)
    for line in lines:
        rows = residual_rows(_across(line.direction)[:, None], line.anchor, line.points[None]).reshape(-1, 13)
        M += rows.T @ rows / len(line.points)
    return np.asarray(M)


def _across(direction: Array) -> Array:
    """Complete a unit vector (3,) by two more (2, 3): A = sum of their outer products."""
    return np.linalg.svd(direction[None])[2][1:]
