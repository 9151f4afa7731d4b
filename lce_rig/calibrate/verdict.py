"""May this extrinsic be used? Each doubt is one reason with its figure and what to do about it."""

from collections.abc import Sequence

import numpy as np

from lce_rig.calibrate.control import doubt_control
from lce_rig.calibrate.doubt import SURPRISING_CHI2, Doubt, Verdict, weigh
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.examination import Examination
from lce_rig.calibrate.halves import doubt_halves
from lce_rig.calibrate.intrinsics_check import explain
from lce_rig.calibrate.nuisances import doubt_nuisances
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, rotation_angle, tangent_sizes
from lce_rig.core.results import Metrics
from lce_rig.rig import NominalExtrinsic, QualitySettings, Rig

# A side of the plate counts as measured below this deviation; 5 % of it is more than the beam's spot.
PLATE_KNOWN_M, PLATE_FAIL = 0.03, 0.05
_AXES = ("x right", "y down", "z forward")
# What helps where more captures do not.
MEASURE_RANGES = (
    "the LiDAR's constant range errors alone exceed it: measure them, correct them in its driver and lower "
    "range_offset_sigma_m and laser_bias_sigma_m in the profile, or put more rings on the board"
)


def judge(
    estimate: CalibrationEstimate,
    examination: Examination,
    rig: Rig,
    camera: str,
    lidar: str,
    n_captures: int,
    between_cameras: Sequence[Doubt] = (),
) -> tuple[Verdict, tuple[str, ...]]:
    """Weigh everything known about an extrinsic.

    Args:
        estimate: the extrinsic with its residuals and refusals, and what each channel says.
        examination: what checks on its captures found.
        rig: thresholds, targets and the nominal extrinsic.
        camera: name of the camera.
        lidar: name of the LiDAR.
        n_captures: captures looked at, with those in which no board was found.
        between_cameras: where this camera and another contradict each other.

    Returns:
        The verdict, and the reasons for anything but a pass: worst first, causes before symptoms. A remark on
        a widened standard deviation may stand beside a pass.
    """
    doubts = [
        *_certificate(estimate),
        *_intrinsics(examination, rig),
        *_plate(estimate, rig.board.to_board()),
        *_shared(examination, rig, lidar),
        *doubt_halves(examination.contrasts, estimate.used, rig.calibration, rig.verdict),
        *between_cameras,
        *_motion(estimate, rig.verdict.max_plane_misfit_m),
        *_channels(estimate, rig),
        *_residuals(estimate, rig),
        *_control(examination),
        *_refusals(estimate),
        *_detected(estimate, n_captures, rig.quality.min_detected_fraction),
        *_placements(estimate, rig.quality.min_captures),
        *_nominal(estimate, rig.nominal(camera, lidar)),
        *_precision(estimate, examination.cov, rig),
    ]
    if examination.remark:
        doubts.append(Doubt("pass", examination.remark))
    return weigh(doubts)


def _intrinsics(examination: Examination, rig: Rig) -> list[Doubt]:
    check, target_deg = examination.intrinsics, rig.calibration.target_sigma_deg
    if check is None or check.verdict(target_deg) == "pass":
        return []
    return [Doubt(check.verdict(target_deg), explain(check, target_deg))]


def _shared(examination: Examination, rig: Rig, lidar: str) -> list[Doubt]:
    if examination.nuisances is None:
        return []
    return doubt_nuisances(examination.nuisances, rig.board.to_board(), rig.lidars[lidar], rig.verdict)


def _control(examination: Examination) -> list[Doubt]:
    return [] if examination.control is None else doubt_control(examination.control)


def _certificate(estimate: CalibrationEstimate) -> list[Doubt]:
    if estimate.certificate.is_optimal:
        return []
    if np.isinf(estimate.certificate.gap):
        text = f"not certified: method {estimate.method} has no certificate, --method paper has"
        return [Doubt("marginal", text)]
    text = f"not certified as the global minimum (gap {estimate.certificate.gap:.1e}): collect more captures"
    return [Doubt("fail", text)]


