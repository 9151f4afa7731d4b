"""What is held against a result before it is judged: checks that need the captures themselves."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.extrinsics.estimate import CalibrationEstimate
from lce_rig.extrinsics.local_quadratic import SCALE, expand
from lce_rig.lens.lens_estimate import View
from lce_rig.rig import LidarSettings, Rig
from lce_rig.validation.intrinsics_check import IntrinsicsCheck, check_intrinsics
from lce_rig.validation.negative_control import Control, run_control
from lce_rig.validation.nuisances import Nuisances, estimate_nuisances
from lce_rig.validation.resampling_check import resample, widening
from lce_rig.validation.split_consistency import Contrast, contrast_halves

# Fewer placements leave nothing to be left out.
_MIN_PLACEMENTS = 4
# More pictures say no more about a lens that is wrong, and take their time.
_MAX_VIEWS = 40


@dataclass(frozen=True, eq=False)
class Examination:
    """What checks on its own captures found about an estimate.

    Attributes:
        cov: (6, 6) to report: the estimate's, widened where captures spread it farther than it claims.
        widened_by: by how many times the standard deviations were widened; 1 where they were not.
        remark: why; None where they were not.
        contrasts: shares of the captures that ought to agree.
        control: what happens to left-out captures when the result is moved.
        nuisances: what the captures share beside the extrinsic.
        intrinsics: the profile's, against those that the boards ask for; None where too few boards tell.
    """

    cov: Array
    widened_by: float
    remark: Finding | None
    contrasts: tuple[Contrast, ...]
    control: Control | None
    nuisances: Nuisances | None
    intrinsics: IntrinsicsCheck | None


def examine(
    estimate: CalibrationEstimate, rig: Rig, lidar: LidarSettings, lens: Intrinsics, views: Sequence[View]
) -> Examination:
    """Check a result on its own captures.

    Args:
        estimate: the result of any method.
        rig: board, targets and limits.
        lidar: which errors its ranges may have.
        lens: of the camera.
        views: its pictures of the board, of the captures used.
    """
    board = rig.board.to_board()
    intrinsics = check_intrinsics(_thinned(views), lens, board) if views else None
    observations = [estimate.fitted[name] for name in estimate.used]
    expansion = expand(
        observations,
        board,
        estimate.T_cam_lidar,
        laser_bias_sigma_m=lidar.laser_bias_sigma_m,
        range_offset_sigma_m=lidar.range_offset_sigma_m,
    )
    if len(expansion.groups) < _MIN_PLACEMENTS:
        return Examination(estimate.cov, 1.0, None, (), None, None, intrinsics)
    settled = expansion.hold(SCALE).settled()
    # A cost made anew scatters as it does itself: a claim is held against the scatter of its own method.
    widened_by, remark = widening(estimate.cov, resample(estimate.expansion or settled), rig.verdict)
    cov = widened_by**2 * estimate.cov
    control = run_control(
        observations,
        board,
        estimate.T_cam_lidar,
        cov,
        settled,
        rig.calibration,
        rig.verdict.control_sigmas,
    )
    rings = np.unique(np.concatenate([observation.lidar.ring for observation in observations]))
    centres = np.array([observation.image.T_cam_board[:3, 3] for observation in observations])
    nuisances = estimate_nuisances(expansion, rings)
    contrasts = contrast_halves(settled, centres)
    return Examination(cov, widened_by, remark, contrasts, control, nuisances, intrinsics)


def _thinned(views: Sequence[View]) -> list[View]:
    every = -(-len(views) // _MAX_VIEWS)
    return list(views[::every])
