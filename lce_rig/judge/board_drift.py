"""What boards in view say about deployed extrinsics: `verify`'s residuals, axis by axis and all together.

Pitch and height hide each other axis by axis: boards at one distance allow either. All six axes together have
the change x with covariance C, of the boards and the deployed extrinsics, and x^T C^-1 x is chi-squared.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lce_rig.calibrate.quadratics import Quadratics, jackknife_scatter
from lce_rig.calibrate.result import capture_residual, lever_arm, summarise
from lce_rig.core.board import Board
from lce_rig.core.calibration import MOTIONS, AxisDrift, Calibration, Metrics, State
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, PoseDifference, perturb, tangent_sizes
from lce_rig.core.results import Observation
from lce_rig.detect.detection import Detections, Pair
from lce_rig.judge.local_quadratic import OF_PROFILE, expand
from lce_rig.judge.session_check import find_meetings, seen_by_own_lens
from lce_rig.rig import LidarSettings, Rig
from lce_rig.scene.alignment import IS_ROTATION
from lce_rig.scene.drift import LARGEST, POWER_SIGMAS, THRESHOLD_SIGMAS
from lce_rig.scene.findings import BOARD_CHANGED, BOARD_CHANGED_JOINTLY, BOARD_HIDES, BOARD_UNSURE

# What results of one rig differ by from session to session, m and rad, order of MOTIONS.
_BIAS = np.array([0.005, 0.005, 0.010, *np.radians([0.12, 0.10, 0.12])])
# Without rings, outlines grow by the beam differently on each side, and squares whose ranges differ tilt
# the plane: boards of a recorded Avia disagree with their own result by 25 mm and 0.7 deg.
_BIAS_WITHOUT_RINGS = np.array([0.02, 0.02, 0.02, *np.radians([0.3, 0.3, 0.3])])
_OUTLIER = 3.0  # times the median residual
_MIN_PLACEMENTS = 3  # The scatter of fewer says little.
# Six axes together changed beyond this, 99.9 % of the chi-squared distribution with six degrees of freedom.
_CHANGED_CHI2 = 22.46
# Axes of a joint change are those that moved by so many of their own standard deviations, or the farthest.
_NAMED_SIGMAS = 2.0


@dataclass(frozen=True, eq=False)
class JointDrift(PoseDifference):
    """The change of all six axes together; its covariance includes the deployed extrinsics' own.

    Attributes:
        lever_m: rms distance of the boards, which makes angles comparable with distances.
    """

    lever_m: float

    @property
    def is_changed(self) -> bool:
        """Whether the change is significant."""
        return self.chi2 > _CHANGED_CHI2

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes that moved; none without a significant change."""
        if not self.is_changed:
            return ()
        sizes = np.abs(self.tangent) / np.sqrt(np.diag(self.cov))
        return tuple(np.array(MOTIONS)[sizes >= min(_NAMED_SIGMAS, sizes.max())].tolist())

    @property
    def finding(self) -> Finding:
        """The change, as a finding."""
        return BOARD_CHANGED_JOINTLY(axes=self.axes, sigmas=float(np.sqrt(self.chi2)), **self.sizes)

    @property
    def hidden(self) -> Finding:
        """The largest change that the boards would not show, along the direction that they know least."""
        scale = np.r_[np.ones(3), np.full(3, self.lever_m)]
        values, vectors = np.linalg.eigh(self.cov * np.outer(scale, scale))
        # A shift of the mean by this much exceeds the threshold in about 95 % of trials.
        size = np.sqrt(_CHANGED_CHI2) + POWER_SIGMAS
        rotation_deg, translation_m = tangent_sizes(size * np.sqrt(values[-1]) * vectors[:, -1] / scale)
        weights = np.abs(vectors[:, -1])
        turn, shift = MOTIONS[3 + int(np.argmax(weights[3:]))], MOTIONS[int(np.argmax(weights[:3]))]
        return BOARD_HIDES(
            rotation_deg=rotation_deg, translation_m=translation_m, rotation=turn, translation=shift
        )


