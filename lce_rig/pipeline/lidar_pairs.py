"""Two LiDARs that saw the same boards: their captures, and the judgement of their pose.

In a result the first LiDAR of the profile stands in the camera's place: T_cam_lidar takes points from the
second LiDAR's frame to the first's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate import CalibrateOptions, CalibrationEstimate, EstimateSettings
from lce_rig.calibrate.between_lidars import LidarPair, match_lidars
from lce_rig.calibrate.rig_estimate import estimate_rig
from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import Array, invert
from lce_rig.core.progress import Progress, begin
from lce_rig.core.results import Observation
from lce_rig.detect.detection import Detections, Pair
from lce_rig.judge.sensor_pairs import find_exchanged_lidars, find_other_model
from lce_rig.judge.session_check import match_candidates
from lce_rig.judge.validate import Validation, validate
from lce_rig.judge.verdict import judge
from lce_rig.pipeline.detect_session import candidates_of
from lce_rig.pipeline.findings import SHORTAGE, few_detected
from lce_rig.rig import Rig


@dataclass(frozen=True, eq=False)
class SolvedLidars:
    """Two LiDARs, and the result of their captures.

    Attributes:
        pair: the first in the camera's place.
        n_detected: captures with a board in both scans.
        refused: why others are unusable.
        given: the captures that agree.
        estimate: of the second LiDAR's pose in an optical frame of the first.
        validation: of the estimate.
    """

    pair: Pair
    n_detected: int
    refused: Mapping[str, Refusal]
    given: LidarPair
    estimate: CalibrationEstimate
    validation: Validation

    @property
    def names(self) -> tuple[str, str]:
        """Of the first and the second LiDAR."""
        return self.pair.camera, self.pair.lidar

    @property
    def T_first_second(self) -> Array:
        """(4, 4) pose of the second LiDAR in the first one's frame."""
        return np.asarray(invert(self.given.T_view) @ self.estimate.T_cam_lidar)

    @property
    def to_first(self) -> Array:
        """(6, 6) rotation of tangents into the first LiDAR's frame."""
        return np.kron(np.eye(2), self.given.T_view[:3, :3].T)

    @property
    def cov(self) -> Array:
        """(6, 6) of `T_first_second`."""
        return np.asarray(self.to_first @ self.validation.cov @ self.to_first.T)


def solve_lidar_pairs(
    rig: Rig, detections: Detections, options: CalibrateOptions, progress: Progress
) -> tuple[list[SolvedLidars], list[Finding]]:
    """Estimate the pose of every two LiDARs of a session from their own captures alone.

    Args:
        rig: the profile.
        detections: of the session.
        options: of the estimate; the method is always of maximum likelihood.
        progress: told what is done.

    Returns:
        The results, and for each other pair the cause.
    """
    solved, shortages = [], []
    for pair in detections.lidar_pairs(rig.lidars):
        begin(progress, str(pair))
        try:
            solved.append(_solve(rig, detections.between(pair), pair, options))
        except NotEnoughDataError as error:
            shortage = error.finding or SHORTAGE(text=error.what, advice=error.hint)
            shortages.append(replace(shortage, subject=str(pair)))
    return solved, shortages


def with_estimate(rig: Rig, own: SolvedLidars, estimate: CalibrationEstimate) -> SolvedLidars:
    """Replace the estimate and check it anew."""
    return replace(own, estimate=estimate, validation=_validate(rig, own.pair, own.given, estimate))


def find_named(rig: Rig, detections: Detections, own: SolvedLidars) -> list[Finding]:
    """Find LiDARs whose scans came under another name."""
    (first, second), scans = own.names, detections.lidars
    lidars = [rig.lidars[first], rig.lidars[second]]
    return [
        *find_other_model(first, lidars[0], scans[first].values()),
        *find_other_model(second, lidars[1], scans[second].values()),
        *find_exchanged_lidars(own.T_first_second, rig.nominal(first, second), str(own.pair), lidars),
    ]


def judged_lidars(rig: Rig, own: SolvedLidars, others: Sequence[Finding]) -> Calibration:
    """Judge the pose of two LiDARs and assemble the result.

    Args:
        rig: the profile.
        own: the LiDARs.
        others: findings of other evidence.
    """
    (first, second), estimate, validation = own.names, own.estimate, own.validation
    n_captures = own.n_detected + len(own.refused)
    verdict, findings = judge(estimate, validation, rig, first, second, n_captures, others, own.given.T_view)
    distances_m = [o.image.distance_m for o in estimate.observations.values()]
    T_first = invert(own.given.T_view)
    return Calibration(
        camera=first,
        channels=(),
        lidar=second,
        T_cam_lidar=own.T_first_second,
        cov=own.cov,
        cov_shared=own.to_first @ validation.cov_shared @ own.to_first.T,
        contributions=validation.contributions,
        certificate=estimate.certificate,
        metrics=estimate.metrics,
        n_captures=n_captures,
        n_detected=own.n_detected,
        captures_used=estimate.used,
        captures_refused=dict(sorted({**own.refused, **estimate.refused}.items())),
        verdict=verdict,
        findings=findings,
        diagnostics=estimate.diagnostics,
        method=estimate.method,
        estimated_with=estimate.estimated_with,
        board_distances_m=tuple(np.quantile(distances_m, (0.1, 0.9)).tolist()),
        residuals=estimate.residuals,
        observations={name: _seen_from(T_first, o) for name, o in estimate.observations.items()},
    )


def _solve(rig: Rig, detections: Detections, pair: Pair, options: CalibrateOptions) -> SolvedLidars:
    """Estimate the pose of two LiDARs; raises NotEnoughDataError."""
    first, second = pair.camera, pair.lidar
    board = rig.board.to_board()
    candidates, lacking = candidates_of(detections, pair)
    if len(candidates) < rig.quality.min_captures:
        raise NotEnoughDataError.of(
            few_detected(str(pair), len(candidates), lacking, rig.quality.min_captures)
        )
    places = {each.capture: detections.lidars[first][each.capture] for each in candidates}
    boards = {name: found for name, found in places.items() if isinstance(found, list)}
    settings = (
        EstimateSettings.of(options, rig.lidars[first]),
        EstimateSettings.of(options, rig.lidars[second]),
    )
    given = match_lidars(candidates, boards, board, settings)
    estimate = estimate_rig({}, {(first, second): given}, board, [first, second]).estimates[first, second]
    validation = _validate(rig, pair, given, estimate)
    return SolvedLidars(pair, len(candidates), lacking, given, estimate, validation)


def _validate(rig: Rig, pair: Pair, given: LidarPair, estimate: CalibrationEstimate) -> Validation:
    board = rig.board.to_board()
    rejected = [match_candidates(o, board, estimate.T_cam_lidar) for o in given.rejected]
    return validate(estimate, rig, pair.camera, pair.lidar, None, rejected)


def _seen_from(T: Array, observation: Observation) -> Observation:
    """Express the first LiDAR's pose of the board in another frame of the same origin."""
    return replace(
        observation, image=replace(observation.image, T_cam_board=T @ observation.image.T_cam_board)
    )
