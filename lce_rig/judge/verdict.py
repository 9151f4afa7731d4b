"""The verdict on extrinsics: each finding is a reason with its figures and an action."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.core.board import Board
from lce_rig.core.calibration import MOTIONS, Calibration, Metrics, SceneOpinion
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import (
    SIGMA_PER_MAD,
    Array,
    invert,
    largest_sizes,
    rotation_angle,
    sigma_sizes,
)
from lce_rig.core.results import BoardSurface, LidarBoard
from lce_rig.detect.findings import LIDAR_OTHER_SIZE
from lce_rig.judge.causes import MAX_PLANE_MISFIT_M
from lce_rig.judge.contributions import largest, measure_action
from lce_rig.judge.findings import (
    CHANNELS_DIFFER,
    CHANNELS_TURNED,
    EDGE_RESIDUAL,
    FAIL_FACTOR,
    FAR_FROM_NOMINAL,
    FEW_PLACEMENTS,
    FEW_USED,
    LAST_REJECTED,
    MAY_BE_OFF,
    NOT_CERTIFIED,
    PLANE_RESIDUAL,
    PLANES_APART,
    PLATE_EDGE,
    PLATE_SIZE,
    READOUT,
    ROTATION_UNCERTAIN,
    SCALE_OFF,
    SCENE,
    SENSORS_DISAGREE,
    TIME_OFFSET,
    TRANSLATION_UNCERTAIN,
    Verdict,
    arrange,
    failing,
    is_symptom_alone,
    verdict_of,
)
from lce_rig.judge.intrinsics_check import lens_findings
from lce_rig.judge.scene_drift import SceneChange
from lce_rig.judge.validate import Validation
from lce_rig.rig import NominalExtrinsic, QualitySettings, Rig

# Largest standard deviation of a measured side of the plate, m, and the relative error that fails: 5 %
# exceeds the beam's width.
PLATE_KNOWN_M, PLATE_FAIL = 0.03, 0.05
# Direction of a side, nearly vertical, whose ends rings do not cross.
_UPRIGHT = 0.87
# Fractions of scans without one of two edges, and of ring ends off the outline, which together show a wrong
# size. Of 15 sessions with the right size one lacks edges, by its mounting, and drops none; one drops as
# many, at hands, and lacks none.
_LACKING, _DROPPED = 0.3, 0.04
# Significance limit of a time offset, in standard deviations, and the offset, s, from which images may be
# matched with other scans.
_SURE, _LATE_S = 3.0, 0.1
# Rotation between channels of one camera that an image rotated by 180 deg explains, deg.
_TURNED_DEG = 170.0
# Least chi-squared, of six degrees of freedom, of a scene that fails a result: a chance of 6e-7, as of 5
# standard deviations of one quantity. A smaller contradiction is a warning.
SCENE_FAILS_CHI2 = 39.5


def judge(
    estimate: CalibrationEstimate,
    examination: Validation,
    rig: Rig,
    camera: str,
    lidar: str,
    n_captures: int,
    others: Sequence[Finding] = (),
    T_view: Array | None = None,
    n_misfits: int = 0,
) -> tuple[Verdict, tuple[Finding, ...]]:
    """Judge extrinsics by all checks.

    Args:
        estimate: the extrinsics with residuals and refusals, and the result of each channel.
        examination: results of the checks on its captures.
        rig: thresholds, targets and the nominal extrinsics.
        camera: name of the camera.
        lidar: name of the LiDAR.
        n_captures: number of captures, including those without a board.
        others: findings of other evidence: contradictions between cameras.
        T_view: (4, 4) from the frame of the nominal extrinsics to that of the estimate; None for the same.
        n_misfits: images whose corners fit no pose of the board, as with a wrong lens.

    Returns:
        The verdict, and its findings: the cause first, then its consequences, then notes.
    """
    board, nominal, proof = rig.board.to_board(), rig.nominal(camera, lidar), estimate.certificate
    findings = [
        *([] if proof.is_optimal else [NOT_CERTIFIED(gap=proof.gap)]),
        *others,
        *_lens(examination, rig, is_misfit=2 * n_misfits >= len(estimate.used)),
        *examination.causes,
        *plate_findings([estimate.observations[name].surface for name in estimate.used], board),
        *_motion(estimate),
        *_channels(estimate, rig),
        *_times(estimate, rig, camera),
        *residuals_beyond(estimate.metrics, rig.quality),
        *_captures(estimate, n_captures, rig.quality),
        *nominal_findings(
            estimate.T_cam_lidar if T_view is None else invert(T_view) @ estimate.T_cam_lidar, nominal
        ),
        *_precision(estimate, examination, rig),
    ]
    return _verdict(_once(_explained(findings, examination)), examination.cov)


def _explained(findings: Sequence[Finding], examination: Validation) -> list[Finding]:
    """Make the first cause a reason if it explains the captures and all others are symptoms."""
    if not (examination.is_explained and is_symptom_alone(findings)):
        return list(findings)
    return [replace(f, severity="warning") if f is examination.causes[0] else f for f in findings]


def _lens(examination: Validation, rig: Rig, is_misfit: bool) -> list[Finding]:
    """Find intrinsics of the profile that do not fit; an error where corners fit no pose in many images.

    Corners that a wrong lens displaces look sheared, too.
    """
    found = lens_findings(examination.intrinsics, rig.calibration.target_sigma_deg)
    is_wrong = any(f.severity != "note" for f in found)
    of_model = [f for f in examination.lens_model if not (is_wrong and f.code == READOUT.code)]
    return [
        *of_model,
        *(replace(f, severity="error") if is_misfit and f.severity == "warning" else f for f in found),
    ]


def _once(findings: Sequence[Finding]) -> list[Finding]:
    """Drop notes on the plate's size if the scans' outlines give a reason."""
    is_named = any(f.code == PLATE_SIZE.code and f.severity != "note" for f in findings)
    return [f for f in findings if not (is_named and f.code == PLATE_SIZE.code and f.severity == "note")]


def _verdict(findings: Sequence[Finding], cov: Array) -> tuple[Verdict, tuple[Finding, ...]]:
    """Return verdict and sorted findings; MARGINAL has a note with the 95 % error bound."""
    others = arrange([f for f in findings if f.code != MAY_BE_OFF.code])
    verdict = verdict_of(others)
    if verdict != "marginal":
        return verdict, others
    rotation_deg, translation_m = largest_sizes(cov)
    return verdict, (*others, MAY_BE_OFF(rotation_deg=rotation_deg, translation_m=translation_m))


def with_findings(calibration: Calibration, found: Sequence[Finding]) -> Calibration:
    """Add findings to judged extrinsics, which change the verdict unless they are notes."""
    verdict, findings = _verdict([*calibration.findings, *found], calibration.cov)
    return replace(calibration, findings=findings, verdict=verdict)


def with_opinion(calibration: Calibration, opinion: SceneOpinion) -> Calibration:
    """Add the result of the scene check to judged extrinsics; only a contradiction changes the verdict.

    Args:
        calibration: judged by its boards.
        opinion: the check on the scene without the board.
    """
    return with_findings(replace(calibration, scene=opinion), scene_findings(opinion, calibration))


def scene_findings(opinion: SceneOpinion, calibration: Calibration, action: str = "") -> list[Finding]:
    """List the scene's contradiction of extrinsics, if there is one, with the likely cause as its action.

    Args:
        opinion: the check on the scene.
        calibration: the extrinsics.
        action: if known already.
    """
    if opinion.state != "contradicts" or opinion.change is None or opinion.cov is None:
        return []
    change = SceneChange(opinion.change, opinion.cov)
    has_moving_boards = any(each.time_offset_s is not None for each in calibration.channel_results)
    if not action and change.main_axes == ("translation_z",):
        action = "distances"
    elif not action and has_moving_boards:
        action = "times"
    return [SCENE(severity=failing(change.chi2 > SCENE_FAILS_CHI2), action=action, **change.figures)]


def _precision(estimate: CalibrationEstimate, examination: Validation, rig: Rig) -> Iterator[Finding]:
    agreed_deg, agreed_m = sigma_sizes(examination.cov_agreed)
    sigmas, target, of_lidar = np.sqrt(np.diag(examination.cov)), rig.calibration, estimate.diagnostics
    for kind, unit, first, axes, goal, agreed, of_lidar_alone, size in (
        (
            *(ROTATION_UNCERTAIN, "deg", 3, np.degrees(sigmas[3:]), target.target_sigma_deg, agreed_deg),
            *(of_lidar.sigma_systematic_rotation_deg, "sigma_rotation_deg"),
        ),
        (
            *(TRANSLATION_UNCERTAIN, "m", 0, sigmas[:3], target.target_sigma_m, agreed_m),
            *(of_lidar.sigma_systematic_translation_m, "sigma_translation_m"),
        ),
    ):
        sigma, worst = float(np.linalg.norm(axes)), int(np.argmax(axes))
        if sigma <= goal:
            continue
        # More captures do not reduce the LiDAR's own errors; otherwise they help as long as their scatter is
        # the larger part.
        is_of_lidar = of_lidar_alone > goal and 2 * of_lidar_alone**2 > sigma**2
        figures: dict[str, Any] = {
            f"sigma_{unit}": sigma,
            f"target_{unit}": goal,
            f"by_axis_{unit}": tuple(axes.tolist()),
            "weakest": MOTIONS[first + worst],
        }
        yield kind(
            # Without contradictions: the check that found one decides about it.
            severity=failing(agreed > FAIL_FACTOR * goal),
            action="measure_ranges"
            if is_of_lidar
            else measure_action(largest(examination.contributions, size)),
            **figures,
        )


def residuals_beyond(metrics: Metrics, limits: QualitySettings) -> list[Finding]:
    """List the mean residuals of extrinsics that exceed the profile's limits."""
    return [
        kind(mean_m=value, limit_m=limit)
        for value, limit, kind in (
            (metrics.mpe_m, limits.max_mpe_m, PLANE_RESIDUAL),
            (metrics.mee_m, limits.max_mee_m, EDGE_RESIDUAL),
        )
        if value > limit
    ]


