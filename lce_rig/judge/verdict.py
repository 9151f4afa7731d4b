"""The verdict on extrinsics: each finding is a reason with its figures and an action."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.core.board import Board
from lce_rig.core.calibration import MOTIONS, Calibration, Metrics, SceneOpinion, WeakestMotion
from lce_rig.core.findings import Figure, Finding, ranked
from lce_rig.core.geometry import Array, largest_sizes, rotation_angle, sigma_sizes, tangent_sizes
from lce_rig.judge.contributions import largest, measure_action, uncertainty_notes
from lce_rig.judge.intrinsics_check import explain
from lce_rig.judge.negative_control import control_findings
from lce_rig.judge.nuisances import nuisance_findings
from lce_rig.judge.split_consistency import split_findings
from lce_rig.judge.validate import Validation
from lce_rig.judge.weighing import SURPRISING_CHI2, Verdict, reason, verdict_of
from lce_rig.rig import NominalExtrinsic, QualitySettings, Rig

# A side of the plate counts as measured below this standard deviation; 5 % of it exceeds the beam's spot.
PLATE_KNOWN_M, PLATE_FAIL = 0.03, 0.05
# A contradiction of the scene by so many standard deviations fails; from three it is told.
SCENE_FAILS = 5.0


def judge(
    estimate: CalibrationEstimate,
    examination: Validation,
    rig: Rig,
    camera: str,
    lidar: str,
    n_captures: int,
    others: Sequence[Finding] = (),
) -> tuple[Verdict, tuple[Finding, ...]]:
    """Judge extrinsics by all checks.

    Args:
        estimate: the extrinsic with its residuals and refusals, and the result of each channel.
        examination: results of the checks on its captures.
        rig: thresholds, targets and the nominal extrinsic.
        camera: name of the camera.
        lidar: name of the LiDAR.
        n_captures: number of captures, including those without a board.
        others: of other evidence: contradictions between cameras, what the scene did to the result.

    Returns:
        The verdict, and the reasons for anything but a pass: worst first, causes before symptoms. A note on
        a widened standard deviation is compatible with a pass.
    """
    findings = [
        *_certificate(estimate),
        *_intrinsics(examination, rig),
        *_plate(estimate, rig.board.to_board()),
        *_shared(examination, rig, lidar),
        *split_findings(examination.contrasts, estimate.used, rig.calibration, rig.verdict),
        *others,
        *_motion(estimate, rig.verdict.max_plane_misfit_m),
        *_channels(estimate, rig),
        *_residuals(estimate, rig),
        *_control(examination),
        *_refusals(estimate),
        *_detected(estimate, n_captures, rig.quality.min_detected_fraction),
        *_placements(estimate, rig.quality.min_captures),
        *_nominal(estimate, rig.nominal(camera, lidar)),
        *_precision(estimate, examination, rig),
    ]
    if examination.remark is not None:
        findings.append(examination.remark)
    findings += uncertainty_notes(examination.contributions, examination.known_better, rig.calibration)
    return _verdict(findings, examination.cov)


def _verdict(findings: Sequence[Finding], cov: Array) -> tuple[Verdict, tuple[Finding, ...]]:
    """Draw the verdict; where it is marginal, a note says how wrong the extrinsics may be."""
    verdict, others = verdict_of(findings), [f for f in findings if f.code != "verdict.may_be_off"]
    if verdict != "marginal":
        return verdict, ranked(others)
    figures: dict[str, Figure] = dict(zip(("rotation_deg", "translation_m"), largest_sizes(cov), strict=True))
    return verdict, ranked([Finding("verdict.may_be_off", "note", figures=figures), *others])


def with_opinion(calibration: Calibration, opinion: SceneOpinion) -> Calibration:
    """Add the scene's opinion to judged extrinsics; only a contradiction changes the verdict.

    Args:
        calibration: judged by its boards.
        opinion: of the scene without the board.
    """
    told = [*calibration.findings, *scene_findings(opinion, calibration)]
    verdict, findings = _verdict(told, calibration.cov)
    return replace(calibration, scene=opinion, findings=findings, verdict=verdict)


def scene_findings(opinion: SceneOpinion, calibration: Calibration, action: str = "") -> list[Finding]:
    """List the scene's contradiction of extrinsics, if there is one, with the likely cause as its action.

    Args:
        opinion: of the scene.
        calibration: the extrinsics.
        action: where it is known already.
    """
    worst = opinion.strongest
    if worst is None:
        return []
    has_moving_boards = any(each.time_offset_s is not None for each in calibration.channel_results)
    if not action and worst.axis == "translation_z":
        action = "distances"
    elif not action and has_moving_boards:
        action = "times"
    sigmas = abs(worst.change) / worst.sigma
    figures: dict[str, Figure] = {
        "axis": worst.axis,
        f"change_{worst.unit}": worst.change,
        f"sigma_{worst.unit}": worst.sigma,
        "sigmas": sigmas,
        "n_captures": opinion.n_captures,
        "n_axes": len(opinion.of("contradicts")),
    }
    return [reason("verdict.scene", figures, is_fail=sigmas > SCENE_FAILS, action=action)]


def _intrinsics(examination: Validation, rig: Rig) -> list[Finding]:
    check, target_deg = examination.intrinsics, rig.calibration.target_sigma_deg
    if check is None or check.verdict(target_deg) == "pass":
        return []
    return [explain(check, target_deg)]


def _shared(examination: Validation, rig: Rig, lidar: str) -> list[Finding]:
    if examination.nuisances is None:
        return []
    return nuisance_findings(examination.nuisances, rig.board.to_board(), rig.lidars[lidar], rig.verdict)


def _control(examination: Validation) -> list[Finding]:
    return [] if examination.control is None else control_findings(examination.control)


def _certificate(estimate: CalibrationEstimate) -> list[Finding]:
    if estimate.certificate.is_optimal:
        return []
    if np.isinf(estimate.certificate.gap):
        return [reason("verdict.no_certificate", {"method": estimate.method}, is_fail=False)]
    return [reason("verdict.not_certified", {"gap": estimate.certificate.gap}, is_fail=True)]


def _precision(estimate: CalibrationEstimate, examination: Validation, rig: Rig) -> list[Finding]:
    agreed = dict(zip(("deg", "m"), sigma_sizes(examination.cov_agreed), strict=True))
    sigmas, target, of_lidar = np.sqrt(np.diag(examination.cov)), rig.calibration, estimate.diagnostics
    turns_deg, shifts_m = np.degrees(sigmas[3:]), sigmas[:3]
    rotation = ("verdict.rotation_uncertain", "deg", turns_deg, target.target_sigma_deg)
    translation = ("verdict.translation_uncertain", "m", shifts_m, target.target_sigma_m)
    found = []
    causes = examination.contributions
    for (code, unit, axes, goal), of_lidar_alone, main in (
        (rotation, of_lidar.sigma_systematic_rotation_deg, largest(causes, "sigma_rotation_deg")),
        (translation, of_lidar.sigma_systematic_translation_m, largest(causes, "sigma_translation_m")),
    ):
        sigma = float(np.linalg.norm(axes))
        if sigma > goal:
            figures: dict[str, Figure] = {
                f"sigma_{unit}": sigma,
                f"target_{unit}": goal,
                f"by_axis_{unit}": tuple(float(axis) for axis in axes),
                **_weakest_of(examination.cov, code == "verdict.rotation_uncertain").figures(),
            }
            # A contradiction is judged by the check that found it; here it says how wrong the result may be.
            is_fail = agreed[unit] > rig.verdict.fail_factor * goal
            # No number of captures helps against the LiDAR's own errors; before that, more captures help
            # most as long as their scatter is the larger part.
            is_of_lidar = of_lidar_alone > goal and 2 * of_lidar_alone**2 > sigma**2
            action = "measure_ranges" if is_of_lidar else measure_action(main)
            found.append(reason(code, figures, is_fail=is_fail, action=action))
    return found


def _weakest_of(cov: Array, is_rotation: bool) -> WeakestMotion:
    """Name the least determined rotation, or the least determined translation."""
    sigmas = np.sqrt(np.diag(cov))
    places = range(3, 6) if is_rotation else range(3)
    worst = max(places, key=lambda place: sigmas[place])
    return WeakestMotion(MOTIONS[worst], float(sigmas[worst]))


def residuals_beyond(metrics: Metrics, limits: QualitySettings) -> list[Finding]:
    """List the mean residuals of extrinsics that exceed the profile's limits."""
    return [
        reason(code, {"mean_m": value, "limit_m": limit}, is_fail=True)
        for value, limit, code in (
            (metrics.mpe_m, limits.max_mpe_m, "verdict.plane_residual"),
            (metrics.mee_m, limits.max_mee_m, "verdict.edge_residual"),
        )
        if value > limit
    ]


