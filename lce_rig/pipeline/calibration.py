"""Estimate and judge the extrinsic of every camera with every LiDAR of a session."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from lce_rig.calibrate import CalibrateOptions, CalibrationEstimate
from lce_rig.calibrate.metrics import error_to_reference
from lce_rig.calibrate.reach import point_uncertainties
from lce_rig.calibrate.shared_scans import take_apart
from lce_rig.calibrate.verdict import judge
from lce_rig.core.errors import NotEnoughDataError, UsageError, join_shortages
from lce_rig.core.geometry import Array, tangent_sizes
from lce_rig.core.results import Calibration, Refusal
from lce_rig.detect.detection import Detections, Pair
from lce_rig.export.reference import Reference
from lce_rig.pipeline.cameras import InCompany, bring_cameras_together
from lce_rig.pipeline.detection import detect
from lce_rig.pipeline.progress import Progress, silent
from lce_rig.pipeline.result_files import Result
from lce_rig.pipeline.solving import solve
from lce_rig.rig import Rig
from lce_rig.session import Session


def calibrate(
    session: Session,
    detections: Detections | None = None,
    *,
    options: CalibrateOptions | None = None,
    cameras: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
    reference: Reference | None = None,
    progress: Progress = silent,
) -> Result:
    """Estimate and judge the extrinsic of every camera with every LiDAR of a session; nothing is written.

    Args:
        session: open for reading is enough.
        detections: of the session; None detects the board first, as `detect` does by default.
        options: of the estimate; None takes the usual ones.
        cameras: to calibrate, as if the session held no others; None takes all.
        channels: of the cameras, to use; None takes all that the session holds.
        reference: extrinsics to report errors against; they never enter the estimate or the verdict.
        progress: called with (done, total) for each camera and LiDAR in turn.

    Raises:
        NotEnoughDataError: every pair has too few captures or leaves a direction open; the causes are named.
        UsageError: no capture holds one of the channels.
    """
    pairs, shortages = calibrate_detections(
        session.rig,
        detect(session) if detections is None else detections,
        options,
        cameras=cameras,
        channels=channels,
        reference=reference,
        progress=progress,
    )
    return Result(session, tuple(pairs), tuple(shortages))


def calibrate_detections(
    rig: Rig,
    detections: Detections,
    options: CalibrateOptions | None = None,
    *,
    cameras: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
    reference: Reference | None = None,
    progress: Progress = silent,
) -> tuple[list[Calibration], list[NotEnoughDataError]]:
    """Estimate and judge the extrinsic of every camera with every LiDAR from what they saw of the board.

    Channels of one camera share pixels and lens: together they give one extrinsic. Cameras that saw the same
    boards are held against each other, and with method "ml" estimated together.

    Args:
        rig: thresholds, targets and nominal extrinsics.
        detections: of one session.
        options, cameras, channels, reference, progress: as of `calibrate`.

    Returns:
        The sensors that could be calibrated; and for each other pair why not.

    Raises:
        NotEnoughDataError: every pair has too few captures or leaves a direction open; the causes are named.
        UsageError: no capture holds one of the channels.
    """
    solved, troubles = [], []
    for pairs in _pairs_by_sensors(detections, cameras, channels):
        try:
            solved.append(solve(rig, detections, pairs, options or CalibrateOptions(), progress))
        except NotEnoughDataError as error:
            troubles.append(error)
    if not solved:
        raise _nothing_solved(troubles, cameras)
    members = bring_cameras_together(rig, detections, solved)
    return [_judged(rig, detections, each, reference) for each in members], troubles


def _nothing_solved(
    troubles: Sequence[NotEnoughDataError], cameras: Sequence[str] | None
) -> NotEnoughDataError:
    """Say of every pair why it could not be calibrated."""
    if not troubles:
        of_cameras = f" of {' or '.join(cameras)}" if cameras else ""
        return NotEnoughDataError(
            f"the session holds no capture with a picture{of_cameras} and a scan", "Collect captures first."
        )
    return join_shortages(troubles)


def _pairs_by_sensors(
    detections: Detections, cameras: Sequence[str] | None, channels: Sequence[str] | None
) -> list[list[Pair]]:
    """Bring together the pairs of one camera and LiDAR, whose channels are calibrated as one."""
    held = sorted({pair.channel for pair in detections.pairs})
    unknown = sorted(set(channels or ()) - set(held))
    if unknown:
        raise UsageError(
            f"no capture of the session holds channel {unknown[0]!r}", f"there is {', '.join(held)}"
        )
    wanted = [
        pair
        for pair in detections.pairs
        if (cameras is None or pair.camera in cameras) and (channels is None or pair.channel in channels)
    ]
    groups: dict[tuple[str, str], list[Pair]] = {}
    for pair in wanted:
        groups.setdefault((pair.camera, pair.lidar), []).append(pair)
    return list(groups.values())


def compare_with_reference(calibration: Calibration, reference: Array) -> Calibration:
    """Report the error against a T_cam_lidar (4, 4) that somebody else vouches for."""
    rotation_deg, translation_m = error_to_reference(calibration.T_cam_lidar, reference)
    return replace(calibration, egt_rotation_deg=rotation_deg, egt_translation_m=translation_m)


def _judged(rig: Rig, detections: Detections, member: InCompany, reference: Reference | None) -> Calibration:
    solved, estimate = member.solved, member.solved.estimate
    camera, lidar, result = solved.camera, solved.lidar, solved.result
    n_captures = len({name for pair in solved.pairs for name in detections.captures(pair)})
    verdict, reasons = judge(result, solved.examination, rig, camera, lidar, n_captures, member.doubts)
    diagnostics = dict(estimate.diagnostics)
    if result.difference is not None:
        rotation_deg, translation_m = tangent_sizes(result.difference)
        diagnostics |= {"channels_rotation_deg": rotation_deg, "channels_translation_m": translation_m}
    lens = rig.cameras[camera].to_intrinsics()
    calibration = Calibration(
        camera=camera,
        channel="+".join(channel.channel for channel in result.channels),
        lidar=lidar,
        T_cam_lidar=estimate.T_cam_lidar,
        cov=estimate.cov,
        certificate=estimate.certificate,
        metrics=estimate.metrics,
        n_captures=n_captures,
        n_detected=n_captures - len(solved.refused),
        captures_used=tuple(sorted(take_apart(estimate.used))),
        captures_refused=_still_refused(estimate, solved.refused),
        verdict=verdict,
        reasons=reasons,
        diagnostics=diagnostics,
        channel_results=result.channels,
        method=estimate.method,
        uncertainty=point_uncertainties(estimate.T_cam_lidar, estimate.cov, lens),
        estimated_with=estimate.estimated_with,
        other_cameras=member.others,
        weak_direction=estimate.weak_direction,
        held_out_m=estimate.held_out_m,
        residuals=estimate.residuals,
        observations=estimate.observations,
    )
    truth = reference.of(camera, lidar) if reference else None
    return calibration if truth is None else compare_with_reference(calibration, truth)


def _still_refused(estimate: CalibrationEstimate, refused: Mapping[str, Refusal]) -> dict[str, Refusal]:
    """List refusals by capture, less what another channel of the same scan made up for."""
    used = take_apart(estimate.used)
    every = dict(refused)
    for name, why in estimate.refused.items():
        every |= dict.fromkeys(take_apart([name]), why)
    return {name: every[name] for name in sorted(every) if name not in used}