@dataclass(frozen=True, eq=False)
class BoardDrift:
    """Deployed extrinsics compared with the boards of some captures.

    Attributes:
        axes: one verdict each, order of MOTIONS, were it the only one that changed besides the one that
            explains most.
        metrics: residuals of the deployed extrinsics, as `verify` has them.
        n_boards: captures in which both sensors see the board.
        n_placements: places at which it was held.
        joint: the change of all axes together.
    """

    axes: tuple[AxisDrift, ...]
    metrics: Metrics
    n_boards: int
    n_placements: int
    joint: JointDrift

    def document(self) -> dict[str, Any]:
        """List everything as plain types for JSON."""
        return {
            "n_boards": self.n_boards,
            "n_placements": self.n_placements,
            "mpe_m": self.metrics.mpe_m,
            "mee_m": self.metrics.mee_m,
            "axes": [axis.document() for axis in self.axes],
            "joint": {
                "change": self.joint.tangent.tolist(),
                "covariance": self.joint.cov.tolist(),
                "chi2": self.joint.chi2,
            },
        }

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All axes together, axes that the boards find changed or cannot tell, and what they hide."""
        joint = (self.joint.finding,) if self.joint.is_changed else ()
        axes = tuple(
            (BOARD_CHANGED if axis.state == "changed" else BOARD_UNSURE)(axis.axis, **axis.figures)
            for axis in self.axes
            if axis.state != "unchanged"
        )
        return (*joint, *axes, self.joint.hidden)


def watch_boards(
    rig: Rig, calibration: Calibration, channel: str, detections: Detections
) -> BoardDrift | None:
    """Compare deployed extrinsics with boards.

    Args:
        rig: the profile.
        calibration: the deployed extrinsics.
        channel: of the images.
        detections: of the captures.

    Returns:
        None where both sensors see the board at about the same place in fewer than three placements.
    """
    T_cam_lidar, pair = calibration.T_cam_lidar, Pair(calibration.camera, channel, calibration.lidar)
    board, detections = rig.board.to_board(), seen_by_own_lens(rig, detections, calibration)
    meetings = find_meetings(rig, detections, pair, T_cam_lidar, calibration.channel_results)
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
    cov_deployed = calibration.cov + np.diag((_BIAS if lidar.has_rings else _BIAS_WITHOUT_RINGS) ** 2)
    sigmas = np.sqrt(np.diag(cov_deployed))
    axes = [_judge(axis, cost, float(sigmas[axis])) for axis in range(6)]
    if sum(axis.state == "changed" for axis in axes) > 1:
        # One changed axis looks like several: that which explains most is changed, others are judged anew.
        alone = [_alone(cost, axis) for axis in range(6)]
        first = int(np.argmax([each.optimum()[0] ** 2 / each.covariance()[0, 0] for each in alone]))
        moved = perturb(calibration.T_cam_lidar, alone[first].optimum()[0] * np.eye(6)[first])
        rest = _expand(seen, board, moved, lidar)
        axes = [axes[axis] if axis == first else _judge(axis, rest, float(sigmas[axis])) for axis in range(6)]
    # The covariance of all axes by residuals, or by the jackknife if that is wider.
    change, cov, without_each = cost.optimum()[:6], cost.covariance()[:6, :6], cost.without_each()[:, :6]
    scatter = jackknife_scatter(without_each - without_each.mean(axis=0))
    wider = max(float(np.trace(np.linalg.solve(cov, scatter))) / 6, 1.0)
    joint = JointDrift(change, wider * cov + cov_deployed, lever_arm(seen))
    return BoardDrift(tuple(axes), summarise(residuals), len(seen), len(cost.groups), joint)


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
    return cost.hold(OF_PROFILE)


def _judge(axis: int, cost: Quadratics, sigma_deployed: float) -> AxisDrift:
    """Estimate the change of one axis alone; the larger variance of residuals and jackknife counts."""
    unit = float(np.degrees(1.0)) if IS_ROTATION[axis] else 1.0
    alone = _alone(cost, axis)
    change = float(alone.optimum()[0])
    variance = float(alone.covariance()[0, 0])
    without_each = alone.without_each()[:, :1]
    variance = max(variance, float(jackknife_scatter(without_each - without_each.mean())[0, 0]))
    sigma = float(np.sqrt(variance + sigma_deployed**2))
    smallest = (THRESHOLD_SIGMAS + POWER_SIGMAS) * sigma
    state: State = "unchanged"
    if abs(change) > THRESHOLD_SIGMAS * sigma:
        state = "changed"
    elif smallest > LARGEST[axis]:
        state = "unknown"
    reason = "" if state != "unknown" else "scene.board_unsure"
    return AxisDrift(MOTIONS[axis], state, unit * change, unit * sigma, unit * smallest, reason)