def _motion(estimate: CalibrationEstimate) -> list[Finding]:
    rms_m = estimate.diagnostics.fit_plane_rms_m
    if not rms_m > MAX_PLANE_MISFIT_M:  # NaN if the method has no such residual
        return []
    is_compensated = any(channel.time_offset_s is not None for channel in estimate.channels)
    return [PLANES_APART(action="compensated" if is_compensated else "", rms_m=rms_m)]


def _times(estimate: CalibrationEstimate, rig: Rig, camera: str) -> Iterator[Finding]:
    """List time offsets of channels that differ significantly from the profile's."""
    for each in estimate.channels:
        if each.time_offset_s is None or each.time_offset_sigma_s is None:
            continue
        if abs(each.time_offset_s) <= _SURE * each.time_offset_sigma_s:
            continue
        expected_s = rig.cameras[camera].channels[each.channel].timestamps.expected_offset_s
        yield TIME_OFFSET(
            camera,
            severity="warning" if abs(each.time_offset_s) > _LATE_S else "note",
            channel=each.channel,
            offset_s=each.time_offset_s,
            sigma_s=each.time_offset_sigma_s,
            enter_s=expected_s + each.time_offset_s,
        )


def _channels(estimate: CalibrationEstimate, rig: Rig) -> list[Finding]:
    """Compare the channels of one camera, which share its pose."""
    apart = estimate.channel_difference
    if apart is None or (excess := rig.calibration.excess(apart)) <= 1:
        return []
    first, second = (channel.channel for channel in estimate.channels[:2])
    severity, sizes = failing(excess > FAIL_FACTOR), apart.sizes
    differ = CHANNELS_DIFFER(severity=severity, first=first, second=second, **sizes)
    is_turned = sizes["rotation_deg"] > _TURNED_DEG
    return [*([CHANNELS_TURNED(first=first, second=second)] if is_turned else []), differ]


