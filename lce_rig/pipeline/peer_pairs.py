"""Two sensors of one kind that saw the same boards: their captures, and the verdict on their pose.

In a result T_cam_lidar takes points from the second sensor's frame to the first's. Two cameras are paired
if one of them has no LiDAR; if both have one, its result relates them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate import CalibrateOptions, CalibrationEstimate, EstimateSettings
from lce_rig.calibrate.between_cameras import StereoPair, match_cameras
from lce_rig.calibrate.between_lidars import LidarPair, match_lidars
from lce_rig.calibrate.options import Tolerances
from lce_rig.calibrate.rig_estimate import estimate_rig
from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.core.calibration import Calibration, ChannelResult
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import Array, invert
from lce_rig.core.progress import Progress, begin
from lce_rig.core.results import Observation, PatternBoard
from lce_rig.detect.detection import Detections, Pair
from lce_rig.judge.explanations import MOUNTINGS
from lce_rig.judge.moved_sensor import PairCosts
from lce_rig.judge.sensor_pairs import find_exchanged_lidars, find_other_model
from lce_rig.judge.session_check import match_candidates
from lce_rig.judge.validate import Validation, validate
from lce_rig.judge.verdict import judge
from lce_rig.pipeline.findings import SHORTAGE, few_detected
from lce_rig.rig import Rig


@dataclass(frozen=True, eq=False)
class SolvedPeers:
    """Two LiDARs or two cameras, and the result of their captures.

    Attributes:
        pair: the sensors.
        n_detected: captures with a board in both.
        refused: why each other capture is unusable.
        given: the boards of the captures that agree.
        estimate: pose of the second camera in the first one's frame; of the second LiDAR, in an optical frame
            at the first.
        validation: validation of the estimate.
    """

    pair: Pair
    n_detected: int
    refused: Mapping[str, Refusal]
    given: LidarPair | StereoPair
    estimate: CalibrationEstimate
    validation: Validation

    @property
    def names(self) -> tuple[str, str]:
        """Names of the first and the second sensor."""
        return self.pair.camera, self.pair.lidar

    @property
    def T_view(self) -> Array:
        """Transform (4, 4) from the first sensor's frame to that of the estimate."""
        return np.eye(4) if isinstance(self.given, StereoPair) else self.given.T_view

    @property
    def T_first_second(self) -> Array:
        """Pose (4, 4) of the second sensor in the first one's frame."""
        return np.asarray(invert(self.T_view) @ self.estimate.T_cam_lidar)

    @property
    def costs(self) -> PairCosts:
        """Costs of the captures, which reveal a motion of either sensor."""
        return PairCosts.of(self.names, self.estimate, self.validation, self.T_view)

    @property
    def to_first(self) -> Array:
        """Rotation (6, 6) of tangents into the first sensor's frame."""
        return np.kron(np.eye(2), self.T_view[:3, :3].T)

    @property
    def cov(self) -> Array:
        """(6, 6) of `T_first_second`."""
        return np.asarray(self.to_first @ self.validation.cov @ self.to_first.T)


def solve_peers(
    rig: Rig,
    detections: Detections,
    pairs: Sequence[Pair],
    options: CalibrateOptions,
    lenses: Mapping[str, SessionLens | None],
    progress: Progress,
) -> tuple[list[SolvedPeers], list[Finding]]:
    """Estimate the relative pose of every two sensors of one kind from their own captures.

    Args:
        rig: the profile.
        detections: detections of the session.
        pairs: pairs of two LiDARs or two cameras.
        options: options of the estimate; the method is always maximum likelihood.
        lenses: lenses of cameras that were already fitted.
        progress: called with each pair.

    Returns:
        The results, and for each other pair the cause.
    """
    solved, shortages = [], []
    for pair in pairs:
        begin(progress, str(pair))
        try:
            solved.append(_solve(rig, detections, pair, options, lenses))
        except NotEnoughDataError as error:
            shortage = error.finding or SHORTAGE(text=error.what, advice=error.hint)
            # A camera with few scans of a LiDAR lacks those: that is reported with the LiDAR.
            if pair in detections.peers(rig.lidars):
                figures = {**shortage.figures, "sensors": (pair.camera, pair.lidar)}
                shortages.append(replace(shortage, subject=str(pair), figures=figures))
    return solved, shortages


def with_estimate(rig: Rig, own: SolvedPeers, estimate: CalibrationEstimate) -> SolvedPeers:
    """Replace the estimate and validate it again."""
    return replace(own, estimate=estimate, validation=_validate(rig, own.pair, own.given, estimate))


