"""One camera and one LiDAR: reject pairs that disagree, then apply the method of the options."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from lce_rig.calibrate.algorithm_1.algorithm import calibrate_by_algorithm_1
from lce_rig.calibrate.consensus import Consensus, find_consensus
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.likelihood.calibrate_jointly import calibrate_by_likelihood
from lce_rig.calibrate.options import CaptureCandidates, EstimateSettings, Estimator
from lce_rig.core.board import Board
from lce_rig.core.calibration import Method
from lce_rig.core.findings import Finding
from lce_rig.core.results import Observation
from lce_rig.words import not_enough

Progress = Callable[[int, int], None]

# Three planes determine six unknowns.
_MIN_CAPTURES = 3
METHODS: Mapping[Method, Estimator] = {
    "ml": calibrate_by_likelihood,
    "paper": calibrate_by_algorithm_1,
}
"""Name -> function that estimates T_cam_lidar from matched boards."""


def fit_extrinsic(
    candidates: Sequence[CaptureCandidates],
    board: Board,
    options: EstimateSettings | None = None,
    progress: Progress | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from both sensors' detections.

    Args:
        candidates: of each capture with detections of both sensors, in any order.
        board: its specification.
        options: switches of the algorithm.
        progress: called with (subsets done, subsets in all).

    Raises:
        NotEnoughDataError: too few captures, captures that agree with no extrinsics, or captures that leave a
            direction undetermined, which is named.
    """
    options = options or EstimateSettings()
    consensus = agree(candidates, board)
    estimate = calibrate_observations(consensus.observations, board, options, progress)
    return with_consensus(estimate, consensus)


def calibrate_observations(
    observations: Sequence[Observation],
    board: Board,
    options: EstimateSettings,
    progress: Progress | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar by the settings' method from matched boards.

    Args:
        observations: one per capture.
        board: its specification.
        options: switches of the algorithm.
        progress: called with (subsets done, subsets in all).

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    estimator = options.estimator or METHODS[options.method]
    estimate = estimator(observations, board, options, progress)
    return replace(estimate, method=options.method)


def with_consensus(estimate: CalibrationEstimate, consensus: Consensus) -> CalibrationEstimate:
    """Add the consensus's refusals to an estimate."""
    return replace(
        estimate,
        refused=dict(sorted({**consensus.refused, **estimate.refused}.items())),
        diagnostics=replace(estimate.diagnostics, n_alternative_poses=float(consensus.n_alternative_poses)),
    )


def agree(candidates: Sequence[CaptureCandidates], board: Board) -> Consensus:
    """Find the consensus, or explain why there is none.

    Raises:
        NotEnoughDataError: too few captures, or captures that agree with no extrinsics.
    """
    needed = _MIN_CAPTURES
    if len(candidates) < needed:
        figures = {"n_captures": len(candidates), "n_needed": needed}
        raise not_enough(Finding("shortage.few_captures", "warning", figures=figures))
    consensus = find_consensus(candidates, board)
    n_agreeing = 0 if consensus is None else len(consensus.observations)
    if consensus is None or n_agreeing < needed:
        figures = {"n_agreeing": n_agreeing, "n_captures": len(candidates), "n_needed": needed}
        raise not_enough(Finding("shortage.few_agree", "warning", figures=figures))
    return consensus