def _precision(estimate: CalibrationEstimate, cov: Array, rig: Rig) -> list[Doubt]:
    doubts = []
    target = rig.calibration
    sigmas = np.sqrt(np.diag(cov))
    for axes, goal, what, unit, scale in (
        (np.degrees(sigmas[3:]), target.target_sigma_deg, "rotation", "deg", 1.0),
        (sigmas[:3], target.target_sigma_m, "translation", "mm", 1000.0),
    ):
        sigma = float(np.linalg.norm(axes))
        if sigma > goal:
            verdict: Verdict = "fail" if sigma > rig.verdict.fail_factor * goal else "marginal"
            figures = f"{scale * sigma:.2g} {unit}, target {scale * goal:.2g} {unit}"
            by_axis = ", ".join(f"{name} {scale * axis:.2g}" for name, axis in zip(_AXES, axes, strict=True))
            key = f"sigma_systematic_{what}_{'deg' if what == 'rotation' else 'm'}"
            # Where the LiDAR's own errors alone miss the target, no number of captures will reach it.
            is_lidar = estimate.diagnostics.get(key, 0.0) > goal
            advice = MEASURE_RANGES if is_lidar else "collect more captures"
            weakest = f"weakest: {estimate.weak_direction}"
            doubts.append(Doubt(verdict, f"{what} known to {figures} ({by_axis}): {advice}; {weakest}"))
    return doubts


def residuals_beyond(metrics: Metrics, limits: QualitySettings) -> list[str]:
    """Say which mean residuals of an extrinsic exceed the profile's limits, and by how much."""
    return [
        f"{what} by {1000 * value:.0f} mm on average, limit {1000 * limit:.0f} mm"
        for value, limit, what in (
            (metrics.mpe_m, limits.max_mpe_m, "LiDAR points lie off the camera's board planes"),
            (metrics.mee_m, limits.max_mee_m, "ring ends lie off the board's edges"),
        )
        if value > limit
    ]


def _residuals(estimate: CalibrationEstimate, rig: Rig) -> list[Doubt]:
    advice = "was the board moving, or are board size or intrinsics wrong?"
    doubts = [Doubt("fail", f"{text}: {advice}") for text in residuals_beyond(estimate.metrics, rig.quality)]
    fitted = float(np.mean([np.hypot(r.plane_rms_m, r.edge_rms_m) for r in estimate.residuals]))
    if np.isfinite(estimate.held_out_m) and estimate.held_out_m > rig.verdict.max_held_out_ratio * fitted:
        text = f"captures left out fit worse ({1000 * estimate.held_out_m:.1f} mm) than captures used"
        doubts.append(Doubt("marginal", f"{text} ({1000 * fitted:.1f} mm): collect more captures"))
    return doubts


def _motion(estimate: CalibrationEstimate, limit_m: float) -> list[Doubt]:
    rms_m = estimate.diagnostics.get("fit_plane_rms_m", 0.0)
    if rms_m <= limit_m:
        return []
    is_compensated = any(channel.time_offset_s is not None for channel in estimate.channels)
    still = "with their motion taken off" if is_compensated else "under 10 mm for still boards"
    text = f"camera and LiDAR see the planes {1000 * rms_m:.0f} mm apart (rms; {still})"
    advice = "did the board move, or do pictures and scans not belong together in time?"
    if is_compensated:
        advice = "move the board more slowly and evenly, about 10 cm/s"
    return [Doubt("marginal", f"{text}: {advice}")]


def _channels(estimate: CalibrationEstimate, rig: Rig) -> list[Doubt]:
    """Hold the channels of one camera against each other: it cannot sit in two places."""
    apart, cov = estimate.channel_difference, estimate.channel_difference_cov
    if apart is None or cov is None:
        return []
    surprise = float(apart @ np.linalg.solve(cov, apart))
    rotation_deg, translation_m = tangent_sizes(apart)
    excess = rig.calibration.in_targets(rotation_deg, translation_m)
    if surprise <= SURPRISING_CHI2 or excess <= 1:
        return []
    names = " and ".join(channel.channel for channel in estimate.channels)
    verdict: Verdict = "fail" if excess > rig.verdict.fail_factor else "marginal"
    text = f"{names} of one camera disagree by {rotation_deg:.2f} deg, {1000 * translation_m:.0f} mm"
    advice = (
        "beyond their uncertainty: calibrate each alone (--channels) and see which captures contradict it"
    )
    return [Doubt(verdict, f"{text}, {advice}")]


