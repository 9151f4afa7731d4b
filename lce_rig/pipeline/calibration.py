"""Estimate and judge the extrinsic of every camera with every LiDAR of a session."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from lce_rig.calibrate import (
    CalibrateOptions,
    CalibrationEstimate,
    CaptureCandidates,
    ChannelsEstimate,
    Clocks,
    calibrate_channels,
)
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.examination import Examination, examine
from lce_rig.calibrate.intrinsics_estimate import View
from lce_rig.calibrate.metrics import error_to_reference
from lce_rig.calibrate.reach import point_uncertainties
from lce_rig.calibrate.verdict import judge
from lce_rig.core.errors import NotEnoughDataError, UsageError
from lce_rig.core.geometry import Array
from lce_rig.core.results import Calibration, ImageBoard, Refusal
from lce_rig.detect.detection import Detections, Pair
from lce_rig.export.reference import Reference
from lce_rig.pipeline.progress import Progress, silent
from lce_rig.rig import Rig


def calibrate(
    rig: Rig,
    detections: Detections,
    options: CalibrateOptions,
    *,
    channels: Sequence[str] | None = None,
    reference: Reference | None = None,
    progress: Progress = silent,
) -> tuple[list[tuple[Calibration, CalibrationEstimate]], list[NotEnoughDataError]]:
    """Estimate and judge the extrinsic of every camera with every LiDAR.

    Channels of one camera share pixels and lens: together they give one extrinsic.

    Args:
        rig: thresholds, targets and nominal extrinsics.
        detections: of one session.
        options: switches of the algorithm.
        channels: of the cameras, to use; None takes all that the session holds.
        reference: extrinsics to report errors against; they never enter the estimate or the verdict.
        progress: called with (done, total) for each camera and LiDAR in turn.

    Returns:
        The sensors that could be calibrated; and for each other pair why not.

    Raises:
        NotEnoughDataError: every pair has too few captures or leaves a direction open; the causes are named.
        UsageError: no capture holds one of the channels.
    """
    results, troubles = [], []
    for pairs in _pairs_by_sensors(detections, channels):
        try:
            results.append(_calibrate_sensors(rig, detections, pairs, options, reference, progress))
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


def _pairs_by_sensors(detections: Detections, channels: Sequence[str] | None) -> list[list[Pair]]:
    """Bring together the pairs of one camera and LiDAR, whose channels are calibrated as one."""
    held = sorted({pair.channel for pair in detections.pairs})
    unknown = sorted(set(channels or ()) - set(held))
    if unknown:
        raise UsageError(
            f"no capture of the session holds channel {unknown[0]!r}", f"there is {', '.join(held)}"
        )
    wanted = [pair for pair in detections.pairs if channels is None or pair.channel in channels]
    groups: dict[tuple[str, str], list[Pair]] = {}
    for pair in wanted:
        groups.setdefault((pair.camera, pair.lidar), []).append(pair)
    return list(groups.values())


def _calibrate_sensors(
    rig: Rig,
    detections: Detections,
    pairs: Sequence[Pair],
    options: CalibrateOptions,
    reference: Reference | None,
    progress: Progress,
) -> tuple[Calibration, CalibrationEstimate]:
    candidates, refused = _usable(rig, detections, pairs)
    camera, lidar = pairs[0].camera, pairs[0].lidar
    settings = rig.lidars[lidar]
    pair_options = replace(
        options,
        laser_bias_sigma_m=settings.laser_bias_sigma_m,
        range_offset_sigma_m=settings.range_offset_sigma_m,
    )
    clocks = clocks_of(rig, camera, lidar)
    result = calibrate_channels(candidates, rig.board.to_board(), pair_options, clocks, progress)
    lens = rig.cameras[camera].to_intrinsics()
    views = _views(detections, pairs, result)
    examination = examine(result.estimate, rig, settings, lens, views)
    uncertainty = point_uncertainties(result.estimate.T_cam_lidar, examination.estimate.cov, lens)
    n_captures = len({name for pair in pairs for name in detections.captures(pair)})
    calibration = _judged(rig, camera, lidar, result, examination, n_captures=n_captures, refused=refused)
    calibration = replace(calibration, uncertainty=uncertainty)
    truth = reference.of(camera, lidar) if reference else None
    if truth is not None:
        calibration = compare_with_reference(calibration, truth)
    return calibration, examination.estimate


def _views(detections: Detections, pairs: Sequence[Pair], result: ChannelsEstimate) -> list[View]:
    """List the pictures of the captures behind an extrinsic, of the channels that gave it."""
    used = sorted(_single(result.estimate.used))
    channels = {channel.channel for channel in result.channels}
    views = []
    for name in used:
        for pair in pairs:
            image = detections.images[pair.camera, pair.channel].get(name)
            if pair.channel in channels and isinstance(image, ImageBoard):
                views.append(View(name, pair.channel, image))
    return views


def _usable(
    rig: Rig, detections: Detections, pairs: Sequence[Pair]
) -> tuple[dict[str, list[CaptureCandidates]], dict[str, Refusal]]:
    """Gather the candidates of each channel that has captures enough, and refusals of captures of no use.

    Raises:
        NotEnoughDataError: no channel has.
    """
    candidates: dict[str, list[CaptureCandidates]] = {}
    refused: dict[str, Refusal] = {}
    needed = rig.quality.min_captures
    trouble: NotEnoughDataError | None = None
    for pair in pairs:
        own, own_refused = _candidates(detections, pair)
        refused |= {name: why for name, why in own_refused.items() if name not in refused}
        if len(own) >= needed:
            candidates[pair.channel] = own
        elif trouble is None:
            trouble = NotEnoughDataError(
                f"{pair}: the board was found by both sensors in {len(own)} of "
                f"{len(own) + len(own_refused)} captures, at least {needed} are needed",
                _commonest(own_refused) or "collect more captures",
            )
    if not candidates and trouble is not None:
        raise trouble
    found = {item.capture for items in candidates.values() for item in items}
    return candidates, {name: why for name, why in refused.items() if name not in found}


def clocks_of(rig: Rig, camera: str, lidar: str) -> Clocks:
    """Read what the profile says of the time of a camera and a LiDAR."""
    stamps = {name: channel.timestamps for name, channel in rig.cameras[camera].channels.items()}
    return Clocks(
        sweep_s=1 / rig.lidars[lidar].rate_hz,
        lidar_offset_s=rig.lidars[lidar].timestamps.expected_offset_s,
        channel_offset_s={name: settings.expected_offset_s for name, settings in stamps.items()},
        tolerance_s={name: settings.tolerance_s for name, settings in stamps.items()},
    )


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
    rig: Rig,
    camera: str,
    lidar: str,
    result: ChannelsEstimate,
    examination: Examination,
    *,
    n_captures: int,
    refused: dict[str, Refusal],
) -> Calibration:
    verdict, reasons = judge(result, examination, rig, camera, lidar, n_captures)
    estimate = examination.estimate
    diagnostics = dict(estimate.diagnostics)
    if result.difference is not None:
        diagnostics["channels_rotation_deg"] = float(np.degrees(np.linalg.norm(result.difference[3:])))
        diagnostics["channels_translation_m"] = float(np.linalg.norm(result.difference[:3]))
    return Calibration(
        camera=camera,
        channel="+".join(channel.channel for channel in result.channels),
        lidar=lidar,
        T_cam_lidar=estimate.T_cam_lidar,
        cov=estimate.cov,
        certificate=estimate.certificate,
        metrics=estimate.metrics,
        n_captures=n_captures,
        n_detected=n_captures - len(refused),
        captures_used=tuple(sorted(_single(estimate.used))),
        captures_refused=_still_refused(estimate, refused),
        verdict=verdict,
        reasons=reasons,
        diagnostics=diagnostics,
        channel_results=result.channels,
        method=estimate.method,
    )


def _single(names: Iterable[str]) -> set[str]:
    """Take names of captures that share a scan ("000003+000060") apart."""
    return {single for name in names for single in name.split("+")}


def _still_refused(estimate: CalibrationEstimate, refused: dict[str, Refusal]) -> dict[str, Refusal]:
    """List refusals by capture, less what another channel of the same scan made up for."""
    used = _single(estimate.used)
    every = dict(refused)
    for name, why in estimate.refused.items():
        every |= dict.fromkeys(_single([name]), why)
    return {name: every[name] for name in sorted(every) if name not in used}