def _captures(estimate: CalibrationEstimate, n_captures: int, limits: QualitySettings) -> Iterator[Finding]:
    """Count captures in which the sensors disagree, captures used, and placements of the board."""
    n_used, n_placements = len(estimate.captures_of(estimate.used)), int(estimate.diagnostics.n_placements)
    disagreeing = sorted(k for k, why in estimate.refused.items() if why.stage in ("pair", "calibrate"))
    n_refused, n = len(disagreeing), len(disagreeing) + n_used
    if 4 * n_refused > n:
        severity = failing(2 * n_refused > n)
        yield SENSORS_DISAGREE(
            severity=severity, n_refused=n_refused, n_captures=n, captures=tuple(disagreeing)
        )
    if disagreeing and disagreeing[-1] > max(estimate.used) and disagreeing[-2:-1] < list(estimate.used[-1:]):
        yield LAST_REJECTED(capture=disagreeing[-1])
    if n_used < limits.min_detected_fraction * n_captures:
        yield FEW_USED(n_used=n_used, n_captures=n_captures)
    if n_placements < limits.min_captures:
        yield FEW_PLACEMENTS(n_used=n_used, n_placements=n_placements, n_needed=limits.min_captures)


def nominal_findings(T: Array, nominal: NominalExtrinsic | None) -> list[Finding]:
    """List the difference of extrinsics (4, 4) from the CAD pose, if it exceeds the tolerance."""
    if nominal is None or nominal.source == "typical":
        return []

    def apart(expected: Array) -> tuple[float, float]:
        angle_deg = float(np.degrees(rotation_angle(T[:3, :3], expected[:3, :3])))
        return angle_deg, float(np.linalg.norm(T[:3, 3] - expected[:3, 3]))

    def fits(expected: Array) -> bool:
        angle_deg, shift_m = apart(expected)
        return angle_deg <= nominal.tolerance_deg and shift_m <= nominal.tolerance_m

    if fits(nominal.to_matrix()):
        return []
    angle_deg, shift_m = apart(nominal.to_matrix())
    figures: dict[str, Any] = {}
    meant = {error: entry for error, entry in nominal.corrections().items() if fits(entry.to_matrix())}
    for entry in list(meant.values())[:1]:
        figures["enter_quaternion_wxyz"] = entry.quaternion_wxyz
        figures["enter_translation_m"] = entry.translation_m
    return [
        FAR_FROM_NOMINAL(
            action=next(iter(meant), ""),
            rotation_deg=angle_deg,
            translation_m=shift_m,
            tolerance_deg=nominal.tolerance_deg,
            tolerance_m=nominal.tolerance_m,
            **figures,
        )
    ]


