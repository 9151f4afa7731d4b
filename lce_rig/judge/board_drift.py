"""Compare deployed extrinsics with boards in view: all six axes together, and axis by axis.

The likelihood of `calibrate` estimates the extrinsics from these boards. They differ from the deployed ones
by the tangent x, with covariance C if nothing moved, and x^T C^-1 x is chi-squared with six freedoms.
This is the test of six unknowns that are freed of their prior, the deployed result. If one axis alone
changed, it changed by

    (C^-1 x)_a / (C^-1)_aa,    with variance 1 / (C^-1)_aa                                               (1)

Boards and deployed result share the profile. Errors e of squares, pattern and plate move both, by M_b e and
M_d e, and only the difference remains, zero for boards at the same places. As a rule it is not larger than
either part, so C contains M_d M_d^T, as part of the deployed covariance, and not M_b M_b^T.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.likelihood.fit import JointEstimate, maximise_likelihood
from lce_rig.calibrate.likelihood.levels import what_is_known
from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.options import CalibrateOptions, EstimateSettings, Tolerances
from lce_rig.calibrate.quadratics import jackknife_scatter
from lce_rig.calibrate.result import capture_residual, lever_arm, summarise
from lce_rig.calibrate.uncertainty import widen
from lce_rig.core.calibration import MOTIONS, Calibration, Metrics, State
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, difference, tangent_sizes
from lce_rig.detect.detection import Detections, Pair
from lce_rig.judge.reach import JointDifference
from lce_rig.judge.session_check import find_meetings, seen_by_own_lens
from lce_rig.rig import Rig
from lce_rig.scene.findings import BOARD_CHANGED, BOARD_CHANGED_JOINTLY, BOARD_HIDES, BOARD_UNSURE

# Standard deviation of the difference between sessions of one rig beyond both covariances, m and rad: three
# recorded sessions of one rig (rlfs01 to rlfs03) differ by up to 7 mm and 0.22 deg.
_BIAS = np.repeat([0.005, np.radians(0.1)], 3)
_THRESHOLD_SIGMAS = 3.0  # of the change of one axis
_POWER_SIGMAS = 1.645  # 95 % of the trials at the smallest change exceed the threshold.
# Largest useful detectable change, m and rad; above it, the boards' result is unknown.
_LARGEST = np.repeat([0.10, np.radians(1.5)], 3)
_MIN_PLACEMENTS = 3  # Minimum number to determine the scatter.
# Limit for a change of six axes together: 99.9 % of chi-squared with six degrees of freedom.
_CHANGED_CHI2 = 22.46


@dataclass(frozen=True)
class AxisDrift:
    """Result of the boards for one axis of the extrinsics, with the other axes unchanged.

    Attributes:
        axis: "translation_x" to "rotation_z", axes of the camera.
        state: "unknown" if undetermined.
        change: from the extrinsics to those that fit best, m or deg.
        sigma: standard deviation of `change`, that of the extrinsics included.
        smallest: the smallest change that would be seen in 95 % of trials.
    """

    axis: str
    state: State
    change: float
    sigma: float
    smallest: float

    @property
    def figures(self) -> dict[str, float]:
        """Figures by name with unit, as in findings."""
        unit = "deg" if self.axis.startswith("rotation") else "m"
        return {f"{name}_{unit}": getattr(self, name) for name in ("change", "sigma", "smallest")}

    def document(self) -> dict[str, Any]:
        """Return all figures as plain types for JSON."""
        return {"axis": self.axis, "state": self.state, **self.figures}


@dataclass(frozen=True, eq=False)
class JointDrift(JointDifference):
    """The change of all six axes together; its covariance includes the deployed extrinsics' own."""

    @property
    def is_changed(self) -> bool:
        """Whether the change is significant."""
        return self.chi2 > _CHANGED_CHI2

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes that changed; empty if unchanged."""
        return self.main_axes if self.is_changed else ()

    @property
    def finding(self) -> Finding:
        """The significant part of the change, as a finding."""
        rotation_deg, translation_m = tangent_sizes(self.significant)
        return BOARD_CHANGED_JOINTLY(
            axes=self.axes,
            sigmas=float(np.sqrt(self.chi2)),
            rotation_deg=rotation_deg,
            translation_m=translation_m,
        )

    @property
    def hidden(self) -> Finding:
        """Largest change that the boards cannot detect, along their least determined direction."""
        variances, directions = self.directions
        # A shift of the mean by this much exceeds the threshold in about 95 % of trials.
        size = np.sqrt(_CHANGED_CHI2) + _POWER_SIGMAS
        least_known = directions[:, -1]
        rotation_deg, translation_m = tangent_sizes(size * np.sqrt(variances[-1]) * least_known / self.scale)
        weights = np.abs(least_known)
        turn, shift = MOTIONS[3 + int(np.argmax(weights[3:]))], MOTIONS[int(np.argmax(weights[:3]))]
        return BOARD_HIDES(
            rotation_deg=rotation_deg, translation_m=translation_m, rotation=turn, translation=shift
        )


@dataclass(frozen=True, eq=False)
class BoardDrift:
    """Deployed extrinsics compared with the boards of some captures.

    Attributes:
        axes: verdict of each in the order of MOTIONS, as if no other changed but the one that explains most.
        metrics: residuals of the deployed extrinsics, as in `verify`.
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
        """Return all figures as plain types for JSON."""
        return {
            "state": self.state,
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
    def state(self) -> State:
        """The verdict: changed in one axis or jointly; unchanged only if each axis is known."""
        states = {axis.state for axis in self.axes}
        if self.joint.is_changed or "changed" in states:
            return "changed"
        return "unknown" if "unknown" in states else "unchanged"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All axes together, axes that changed or are undetermined, and the largest hidden change."""
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
        channel: channel of the images.
        detections: detections of the captures.

    Returns:
        None if both sensors see the board at about the same place in fewer than three placements.
    """
    T_cam_lidar, pair = calibration.T_cam_lidar, Pair(calibration.camera, channel, calibration.lidar)
    board, detections = rig.board.to_board(), seen_by_own_lens(rig, detections, calibration)
    meetings = find_meetings(rig, detections, pair, T_cam_lidar, calibration.channel_results)
    try:
        agreed = find_consensus([meeting.at_scan_time for meeting in meetings.values()], board)
    except NotEnoughDataError:
        return None
    seen = agreed.observations
    n_placements = int(group_placements(seen).max()) + 1
    if n_placements < _MIN_PLACEMENTS:
        return None
    lidar = rig.lidars[calibration.lidar]
    tolerances = Tolerances.of(rig.cameras[calibration.camera], rig.board)
    priors, usual = what_is_known(EstimateSettings.of(CalibrateOptions(), lidar, tolerances))
    estimate = maximise_likelihood([seen], board, [agreed.T_cam_lidar], priors, usual)
    cov_deployed = calibration.cov + np.diag(_BIAS**2)
    cov = _own_covariance(estimate, n_placements) + cov_deployed
    change = difference(estimate.T_cam_lidar[0], T_cam_lidar)
    axes = [_judge(axis, change, cov) for axis in range(6)]
    if sum(axis.state == "changed" for axis in axes) > 1:
        # One changed axis looks like several: report the one that explains most, and judge the others without
        # its change.
        alone = [_alone(axis, change, cov) for axis in range(6)]
        first = int(np.argmax([size**2 / variance for size, variance in alone]))
        rest = change - alone[first][0] * np.eye(6)[first]
        axes = [axes[axis] if axis == first else _judge(axis, rest, cov) for axis in range(6)]
    residuals = [capture_residual(T_cam_lidar, each, board) for each in seen]
    joint = JointDrift(change, cov, lever_arm(seen))
    return BoardDrift(tuple(axes), summarise(residuals), len(seen), n_placements, joint)


def _own_covariance(estimate: JointEstimate, n_placements: int) -> Array:
    """Compute the covariance (6, 6) of the boards' extrinsics without errors of the profile."""
    J = estimate.to_extrinsics[0]
    cov = J @ np.asarray(sum(estimate.covariances)) @ J.T
    return widen(cov, jackknife_scatter(estimate.cost.moves() @ J.T), n_placements)[0]


def _alone(axis: int, change: Array, cov: Array) -> tuple[float, float]:
    """Estimate the change of one axis, if no other changed, and its variance: equation (1)."""
    information = np.linalg.inv(cov)
    return float(information[axis] @ change / information[axis, axis]), float(1 / information[axis, axis])


def _judge(axis: int, change: Array, cov: Array) -> AxisDrift:
    """Judge one axis of a change (6,) with covariance (6, 6), if no other changed."""
    unit = float(np.degrees(1.0)) if axis > 2 else 1.0
    size, variance = _alone(axis, change, cov)
    sigma = float(np.sqrt(variance))
    smallest = (_THRESHOLD_SIGMAS + _POWER_SIGMAS) * sigma
    state: State = "unchanged"
    if abs(size) > _THRESHOLD_SIGMAS * sigma:
        state = "changed"
    elif smallest > _LARGEST[axis]:
        state = "unknown"
    return AxisDrift(MOTIONS[axis], state, unit * size, unit * sigma, unit * smallest)
