"""What boards in view say about deployed extrinsics: `verify`'s residuals, axis by axis."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import Calibration, LidarBoard, Metrics, Observation
from lce_rig.core.results import ImageBoard as SeenBoard
from lce_rig.detect.detection import Detections
from lce_rig.extrinsics.local_quadratic import SCALE, expand
from lce_rig.pipeline.calibration import clocks_of
from lce_rig.residuals.quadratics import Quadratics
from lce_rig.rig import LidarSettings, Rig
from lce_rig.scene.alignment import AXES, IS_ROTATION
from lce_rig.scene.drift import AxisDrift, State
from lce_rig.verify.session_check import check_session

_THRESHOLD_SIGMAS, _POWER_SIGMAS = 3.0, 1.645  # as for the scene
# What results of one rig differ by from session to session, m and rad, order of AXES.
_BIAS = np.array([0.005, 0.005, 0.010, *np.radians([0.12, 0.10, 0.12])])
_LARGEST = np.where(IS_ROTATION, np.radians(1.5), 0.10)


@dataclass(frozen=True, eq=False)
class BoardDrift:
    """Deployed extrinsics compared with the boards of some captures.

    Attributes:
        axes: one verdict each, order of AXES, were this axis the only one that changed.
        metrics: residuals of the deployed extrinsics, as `verify` has them.
        n_boards: captures in which both sensors see the board.
        n_placements: places at which it was held.
    """

    axes: tuple[AxisDrift, ...]
    metrics: Metrics
    n_boards: int
    n_placements: int


def watch_boards(
    rig: Rig,
    calibration: Calibration,
    channel: str,
    images: Mapping[str, SeenBoard],
    scans: Mapping[str, list[LidarBoard]],
) -> BoardDrift | None:
    """Compare deployed extrinsics with boards.

    Args:
        rig: the profile.
        calibration: the deployed extrinsics.
        channel: of the images.
        images, scans: the board in them, by capture.

    Returns:
        None where no capture shows the board to both sensors at about the same place.
    """
    deployed = calibration if channel in calibration.channels else _with_channel(calibration, channel)
    detections = Detections({(calibration.camera, channel): dict(images)}, {calibration.lidar: dict(scans)})
    clocks = clocks_of(rig, calibration.camera, calibration.lidar)
    check = check_session(rig, detections, deployed, channel, clocks)
    seen = [meeting.at_scan_time for meeting in check.meetings.values()]
    if not seen or check.metrics is None:
        return None
    cost = _expand(seen, rig.board.to_board(), calibration.T_cam_lidar, rig.lidars[calibration.lidar])
    sigma_deployed = np.sqrt(np.diag(calibration.cov))
    axes = tuple(_judge(axis, cost, float(sigma_deployed[axis])) for axis in range(6))
    return BoardDrift(axes, check.metrics, len(seen), len(cost.groups))


def _with_channel(calibration: Calibration, channel: str) -> Calibration:
    from dataclasses import replace

    return replace(calibration, channels=(*calibration.channels, channel))


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
    unit = float(np.degrees(1.0)) if IS_ROTATION[axis] else 1.0
    p = len(cost.prior)
    alone = cost.of(np.array([axis, *range(6, p)]))
    change = float(alone.optimum()[0])
    variance = float(alone.covariance()[0, 0])
    if len(cost.groups) > 1:
        settled = alone.solve(1 - alone.groups)[:, 0]
        n = len(settled)
        variance = max(variance, (n - 1) / n * float(np.sum((settled - settled.mean()) ** 2)))
    sigma = float(np.sqrt(variance + sigma_deployed**2 + _BIAS[axis] ** 2))
    smallest = (_THRESHOLD_SIGMAS + _POWER_SIGMAS) * sigma
    state: State = "unchanged"
    if abs(change) > _THRESHOLD_SIGMAS * sigma:
        state = "changed"
    elif smallest > _LARGEST[axis]:
        state = "unknown"
    reason = "" if state != "unknown" else "scene.large_scatter"
    return AxisDrift(AXES[axis], state, unit * change, unit * sigma, unit * smallest, reason)