def _residuals(estimate: CalibrationEstimate, rig: Rig) -> list[Finding]:
    found = residuals_beyond(estimate.metrics, rig.quality)
    fitted_m = float(np.mean([np.hypot(r.plane_rms_m, r.edge_rms_m) for r in estimate.residuals]))
    if np.isfinite(estimate.held_out_m) and estimate.held_out_m > rig.verdict.max_held_out_ratio * fitted_m:
        figures = {"held_out_m": estimate.held_out_m, "fitted_m": fitted_m}
        found.append(reason("verdict.held_out", figures, is_fail=False))
    return found


def _motion(estimate: CalibrationEstimate, limit_m: float) -> list[Finding]:
    rms_m = estimate.diagnostics.fit_plane_rms_m
    if not rms_m > limit_m:  # NaN where the method has no such residual
        return []
    is_compensated = any(channel.time_offset_s is not None for channel in estimate.channels)
    action = "compensated" if is_compensated else ""
    return [reason("verdict.planes_apart", {"rms_m": rms_m}, is_fail=False, action=action)]


def _channels(estimate: CalibrationEstimate, rig: Rig) -> list[Finding]:
    """Compare the channels of one camera, which has one pose."""
    apart, cov = estimate.channel_difference, estimate.channel_difference_cov
    if apart is None or cov is None:
        return []
    surprise = float(apart @ np.linalg.solve(cov, apart))
    rotation_deg, translation_m = tangent_sizes(apart)
    excess = rig.calibration.in_targets(rotation_deg, translation_m)
    if surprise <= SURPRISING_CHI2 or excess <= 1:
        return []
    first, second = (channel.channel for channel in estimate.channels[:2])
    figures: dict[str, Figure] = {
        "first": first,
        "second": second,
        "rotation_deg": rotation_deg,
        "translation_m": translation_m,
    }
    return [reason("verdict.channels_differ", figures, is_fail=excess > rig.verdict.fail_factor)]


