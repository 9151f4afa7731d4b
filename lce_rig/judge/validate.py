"""Checks of a result on its own captures, before the verdict.

They have a cost of their own (`local_quadratic.py`), on purpose: the likelihood gives contradicting captures
less weight, and so hides them from a check by its own cost. By that cost, two groups of captures that
disagree by 1.1 and 1.2 deg (acfr_vlp16, os1_64) are not found; acfr_vlp16, 1.0 deg and 51 mm from its
reference, would be reported to 0.22 deg and 10 mm instead of 0.59 deg and 24 mm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.core.calibration import Contribution
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation
from lce_rig.judge.contributions import (
    find_contradictions,
    list_contributions,
    profile_covariance,
)
from lce_rig.judge.intrinsics_check import IntrinsicsCheck, compare_with_given
from lce_rig.judge.laser_angles import estimate_angles
from lce_rig.judge.local_quadratic import SCALE, expand, scale_of
from lce_rig.judge.rejected_captures import find_moved
from lce_rig.judge.split_consistency import Contrast, contrast_halves, find_groups, objections
from lce_rig.rig import LidarSettings, Rig

# Fewer placements do not allow leave-one-out.
_MIN_PLACEMENTS = 4


@dataclass(frozen=True, eq=False)
class Validation:
    """Results of checks of an estimate on its own captures.

    Attributes:
        cov: (6, 6) to report, of extrinsics used with the session's intrinsics: the estimate's, with errors
            of the profile and what checks contradict.
        cov_agreed: (6, 6) the same without what checks contradict.
        cov_shared: (6, 6) the part of `cov` from errors of the profile's board and LiDAR.
        contributions: its causes, the largest first.
        contrasts: subsets of the captures that should agree.
        scale: as `scale_of`; None for too few placements.
        laser_angles: errors of the lasers' angles in deg, as `estimate_angles`.
        intrinsics: the profile's compared with those fitted to the boards; None for too few boards.
    """

    cov: Array
    cov_agreed: Array
    cov_shared: Array
    contributions: tuple[Contribution, ...]
    contrasts: tuple[Contrast, ...]
    scale: tuple[float, float] | None
    laser_angles: Mapping[str, float]
    intrinsics: IntrinsicsCheck | None


def validate(
    estimate: CalibrationEstimate,
    rig: Rig,
    lidar: LidarSettings,
    lens: Intrinsics,
    rejected: Sequence[Observation] = (),
) -> Validation:
    """Check a result on its own captures.

    Args:
        estimate: the result of any method.
        rig: board, targets and limits.
        lidar: its range error settings.
        lens: of the camera, as the profile says.
        rejected: captures in which both sensors see the board, that the estimate does not use.
    """
    board, known = rig.board.to_board(), estimate.sensitivities
    fitted = None if estimate.lens is None else estimate.lens.estimate
    intrinsics = None if fitted is None else compare_with_given(fitted, lens, board)[0]
    scale = None
    contrasts: tuple[Contrast, ...] = ()
    laser_angles: Mapping[str, float] = {}
    observations = [estimate.fitted[name] for name in estimate.used]
    expansion = expand(
        observations,
        board,
        estimate.T_cam_lidar,
        laser_bias_sigma_m=lidar.laser_bias_sigma_m,
        range_offset_sigma_m=lidar.range_offset_sigma_m,
    )
    if len(expansion.groups) >= _MIN_PLACEMENTS:
        settled = expansion.hold(SCALE).settled()
        centres = np.array([observation.image.T_cam_board[:3, 3] for observation in observations])
        of_rejected = find_moved(observations, rejected, board, estimate.T_cam_lidar, lidar)
        contrasts = (*of_rejected, *contrast_halves(settled, centres), *find_groups(settled))
        scale = scale_of(expansion)
        # Captures of another mounting would look like other angles.
        apart = {
            name
            for each in objections(contrasts, rig.calibration, rig.verdict)
            for name in each.minority(estimate.used)
        }
        agreeing = [observation for observation in observations if observation.capture not in apart]
        if lidar.has_rings and len(set(group_placements(agreeing))) >= _MIN_PLACEMENTS:
            laser_angles = estimate_angles(agreeing, board, estimate.T_cam_lidar, lidar)
    contradictions = list(find_contradictions(estimate, scale, contrasts, rig))
    cov_agreed = estimate.cov + profile_covariance(known)
    return Validation(
        cov=cov_agreed + sum(each.cov for each in contradictions),
        cov_agreed=cov_agreed,
        # Each session has fitted its own lens.
        cov_shared=profile_covariance([each for each in known if each.source != "intrinsics"]),
        contributions=list_contributions(estimate.diagnostics, known, contradictions),
        contrasts=contrasts,
        scale=scale,
        laser_angles=laser_angles,
        intrinsics=intrinsics,
    )