def find_named(rig: Rig, detections: Detections, own: SolvedPeers) -> list[Finding]:
    """Find LiDARs whose scans are exchanged."""
    if own.pair.lidar_channel:
        return []
    (first, second), scans = own.names, detections.lidars
    lidars = [rig.lidars[first], rig.lidars[second]]
    return [
        *find_other_model(first, lidars[0], scans[first].values()),
        *find_other_model(second, lidars[1], scans[second].values()),
        *find_exchanged_lidars(own.T_first_second, rig.nominal(first, second), str(own.pair), lidars),
    ]


def judged_peers(rig: Rig, own: SolvedPeers, others: Sequence[Finding]) -> Calibration:
    """Judge the pose of two sensors and assemble the result.

    Args:
        rig: the profile.
        own: the sensors.
        others: findings of other evidence.
    """
    (first, second), estimate, validation = own.names, own.estimate, own.validation
    n_captures = own.n_detected + len(own.refused)
    verdict, findings = judge(estimate, validation, rig, first, second, n_captures, others, own.T_view)
    distances_m = [o.pose.distance_m for o in estimate.observations.values()]
    T_first, lens, other = invert(own.T_view), estimate.lens, estimate.lens_of_base
    channels: tuple[ChannelResult, ...] = ()
    if own.pair.lidar_channel:
        noise_px = np.sqrt(np.mean([o.image.sigma_px**2 for o in estimate.observations.values()]))
        channels = (ChannelResult(own.pair.channel, len(estimate.used), float(noise_px)),)
    return Calibration(
        camera=first,
        channels=tuple(each.channel for each in channels),
        lidar_channel=own.pair.lidar_channel,
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
        channel_results=channels,
        intrinsics=None if lens is None else lens.intrinsics,
        lidar_intrinsics=None if other is None else other.intrinsics,
        method=estimate.method,
        estimated_with=estimate.estimated_with,
        board_distances_m=tuple(np.quantile(distances_m, (0.1, 0.9)).tolist()),
        residuals=estimate.residuals,
        observations={name: _seen_from(T_first, o) for name, o in estimate.observations.items()},
    )


def _solve(
    rig: Rig,
    detections: Detections,
    pair: Pair,
    options: CalibrateOptions,
    lenses: Mapping[str, SessionLens | None],
) -> SolvedPeers:
    """Estimate the pose of two sensors; raises NotEnoughDataError."""
    names, board = (pair.camera, pair.lidar), rig.board.to_board()
    candidates, lacking = detections.candidates(pair, board)
    if len(candidates) < rig.quality.min_captures:
        raise NotEnoughDataError.of(
            few_detected(str(pair), len(candidates), lacking, rig.quality.min_captures)
        )
    given: LidarPair | StereoPair
    if pair.lidar_channel:
        first, second = (
            EstimateSettings(
                options.method, tolerances=Tolerances.of(rig.cameras[name], rig.board), lens=lenses.get(name)
            )
            for name in names
        )
        seen = {
            o.capture: (o.image, o.surface.image) for o in candidates if isinstance(o.surface, PatternBoard)
        }
        given = match_cameras(seen, board, (first, second))
    else:
        first, second = (EstimateSettings.of(options, rig.lidars[name]) for name in names)
        places = {each.capture: detections.lidars[pair.camera][each.capture] for each in candidates}
        boards = {name: found for name, found in places.items() if isinstance(found, list)}
        given = match_lidars(candidates, boards, board, (first, second))
    of_lidars = [name for name in names if name in rig.lidars]
    estimate = estimate_rig({}, {names: given}, board, of_lidars).estimates[names]
    return SolvedPeers(pair, len(candidates), lacking, given, estimate, _validate(rig, pair, given, estimate))


def _validate(
    rig: Rig, pair: Pair, given: LidarPair | StereoPair, estimate: CalibrationEstimate
) -> Validation:
    board = rig.board.to_board()
    lens = rig.cameras[pair.camera].to_intrinsics() if pair.lidar_channel else None
    rejected = [match_candidates(o, board, estimate.T_cam_lidar) for o in given.rejected]
    return validate(estimate, rig, pair.camera, pair.lidar, lens, rejected, MOUNTINGS)


def _seen_from(T: Array, observation: Observation) -> Observation:
    """Express the first LiDAR's pose of the board in another frame of the same origin."""
    pose = observation.pose
    return replace(observation, pose=replace(pose, T_cam_board=T @ pose.T_cam_board))
