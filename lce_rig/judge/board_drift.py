"""Compare deployed extrinsics with boards in view, in all six axes together.

The likelihood of `calibrate` estimates the extrinsics from these boards. They differ from the deployed ones
by the tangent x, with covariance C if nothing moved, and x^T C^-1 x is chi-squared with six freedoms.
This is the test of six unknowns that are freed of their prior, the deployed result.

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
from lce_rig.calibrate.result import lever_arm
from lce_rig.calibrate.uncertainty import widen
from lce_rig.core.calibration import MOTIONS, Calibration, State
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, difference, tangent_sizes
from lce_rig.detect.detection import Detections, Pair
from lce_rig.judge.reach import CHANGED_CHI2, JointDifference
from lce_rig.judge.session_check import find_meetings, seen_by_own_lens
from lce_rig.rig import Rig
from lce_rig.scene.findings import BOARD_CHANGED_JOINTLY, BOARD_HIDES

# Standard deviation of the difference between sessions of one rig beyond both covariances, m and rad: three
# recorded sessions of one rig (rlfs01 to rlfs03) differ by up to 7 mm and 0.22 deg.
_BIAS = np.repeat([0.005, np.radians(0.1)], 3)
_POWER_SIGMAS = 1.645  # 95 % of the trials at the smallest change exceed the threshold.
# Largest useful hidden change, as displacement of the boards, m; above it, the boards' result is unknown.
_LARGEST_M = 0.15
_MIN_PLACEMENTS = 3  # Minimum number to determine the scatter.


@dataclass(frozen=True, eq=False)
class BoardDrift(JointDifference):
    """The change from deployed extrinsics to those of boards; its covariance includes the deployed ones' own.

    Attributes:
        n_boards: captures in which both sensors see the board.
        n_placements: places at which it was held.
    """

    n_boards: int
    n_placements: int

    def document(self) -> dict[str, Any]:
        """Return all figures as plain types for JSON."""
        return {
            "state": self.state,
            "n_boards": self.n_boards,
            "n_placements": self.n_placements,
            "change": self.tangent.tolist(),
            "covariance": self.cov.tolist(),
            "chi2": self.chi2,
        }

    @property
    def state(self) -> State:
        """The verdict; unchanged only if a change in any direction would be seen."""
        if self.is_changed:
            return "changed"
        return "unknown" if self._hidden_m > _LARGEST_M else "unchanged"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The significant part of a change, and the largest hidden one, along the least known direction."""
        least_known = self.directions[1][:, -1]
        rotation_deg, translation_m = tangent_sizes(self._hidden_m * least_known / self.scale)
        weights = np.abs(least_known)
        turn, shift = MOTIONS[3 + int(np.argmax(weights[3:]))], MOTIONS[int(np.argmax(weights[:3]))]
        hides = BOARD_HIDES(
            rotation_deg=rotation_deg, translation_m=translation_m, rotation=turn, translation=shift
        )
        if not self.is_changed:
            return (hides,)
        rotation_deg, translation_m = tangent_sizes(self.significant)
        changed = BOARD_CHANGED_JOINTLY(
            axes=self.main_axes,
            sigmas=float(np.sqrt(self.chi2)),
            rotation_deg=rotation_deg,
            translation_m=translation_m,
        )
        return changed, hides

    @property
    def _hidden_m(self) -> float:
        """The largest hidden change, m at the boards: 95 % of trials with it exceed the threshold."""
        return float((np.sqrt(CHANGED_CHI2) + _POWER_SIGMAS) * np.sqrt(self.directions[0][-1]))


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
    return BoardDrift(change, cov, lever_arm(seen), len(seen), n_placements)


def _own_covariance(estimate: JointEstimate, n_placements: int) -> Array:
    """Compute the covariance (6, 6) of the boards' extrinsics without errors of the profile."""
    J = estimate.to_extrinsics[0]
    cov = J @ np.asarray(sum(estimate.covariances)) @ J.T
    return widen(cov, jackknife_scatter(estimate.cost.moves() @ J.T), n_placements)[0]