def _refusals(estimate: CalibrationEstimate) -> list[Finding]:
    refused = sorted(estimate.refused.items())
    disagreeing = [name for name, why in refused if why.stage in ("pair", "calibrate")]
    n = len(disagreeing) + len(estimate.used)
    if 4 * len(disagreeing) <= n:
        return []
    figures: dict[str, Figure] = {
        "n_refused": len(disagreeing),
        "n_captures": n,
        "captures": tuple(disagreeing),
    }
    return [reason("verdict.sensors_disagree", figures, is_fail=2 * len(disagreeing) > n)]


def _detected(estimate: CalibrationEstimate, n_captures: int, min_fraction: float) -> list[Finding]:
    if len(estimate.used) >= min_fraction * n_captures:
        return []
    figures = {"n_used": len(estimate.used), "n_captures": n_captures}
    return [reason("verdict.few_used", figures, is_fail=False)]


def _placements(estimate: CalibrationEstimate, needed: int) -> list[Finding]:
    n = int(estimate.diagnostics.n_placements)
    if n >= needed:
        return []
    figures = {"n_used": len(estimate.used), "n_placements": n, "n_needed": needed}
    return [reason("verdict.few_placements", figures, is_fail=False)]


def _nominal(estimate: CalibrationEstimate, nominal: NominalExtrinsic | None) -> list[Finding]:
    if nominal is None or nominal.source == "typical":
        return []
    expected = nominal.to_matrix()
    T = estimate.T_cam_lidar
    angle_deg = float(np.degrees(rotation_angle(T[:3, :3], expected[:3, :3])))
    shift_m = float(np.linalg.norm(T[:3, 3] - expected[:3, 3]))
    if angle_deg <= nominal.tolerance_deg and shift_m <= nominal.tolerance_m:
        return []
    figures = {
        "rotation_deg": angle_deg,
        "translation_m": shift_m,
        "tolerance_deg": nominal.tolerance_deg,
        "tolerance_m": nominal.tolerance_m,
    }
    return [reason("verdict.far_from_nominal", figures, is_fail=True)]


def _plate(estimate: CalibrationEstimate, board: Board) -> list[Finding]:
    """Compare the plate's size from the LiDAR with the profile; the uncertainty is mainly the beam's spot."""
    found = []
    records = [estimate.observations[name].lidar.quality for name in estimate.used]
    for side, wanted_m, sides in (
        ("width", board.width_m, [(q.width_m, q.width_sigma_m) for q in records]),
        ("height", board.height_m, [(q.height_m, q.height_sigma_m) for q in records]),
    ):
        known = [each for each in sides if each[1] < PLATE_KNOWN_M]
        if len(known) < 3:
            continue
        measured_m, sigma_m = (float(median) for median in np.median(known, axis=0))
        if abs(measured_m - wanted_m) > 2 * sigma_m:
            figures: dict[str, Figure] = {
                "side": side,
                "measured_m": measured_m,
                "sigma_m": sigma_m,
                "profile_m": wanted_m,
            }
            is_fail = abs(measured_m - wanted_m) > PLATE_FAIL * wanted_m
            found.append(reason("verdict.plate_size", figures, is_fail=is_fail))
    return found
