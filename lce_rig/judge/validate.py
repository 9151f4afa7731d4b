"""Checks of a result on its own captures, before the verdict."""

from collections.abc import Sequence
from dataclasses import dataclass

from lce_rig.calibrate.likelihood.hypothesis import Hypothesis
from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.core.calibration import Contribution
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation
from lce_rig.judge.causes import find_causes, hypothesis_of, is_explained, report_causes
from lce_rig.judge.contributions import (
    OF_BOARD,
    channels_contradict,
    list_contributions,
    summed_covariance,
)
from lce_rig.judge.explanations import ALL, Cause
from lce_rig.judge.intrinsics_check import IntrinsicsCheck, compare_with_given, model_findings
from lce_rig.rig import Rig


@dataclass(frozen=True, eq=False)
class Validation:
    """Results of checks of an estimate on its own captures.

    Attributes:
        cov: (6, 6) to report, of extrinsics used with the session's intrinsics: the estimate's, with errors
            of the profile and contradictions.
        cov_agreed: (6, 6) the same without contradictions.
        cov_shared: (6, 6) the part of `cov` from errors of the profile's board and LiDAR.
        contributions: the parts of `cov`, the largest first.
        causes: errors that explain the captures better than noise, the reason first.
        is_explained: whether they bring the planes of both sensors together.
        intrinsics: the profile's compared with those fitted to the boards; None for too few boards.
        lens_model: finding of a lens model in the profile that does not fit the corners.
        hypothesis: the likelihood of all captures; None if they are too few to test.
    """

    cov: Array
    cov_agreed: Array
    cov_shared: Array
    contributions: tuple[Contribution, ...]
    causes: Sequence[Finding]
    is_explained: bool
    intrinsics: IntrinsicsCheck | None
    lens_model: Sequence[Finding]
    hypothesis: Hypothesis | None = None


def validate(
    estimate: CalibrationEstimate,
    rig: Rig,
    camera: str,
    lidar: str,
    lens: Intrinsics | None,
    rejected: Sequence[Observation] = (),
    tested: Sequence[Cause] = ALL,
) -> Validation:
    """Check a result on its own captures.

    Args:
        estimate: the result of any method.
        rig: board, targets and limits.
        camera, lidar: names of the sensors.
        lens: the camera's, from the profile; None for two LiDARs.
        rejected: captures with the board in both sensors that the estimate does not use.
        tested: causes that may explain the captures.
    """
    board, known = rig.board.to_board(), estimate.sensitivities
    fitted = None if estimate.lens is None else estimate.lens.estimate
    intrinsics = None if fitted is None or lens is None else compare_with_given(fitted, lens, board)
    hypothesis = hypothesis_of(estimate, rejected)
    selected = () if hypothesis is None else find_causes(hypothesis, estimate, rig.calibration, tested)
    causes, contradictions = report_causes(selected, estimate, rig, camera, lidar)
    contradictions += channels_contradict(estimate, rig.calibration)
    cov_agreed = estimate.cov + summed_covariance(known)
    return Validation(
        cov=cov_agreed + summed_covariance(contradictions),
        cov_agreed=cov_agreed,
        cov_shared=summed_covariance([each for each in known if each.source in OF_BOARD]),
        contributions=list_contributions(estimate.diagnostics, known, contradictions),
        causes=causes,
        is_explained=is_explained(selected, estimate),
        intrinsics=intrinsics,
        lens_model=[] if fitted is None or lens is None else model_findings(fitted, board),
        hypothesis=hypothesis,
    )
