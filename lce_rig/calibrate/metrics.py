"""Error measures of extrinsics: the paper's and others."""

from collections.abc import Sequence

import numpy as np

from lce_rig.calibrate.features import AS_MEASURED, extract_features
from lce_rig.calibrate.plane_and_ends import ends_on_board, plane_residuals
from lce_rig.core.board import Board
from lce_rig.core.calibration import CaptureResidual, Metrics
from lce_rig.core.geometry import Array, rotation_angle
from lce_rig.core.results import Observation


def capture_residual(
    T_cam_lidar: Array, observation: Observation, board: Board, held_out_m: float = float("nan")
) -> CaptureResidual:
    """Measure the residuals of one capture under given extrinsics.

    Points are taken as the LiDAR measured them; ring ends are moved along their rays onto the board's plane
    and compared with the profile's size, without half step or shift.

    Args:
        T_cam_lidar: (4, 4).
        observation: the boards of both sensors.
        board: its size.
        held_out_m: passed through.
    """
    features = extract_features(observation, board, AS_MEASURED)
    plane = np.abs(plane_residuals(features, T_cam_lidar, observation.lidar.points))
    edge = board.outline_distance(ends_on_board(features, T_cam_lidar))
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
    """Compute the paper's EGT: angle in deg and distance in m between extrinsics and a reference (4, 4)."""
    angle = rotation_angle(T_cam_lidar[:3, :3], T_reference[:3, :3])
    return float(np.degrees(angle)), float(np.linalg.norm(T_cam_lidar[:3, 3] - T_reference[:3, 3]))


def _mean(values: Array) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _rms(values: Array) -> float:
    return float(np.sqrt(_mean(values**2)))