def plate_findings(scans: Iterable[BoardSurface | Refusal], board: Board) -> list[Finding]:
    """Compare the plate's size from the LiDAR with the profile; the uncertainty is mainly the beam's width.

    If the profile's plate is larger than the true one by more than the search range for edges, one of two
    opposite edges has no ring ends, and those of the true edge are dropped.

    Args:
        scans: boards, of which those in scans count, and refusals: a plate refused for its size counts as
            measured.
        board: board of the profile.
    """
    sizes: dict[str, list[tuple[float, float]]] = {"width": [], "height": []}
    dropped, n_lacking = [], {"width": 0, "height": 0}
    for scan in scans:
        if isinstance(scan, LidarBoard):
            q = scan.quality
            dropped.append(q.n_ring_ends_dropped / max(q.n_ring_ends + q.n_ring_ends_dropped, 1))
            for k, (side, sigma_m) in enumerate((("width", q.width_sigma_m), ("height", q.height_sigma_m))):
                is_crossed = abs(scan.T_lidar_board[2, k]) < _UPRIGHT
                n_lacking[side] += int(is_crossed and sigma_m > PLATE_KNOWN_M)
            sizes["width"].append((q.width_m, q.width_sigma_m))
            sizes["height"].append((q.height_m, q.height_sigma_m))
        elif isinstance(scan, Refusal) and scan.code == LIDAR_OTHER_SIZE.code:
            measured = scan.figure("measured_m"), scan.figure("sigma_m")
            sizes[str(scan.figures["side"])].append(measured)
    found = []
    for side, wanted_m in (("width", board.width_m), ("height", board.height_m)):
        known = [each for each in sizes[side] if each[1] < PLATE_KNOWN_M]
        n, n_without = len(sizes[side]), n_lacking[side]
        if n_without >= max(3, _LACKING * n) and np.median(dropped) > _DROPPED:
            found.append(PLATE_EDGE(side=side, profile_m=wanted_m, n_lacking=n_without, n_captures=n))
            continue
        if len(known) < 3:
            continue
        measured_m, sigma_m = (float(median) for median in np.median(known, axis=0))
        if abs(measured_m - wanted_m) > 2 * sigma_m:
            found.append(
                PLATE_SIZE(
                    severity=failing(abs(measured_m - wanted_m) > PLATE_FAIL * wanted_m),
                    side=side,
                    measured_m=measured_m,
                    sigma_m=sigma_m,
                    profile_m=wanted_m,
                    n_captures=len(known),
                )
            )
    return found


def distance_findings(
    in_camera: Array, in_lidar: Array, square_m: float, *, n_misfits: int = 0
) -> list[Finding]:
    """Compare distances between boards, which are the same for both sensors with any extrinsics.

    A coarse check before any estimate: it finds squares or a lens so wrong that captures are refused.

    Args:
        in_camera, in_lidar: (N, 3) centres of the boards of N captures, m.
        square_m: square size of the profile.
        n_misfits: images whose corners fit no pose of the board. Wrong squares cause none, a wrong lens does.
    """
    first, second = np.triu_indices(len(in_camera), 1)
    camera_m, lidar_m = (np.linalg.norm(c[first] - c[second], axis=1) for c in (in_camera, in_lidar))
    is_far = (camera_m > 0.5) & (lidar_m > 0.5)  # m; noise hardly changes their ratio
    if np.count_nonzero(is_far) < 3:
        return []
    ratios = np.log(camera_m[is_far] / lidar_m[is_far])
    ratio = float(np.median(ratios))
    sigma = SIGMA_PER_MAD * float(np.median(np.abs(ratios - ratio))) / np.sqrt(len(in_camera))
    if abs(ratio) < max(0.03, 4 * sigma):
        return []
    scale = float(np.exp(ratio))
    return [
        SCALE_OFF(
            action="lens" if 2 * n_misfits >= len(in_camera) else "",
            scale=scale - 1,
            scale_sigma=scale * sigma,
            square_m=square_m / scale,
            profile_square_m=square_m,
        )
    ]
