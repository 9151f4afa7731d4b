"""Errors of an extrinsic, as the paper defines them and as they are useful."""

from collections.abc import Sequence

import numpy as np

from lce_rig.calibrate.features import extract_features
from lce_rig.calibrate.options import CalibrateOptions
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, rotation_angle, transform
from lce_rig.core.results import CaptureResidual, Metrics, Observation

# What is measured must not depend on what was switched on while fitting.
_AS_MEASURED = CalibrateOptions(point_projection="ray", half_step=False)


def capture_residual(
    T_cam_lidar: Array, observation: Observation, board: Board, held_out_m: float = float("nan")
) -> CaptureResidual:
    """Measure how well one capture fits an extrinsic.

    Points are taken as the LiDAR measured them; ring ends are moved along their rays onto the board's plane
    and compared with the printed size, without half step or shift.

    Args:
        T_cam_lidar: (4, 4).
        observation: the boards of both sensors.
        board: its size.
        held_out_m: passed through.
    """
    features = extract_features(observation, board, _AS_MEASURED)
    points_cam = transform(T_cam_lidar, observation.lidar.points)
    plane = np.abs((points_cam - features.centre) @ features.normal)
    ends_board = transform(features.T_board_cam @ T_cam_lidar, features.edge_points)
    edge = board.outline_distance(ends_board)
    return CaptureResidual(
        capture=observation.capture,
        plane_mean_m=_mean(plane),
        plane_rms_m=_rms(plane),
        edge_mean_m=_mean(edge),
        edge_rms_m=_rms(edge),
        held_out_m=held_out_m,
        reprojection_px=observation.image.reprojection_px,
    )


def summarise(residuals: Sequence[CaptureResidual]) -> Metrics:
    """Average per-capture residuals: MPE, MEE (mean distances) and the rms corner residual."""
    # A scan may show the board without any usable end of a ring.
    edges = np.array([r.edge_mean_m for r in residuals])
    return Metrics(
        mpe_m=_mean(np.array([r.plane_mean_m for r in residuals])),
        mee_m=_mean(edges[np.isfinite(edges)]),
        reprojection_px=_rms(np.array([r.reprojection_px for r in residuals])),
    )


def error_to_reference(T_cam_lidar: Array, T_reference: Array) -> tuple[float, float]:
    """Compute the paper's EGT: angle in deg and distance in m between an extrinsic and a reference (4, 4)."""
    angle = rotation_angle(T_cam_lidar[:3, :3], T_reference[:3, :3])
    return float(np.degrees(angle)), float(np.linalg.norm(T_cam_lidar[:3, 3] - T_reference[:3, 3]))


def _mean(values: Array) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _rms(values: Array) -> float:
    return float(np.sqrt(_mean(values**2)))
