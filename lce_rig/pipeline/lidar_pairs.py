"""Estimate and judge the pose of every two LiDARs that saw the same boards.

detections of both -> estimate as of a camera and a LiDAR -> the same checks -> comparison with the cameras

In a result the first LiDAR of the profile stands in the camera's place: T_cam_lidar takes points from the
second LiDAR's frame to the first's.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lce_rig.calibrate import CalibrateOptions, EstimateSettings
from lce_rig.calibrate.between_lidars import close_loops, estimate_between_lidars
from lce_rig.calibrate.result import capture_residual, summarise
from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, invert, relative_pose
from lce_rig.core.progress import Progress, begin
from lce_rig.core.results import Observation
from lce_rig.detect.detection import Detections, Pair
from lce_rig.judge.sensor_pairs import find_exchanged_lidars, find_other_model, loop_findings
from lce_rig.judge.session_check import match_candidates
from lce_rig.judge.validate import validate
from lce_rig.judge.verdict import judge, with_findings
from lce_rig.pipeline.detect_session import candidates_of
from lce_rig.pipeline.findings import SHORTAGE, few_detected
from lce_rig.rig import Rig


def calibrate_lidar_pairs(
    rig: Rig, detections: Detections, options: CalibrateOptions, progress: Progress
) -> tuple[list[Calibration], list[Finding]]:
    """Estimate and judge every two LiDARs of a session.

    Args:
        rig: the profile.
        detections: of the session.
        options: of the estimate; the method is always of maximum likelihood.
        progress: told what is done.

    Returns:
        The results, and for each other pair the cause.
    """
    calibrations, shortages = [], []
    for pair in detections.lidar_pairs(rig.lidars):
        begin(progress, str(pair))
        try:
            calibrations.append(_calibrate(rig, detections.between(pair), pair, options))
        except NotEnoughDataError as error:
            shortage = error.finding or SHORTAGE(text=error.what, advice=error.hint)
            shortages.append(replace(shortage, subject=str(pair)))
    return calibrations, shortages


def close(calibrations: Sequence[Calibration], rig: Rig) -> list[Calibration]:
    """Compare each two LiDARs with the sensors calibrated to both, and adjust poses that agree.

    A contradiction is a reason against all three results. Otherwise their poses compose exactly afterwards.
    Covariances stay: the estimates share boards, so that the loop need not have made them better. Cameras'
    method "paper" gives Algorithm 1's poses, which are not adjusted.
    """
    of_pair = {(c.camera, c.lidar): c for c in calibrations}
    reasons: dict[tuple[str, str], list[Finding]] = {}
    loops = [((a, b), (b, c), (a, c)) for a, b in of_pair for d, c in of_pair if d == b and (a, c) in of_pair]
    for first, between, second in loops:
        found = loop_findings(of_pair[between], of_pair[first], of_pair[second], rig)
        for pair in (first, second, between):
            reasons.setdefault(pair, []).extend(found)
    judged = {
        pair: with_findings(c, reasons[pair]) if reasons.get(pair) else c for pair, c in of_pair.items()
    }
    sound = {pair for pair, c in judged.items() if c.method == "ml" and c.verdict != "fail"}
    sound -= {pair for pair, found in reasons.items() if found}
    closed = close_loops({pair: (judged[pair].T_cam_lidar, judged[pair].cov) for pair in sound})
    T = {pair: c.T_cam_lidar for pair, c in judged.items()} | closed
    board, calibrations = rig.board.to_board(), []
    for pair, c in judged.items():
        others = {
            name for loop in loops if pair in loop and closed.keys() >= set(loop) for name in sum(loop, ())
        }
        if not others:
            calibrations.append(c)
            continue
        residuals = tuple(
            capture_residual(T[pair], c.observations[r.capture], board, r.held_out_m) for r in c.residuals
        )
        composed = tuple(
            replace(each, T_cam_other=relative_pose(T[pair], T[each.camera, c.lidar])[0])
            for each in c.other_cameras
        )
        calibrations.append(
            replace(
                c,
                T_cam_lidar=T[pair],
                residuals=residuals,
                metrics=summarise(residuals),
                other_cameras=composed,
                estimated_with=tuple(sorted({*c.estimated_with, *others} - set(pair))),
            )
        )
    return calibrations


def _calibrate(rig: Rig, detections: Detections, pair: Pair, options: CalibrateOptions) -> Calibration:
    """Calibrate two LiDARs; raises NotEnoughDataError."""
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
    estimate, rejected, T_view = estimate_between_lidars(candidates, boards, board, settings)
    rejected = [match_candidates(o, board, estimate.T_cam_lidar) for o in rejected]
    validation = validate(estimate, rig, first, second, None, rejected)
    scans = detections.lidars
    n_captures = len(candidates) + len(lacking)
    T = invert(T_view) @ estimate.T_cam_lidar
    others = [
        *find_other_model(first, rig.lidars[first], scans[first].values()),
        *find_other_model(second, rig.lidars[second], scans[second].values()),
        *find_exchanged_lidars(
            T, rig.nominal(first, second), f"{first} and {second}", [rig.lidars[first], rig.lidars[second]]
        ),
    ]
    verdict, findings = judge(estimate, validation, rig, first, second, n_captures, others, T_view)
    R = np.kron(np.eye(2), T_view[:3, :3].T)
    distances_m = [o.image.distance_m for o in estimate.observations.values()]
    return Calibration(
        camera=first,
        channels=(),
        lidar=second,
        T_cam_lidar=T,
        cov=R @ validation.cov @ R.T,
        cov_shared=R @ validation.cov_shared @ R.T,
        contributions=validation.contributions,
        certificate=estimate.certificate,
        metrics=estimate.metrics,
        n_captures=n_captures,
        n_detected=len(candidates),
        captures_used=estimate.used,
        captures_refused=dict(sorted({**lacking, **estimate.refused}.items())),
        verdict=verdict,
        findings=findings,
        diagnostics=estimate.diagnostics,
        method=estimate.method,
        board_distances_m=tuple(np.quantile(distances_m, (0.1, 0.9)).tolist()),
        residuals=estimate.residuals,
        observations={name: _seen_from(invert(T_view), o) for name, o in estimate.observations.items()},
    )


def _seen_from(T: Array, observation: Observation) -> Observation:
    """Express the first LiDAR's pose of the board in another frame of the same origin."""
    return replace(
        observation, image=replace(observation.image, T_cam_board=T @ observation.image.T_cam_board)
    )