def _refusals(estimate: CalibrationEstimate) -> list[Doubt]:
    refused = sorted(estimate.refused.items())
    disagreeing = [name for name, why in refused if why.stage in ("pair", "calibrate")]
    n = len(disagreeing) + len(estimate.used)
    if 4 * len(disagreeing) <= n:
        return []
    verdict: Verdict = "fail" if 2 * len(disagreeing) > n else "marginal"
    shown = ", ".join(disagreeing[:4]) + (" ..." if len(disagreeing) > 4 else "")
    text = f"the sensors disagree in {len(disagreeing)} of {n} captures ({shown})"
    return [Doubt(verdict, f"{text}: look for a moving board, a second board, or wrong pairing")]


def _detected(estimate: CalibrationEstimate, n_captures: int, min_fraction: float) -> list[Doubt]:
    if len(estimate.used) >= min_fraction * n_captures:
        return []
    text = f"only {len(estimate.used)} of {n_captures} captures could be used"
    return [Doubt("marginal", f"{text}: see the causes with `lce-rig check`")]


def _placements(estimate: CalibrationEstimate, needed: int) -> list[Doubt]:
    n = int(estimate.diagnostics.get("n_placements", len(estimate.used)))
    if n >= needed:
        return []
    text = f"{len(estimate.used)} captures show only {n} different placements ({needed} needed)"
    return [Doubt("marginal", f"{text}: move the board between captures")]


def _nominal(estimate: CalibrationEstimate, nominal: NominalExtrinsic | None) -> list[Doubt]:
    if nominal is None:
        return []
    expected = nominal.to_matrix()
    T = estimate.T_cam_lidar
    angle_deg = float(np.degrees(rotation_angle(T[:3, :3], expected[:3, :3])))
    shift_m = float(np.linalg.norm(T[:3, 3] - expected[:3, 3]))
    if angle_deg <= nominal.tolerance_deg and shift_m <= nominal.tolerance_m:
        return []
    text = f"{angle_deg:.1f} deg and {1000 * shift_m:.0f} mm from the nominal extrinsic"
    limit = f"tolerance {nominal.tolerance_deg:g} deg, {1000 * nominal.tolerance_m:g} mm"
    advice = "check nominal_extrinsics and the frames in the profile, and that these sensors were used"
    return [Doubt("fail", f"{text} ({limit}): {advice}")]


def _plate(estimate: CalibrationEstimate, board: Board) -> list[Doubt]:
    """Compare the plate as the LiDAR measures it with the profile; sigmas are mostly the beam's spot."""
    doubts = []
    records = [estimate.observations[name].lidar.quality for name in estimate.used]
    for side, wanted_m in (("width", board.width_m), ("height", board.height_m)):
        known = [q for q in records if q.get(f"{side}_sigma_m", np.inf) < PLATE_KNOWN_M]
        if len(known) < 3:
            continue
        measured_m = float(np.median([q[f"{side}_m"] for q in known]))
        sigma_m = float(np.median([q[f"{side}_sigma_m"] for q in known]))
        if abs(measured_m - wanted_m) > 2 * sigma_m:
            verdict: Verdict = "fail" if abs(measured_m - wanted_m) > PLATE_FAIL * wanted_m else "marginal"
            percent = 100 * abs(measured_m / wanted_m - 1)
            size = "larger" if measured_m > wanted_m else "smaller"
            text = f"the plate's {side} is {percent:.1f} % {size} in the LiDAR ({measured_m:.3f} m)"
            text += f" than the profile says ({wanted_m:.3f} m): measure the plate"
            doubts.append(Doubt(verdict, text))
    return doubts
