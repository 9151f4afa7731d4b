"""Estimate, judge and write the extrinsic of every camera channel with every LiDAR of a session."""

import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

from lce_rig.calibrate import CalibrateOptions, CalibrationEstimate, CaptureCandidates
from lce_rig.calibrate import calibrate as estimate_extrinsic
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.metrics import error_to_reference
from lce_rig.calibrate.verdict import judge
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array
from lce_rig.core.results import Calibration, Refusal
from lce_rig.detect.detection import Detections, Pair
from lce_rig.export.reference import Reference
from lce_rig.pipeline.progress import Progress, silent
from lce_rig.rig import Rig
from lce_rig.session import Session

CALIBRATION, OVERLAYS = "calibration", "overlays"


def calibrate(
    rig: Rig,
    detections: Detections,
    options: CalibrateOptions,
    *,
    reference: Reference | None = None,
    progress: Progress = silent,
) -> tuple[list[tuple[Calibration, CalibrationEstimate]], list[NotEnoughDataError]]:
    """Estimate and judge the extrinsic of every camera channel with every LiDAR.

    Args:
        rig: thresholds, targets and nominal extrinsics.
        detections: of one session.
        options: switches of the algorithm.
        reference: extrinsics to report errors against; they never enter the estimate or the verdict.
        progress: called with (done, total) for each pair in turn.

    Returns:
        The pairs that could be calibrated; and for each other pair why not.

    Raises:
        NotEnoughDataError: every pair has too few captures or leaves a direction open; the causes are named.
    """
    results, troubles = [], []
    for pair in detections.pairs:
        try:
            results.append(_calibrate_pair(rig, detections, pair, options, reference, progress))
        except NotEnoughDataError as error:
            troubles.append(error)
    if not results:
        raise (
            troubles[0]
            if troubles
            else NotEnoughDataError(
                "the session holds no capture with a picture and a scan", "Collect captures first."
            )
        )
    return results, troubles


def _calibrate_pair(
    rig: Rig,
    detections: Detections,
    pair: Pair,
    options: CalibrateOptions,
    reference: Reference | None,
    progress: Progress,
) -> tuple[Calibration, CalibrationEstimate]:
    candidates, refused = _candidates(detections, pair)
    needed = rig.quality.min_captures
    if len(candidates) < needed:
        raise NotEnoughDataError(
            f"{pair}: the board was found by both sensors in {len(candidates)} of "
            f"{len(candidates) + len(refused)} captures, at least {needed} are needed",
            _commonest(refused) or "collect more captures",
        )
    lidar = rig.lidars[pair.lidar]
    pair_options = replace(
        options,
        laser_bias_sigma_m=lidar.laser_bias_sigma_m,
        range_offset_sigma_m=lidar.range_offset_sigma_m,
    )
    estimate = estimate_extrinsic(candidates, rig.board.to_board(), pair_options, progress)
    calibration = _judged(rig, pair, estimate, n_captures=len(candidates) + len(refused), refused=refused)
    truth = reference.of(pair.camera, pair.lidar) if reference else None
    if truth is not None:
        calibration = compare_with_reference(calibration, truth)
    return calibration, estimate


def compare_with_reference(calibration: Calibration, reference: Array) -> Calibration:
    """Report the error against a T_cam_lidar (4, 4) that somebody else vouches for."""
    rotation_deg, translation_m = error_to_reference(calibration.T_cam_lidar, reference)
    return replace(calibration, egt_rotation_deg=rotation_deg, egt_translation_m=translation_m)


def _candidates(detections: Detections, pair: Pair) -> tuple[list[CaptureCandidates], dict[str, Refusal]]:
    candidates, refused = [], {}
    for name in detections.captures(pair):
        image, lidar = detections.of(pair, name)
        if isinstance(image, Refusal):
            refused[name] = image
        elif isinstance(lidar, Refusal):
            refused[name] = lidar
        else:
            candidates.append(CaptureCandidates(name, image, lidar))
    return candidates, refused


def refusals(rig: Rig, detections: Detections, pair: Pair) -> dict[str, Refusal]:
    """Say why captures of a pair cannot be used: a sensor saw no board, or both sensors disagree."""
    candidates, refused = _candidates(detections, pair)
    consensus = find_consensus(candidates, rig.board.to_board()) if len(candidates) >= 3 else None
    return dict(sorted({**refused, **(consensus.refused if consensus else {})}.items()))


def _commonest(refused: dict[str, Refusal]) -> str:
    """List the commonest causes of refusal, one a line."""
    counts = Counter((why.stage, why.cause, why.action) for why in refused.values())
    return "\n".join(
        f"{n} x {stage}: {cause}: {action}" for (stage, cause, action), n in counts.most_common(3)
    )


def _judged(
    rig: Rig, pair: Pair, estimate: CalibrationEstimate, *, n_captures: int, refused: dict[str, Refusal]
) -> Calibration:
    verdict, reasons = judge(estimate, rig, pair.camera, pair.lidar, n_captures)
    return Calibration(
        camera=pair.camera,
        channel=pair.channel,
        lidar=pair.lidar,
        T_cam_lidar=estimate.T_cam_lidar,
        cov=estimate.cov,
        certificate=estimate.certificate,
        metrics=estimate.metrics,
        n_captures=n_captures,
        n_detected=n_captures - len(refused),
        captures_used=estimate.used,
        captures_refused=dict(sorted({**refused, **estimate.refused}.items())),
        verdict=verdict,
        reasons=reasons,
        diagnostics=estimate.diagnostics,
    )


def write_results(session: Session, calibrations: list[Calibration], *, force: bool) -> list[Path]:
    """Write result.json and, unless a verdict forbids it, every export beside it.

    Returns:
        The files written, result.json first.
    """
    from lce_rig.export import remove_exports, write_exports
    from lce_rig.export.result import write_result

    folder = session.path / CALIBRATION
    folder.mkdir(exist_ok=True)
    result = folder / "result.json"
    write_result(result, session.rig.name, calibrations)
    usable = [c for c in calibrations if force or c.verdict != "fail"]
    if not usable:
        remove_exports(folder)
        return [result]
    return [result, *write_exports(usable, session.rig, folder, is_forced=force)]


def remove_results(session: Session) -> None:
    """Remove the result, exports and pictures of an earlier run: they must not pass for this one's."""
    from lce_rig.export import remove_exports

    folder = session.path / CALIBRATION
    if folder.is_dir():
        remove_exports(folder)
        (folder / "result.json").unlink(missing_ok=True)
        shutil.rmtree(folder / OVERLAYS, ignore_errors=True)
