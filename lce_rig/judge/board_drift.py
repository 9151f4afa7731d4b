"""What boards in view say about deployed extrinsics: `verify`'s residuals, axis by axis."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lce_rig.calibrate import Clocks
from lce_rig.calibrate.quadratics import Quadratics, jackknife_scatter
from lce_rig.calibrate.result import capture_residual, summarise
from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration, Metrics
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, perturb
from lce_rig.core.results import ImageBoard, LidarBoard, Observation
from lce_rig.detect.detection import Detections, Pair
from lce_rig.judge.local_quadratic import SCALE, expand
from lce_rig.judge.session_check import find_meetings
from lce_rig.rig import LidarSettings, Rig
from lce_rig.scene.alignment import AXES, IS_ROTATION
from lce_rig.scene.drift import LARGEST, POWER_SIGMAS, THRESHOLD_SIGMAS, AxisDrift, State
from lce_rig.scene.findings import BOARD_CHANGED, BOARD_UNSURE

# What results of one rig differ by from session to session, m and rad, order of AXES.
_BIAS = np.array([0.005, 0.005, 0.010, *np.radians([0.12, 0.10, 0.12])])
_OUTLIER = 3.0  # times the median residual
_MIN_PLACEMENTS = 3  # The scatter of fewer says little.


@dataclass(frozen=True, eq=False)
class BoardDrift:
    """Deployed extrinsics compared with the boards of some captures.

    Attributes:
        axes: one verdict each, order of AXES, were it the only one that changed besides the one that explains
            most.
        metrics: residuals of the deployed extrinsics, as `verify` has them.
        n_boards: captures in which both sensors see the board.
        n_placements: places at which it was held.
    """

    axes: tuple[AxisDrift, ...]
    metrics: Metrics
    n_boards: int
    n_placements: int

    def document(self) -> dict[str, Any]:
        """List everything as plain types for JSON."""
        return {
            "n_boards": self.n_boards,
            "n_placements": self.n_placements,
            "mpe_m": self.metrics.mpe_m,
            "mee_m": self.metrics.mee_m,
            "axes": [axis.document() for axis in self.axes],
        }

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Axes that the boards find changed, or cannot tell."""
        return tuple(
            (BOARD_CHANGED if axis.state == "changed" else BOARD_UNSURE)(axis.axis, **axis.figures)
            for axis in self.axes
            if axis.state != "unchanged"
        )


def watch_boards(
    rig: Rig,
    calibration: Calibration,
    channel: str,
    images: Mapping[str, ImageBoard],
    scans: Mapping[str, list[LidarBoard]],
    clocks: Clocks,
) -> BoardDrift | None:
    """Compare deployed extrinsics with boards.

    Args:
        rig: the profile.
        calibration: the deployed extrinsics.
        channel: of the images.
        images, scans: the board in them, by capture.
        clocks: the profile's settings of the two sensors' times.

    Returns:
        None where both sensors see the board at about the same place in fewer than three placements.
    """
    T_cam_lidar, pair = calibration.T_cam_lidar, Pair(calibration.camera, channel, calibration.lidar)
    detections = Detections({(calibration.camera, channel): dict(images)}, {calibration.lidar: dict(scans)})
    board = rig.board.to_board()
    meetings = find_meetings(rig, detections, pair, T_cam_lidar, calibration.channel_results, clocks)
    met = [meeting.at_scan_time for meeting in meetings.values()]
    if not met:
        return None
    residuals = [capture_residual(calibration.T_cam_lidar, each, board) for each in met]
    rms_m = np.array([np.hypot(each.plane_rms_m, each.edge_rms_m) for each in residuals])
    # Another plate, or a board that moved between image and scan.
    is_inlier = rms_m <= _OUTLIER * np.median(rms_m)
    seen = [each for each, keep in zip(met, is_inlier, strict=True) if keep]
    lidar = rig.lidars[calibration.lidar]
    cost = _expand(seen, board, calibration.T_cam_lidar, lidar)
    if len(cost.groups) < _MIN_PLACEMENTS:
        return None
    sigmas = np.sqrt(np.diag(calibration.cov))
    axes = [_judge(axis, cost, float(sigmas[axis])) for axis in range(6)]
    if sum(axis.state == "changed" for axis in axes) > 1:
        # One changed axis looks like several: that which explains most is changed, others are judged anew.
        alone = [_alone(cost, axis) for axis in range(6)]
        first = int(np.argmax([each.optimum()[0] ** 2 / each.covariance()[0, 0] for each in alone]))
        moved = perturb(calibration.T_cam_lidar, alone[first].optimum()[0] * np.eye(6)[first])
        rest = _expand(seen, board, moved, lidar)
        axes = [axes[axis] if axis == first else _judge(axis, rest, float(sigmas[axis])) for axis in range(6)]
    return BoardDrift(tuple(axes), summarise(residuals), len(seen), len(cost.groups))


def _alone(cost: Quadratics, axis: int) -> Quadratics:
    """Keep one axis of the extrinsics and what all captures share."""
    return cost.of(np.array([axis, *range(6, len(cost.prior))]))


def _expand(seen: list[Observation], board: Board, T_cam_lidar: Array, lidar: LidarSettings) -> Quadratics:
    cost = expand(
        seen,
        board,
        T_cam_lidar,
        laser_bias_sigma_m=lidar.laser_bias_sigma_m,
        range_offset_sigma_m=lidar.range_offset_sigma_m,
    )
    return cost.hold(SCALE)


def _judge(axis: int, cost: Quadratics, sigma_deployed: float) -> AxisDrift:
    """Estimate the change of one axis alone; the larger variance of residuals and jackknife counts."""
    unit = float(np.degrees(1.0)) if IS_ROTATION[axis] else 1.0
    alone = _alone(cost, axis)
    change = float(alone.optimum()[0])
    variance = float(alone.covariance()[0, 0])
    without_each = alone.without_each()[:, :1]
    variance = max(variance, float(jackknife_scatter(without_each - without_each.mean())[0, 0]))
    sigma = float(np.sqrt(variance + sigma_deployed**2 + _BIAS[axis] ** 2))
    smallest = (THRESHOLD_SIGMAS + POWER_SIGMAS) * sigma
    state: State = "unchanged"
    if abs(change) > THRESHOLD_SIGMAS * sigma:
        state = "changed"
    elif smallest > LARGEST[axis]:
        state = "unknown"
    reason = "" if state != "unknown" else "scene.board_unsure"
    return AxisDrift(AXES[axis], state, unit * change, unit * sigma, unit * smallest, reason)
