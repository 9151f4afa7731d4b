"""The verdict on extrinsics: each finding is a reason with its figures and an action."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.core.board import Board
from lce_rig.core.calibration import MOTIONS, Calibration, Metrics, SceneOpinion
from lce_rig.core.findings import Finding, Refusal, Severity
from lce_rig.core.geometry import Array, invert, largest_sizes, rotation_angle, sigma_sizes
from lce_rig.core.results import LidarBoard
from lce_rig.detect.findings import LIDAR_OTHER_SIZE
from lce_rig.judge.contributions import largest, measure_action
from lce_rig.judge.findings import (
    CHANNELS_DIFFER,
    EDGE_RESIDUAL,
    FAIL_FACTOR,
    FAR_FROM_NOMINAL,
    FEW_PLACEMENTS,
    FEW_USED,
    INTRINSICS,
    LASER_ANGLES,
    LAST_REJECTED,
    MAY_BE_OFF,
    MOVED,
    NOT_CERTIFIED,
    PATTERN_OFFSET,
    PLANE_RESIDUAL,
    PLANES_APART,
    PLATE_EDGE,
    PLATE_SIZE,
    ROTATION_UNCERTAIN,
    SCALE_OFF,
    SCENE,
    SENSORS_DISAGREE,
    SHARES_DIFFER,
    TRANSLATION_UNCERTAIN,
    Verdict,
    by_cause,
    failing,
    verdict_of,
)
from lce_rig.judge.intrinsics_check import lens_findings
from lce_rig.judge.split_consistency import split_findings
from lce_rig.judge.validate import MIN_PLACEMENTS, Validation
from lce_rig.rig import NominalExtrinsic, QualitySettings, Rig

# A side of the plate counts as measured below this standard deviation; 5 % of it exceeds the beam's spot.
PLATE_KNOWN_M, PLATE_FAIL = 0.03, 0.05
# Rings do not cross the ends of a side that is as upright as this.
_UPRIGHT = 0.87
# Shares of scans without one of two edges, and of ring ends off the outline. Of 15 sessions with the right
# size one lacks edges, by its mounting, and drops none; one drops as many, at hands, and lacks none.
_LACKING, _DROPPED = 0.3, 0.04
# Camera and LiDAR distances differ beyond this share and so many standard deviations, and fail beyond so many
# limits.
_MAX_SCALE_ERROR, _SURE, _SCALE_FAIL = 0.008, 3.0, 2.5
MAX_PLANE_MISFIT_M = 0.012
"""Of both sensors' planes, rms: still boards stay below 8 mm, hand-held ones reach 20 to 30 mm."""
# Lasers on recordings differ from their data sheet by up to 0.08 deg rms in elevation, 0.14 in azimuth.
_MAX_DEG = 0.16
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
    T_view: Array | None = None,
    n_misfits: int = 0,
) -> tuple[Verdict, tuple[Finding, ...]]:
    """Judge extrinsics by all checks.

    Args:
        estimate: the extrinsic with its residuals and refusals, and the result of each channel.
        examination: results of the checks on its captures.
        rig: thresholds, targets and the nominal extrinsic.
        camera: name of the camera.
        lidar: name of the LiDAR.
        n_captures: number of captures, including those without a board.
        others: of other evidence: contradictions between cameras.
        T_view: (4, 4) from the frame of the nominal extrinsic to that of the estimate; None for the same.
        n_misfits: images whose corners fit no pose of the board. A wrong lens causes them.

    Returns:
        The verdict, and the reasons for anything but a pass: worst first, causes before symptoms.
    """
    board, nominal = rig.board.to_board(), rig.nominal(camera, lidar)
    proof, n_placements = estimate.certificate, estimate.diagnostics.n_placements
    are_angles_known = rig.lidars[lidar].has_rings and n_placements >= MIN_PLACEMENTS
    findings = [
        *([] if proof.is_optimal else [NOT_CERTIFIED(gap=proof.gap)]),
        *examination.lens_model,
        *lens_findings(examination.intrinsics, rig.calibration.target_sigma_deg),
        *(angle_findings(estimate.laser_angles) if are_angles_known else ()),
        *plate_findings([estimate.observations[name].lidar for name in estimate.used], board),
        *_scale(examination.scale, board),
        *_pattern(examination.pattern, len(estimate.used)),
        *split_findings(examination.contrasts, rig.calibration),
        *others,
        *_motion(estimate),
        *_channels(estimate, rig),
        *residuals_beyond(estimate.metrics, rig.quality),
        *_captures(estimate, n_captures, rig.quality),
        *_nominal(estimate.T_cam_lidar if T_view is None else invert(T_view) @ estimate.T_cam_lidar, nominal),
        *_precision(estimate, examination, rig),
    ]
    is_weighed = estimate.method == "ml" and estimate.lens is not None
    is_misfit = 2 * n_misfits >= len(estimate.used)
    return _verdict(_blame_lens(_weigh_scale(findings, is_weighed), is_misfit), examination.cov)


def _blame_lens(findings: Sequence[Finding], is_misfit: bool) -> list[Finding]:
    """Make contradicted intrinsics the cause of boards at two places that differ, unless squares are it.

    Captures that fit another mounting are a note beside intrinsics that fit few images, but not those whose
    images show that cameras moved against each other.

    Args:
        findings: against extrinsics.
        is_misfit: whether corners fit no pose of the board in many images.
    """
    blamed = [f for f in findings if f.code == INTRINSICS.code and (is_misfit or f.severity == "warning")]
    if not blamed:
        return list(findings)
    errors = {f.code for f in findings if f.severity == "error"}
    moved = [f for f in findings if is_misfit and f.code == MOVED.code and not f.subject]
    is_cause = any(f.severity == "error" for f in moved) or (
        SHARES_DIFFER.code in errors and SCALE_OFF.code not in errors
    )

    def severity_of(f: Finding) -> Severity:
        if f in blamed and is_cause:
            return "error"
        return "note" if f in moved else f.severity

    return [replace(f, severity=severity_of(f)) for f in findings]


def _weigh_scale(findings: Sequence[Finding], is_weighed: bool) -> list[Finding]:
    """Make squares of another size the cause where planes or captures contradict, a note where none does.

    Captures that fit another mounting, though not before or after the others, are a note beside it.

    Args:
        findings: against extrinsics.
        is_weighed: whether the method estimates the squares.
    """
    if all(f.code != SCALE_OFF.code for f in findings):
        return list(findings)
    scattered = [f for f in findings if f.code == MOVED.code and not f.figures["place"]]
    is_blamed = bool(scattered) or any(f.code == PLANE_RESIDUAL.code for f in findings)
    # Squares that fail by their size alone are seen in planes first.
    is_seen = any(f.code in (PLANES_APART.code, SHARES_DIFFER.code) for f in findings)

    def severity_of(f: Finding) -> Severity:
        if f.code == SCALE_OFF.code:
            is_note = is_weighed and not (is_seen and f.severity == "error")
            return "error" if is_blamed else "note" if is_note else f.severity
        return "note" if f in scattered else f.severity

    return [replace(f, severity=severity_of(f)) for f in findings]


def _verdict(findings: Sequence[Finding], cov: Array) -> tuple[Verdict, tuple[Finding, ...]]:
    """Draw the verdict; where it is marginal, a note says how wrong the extrinsics may be."""
    verdict, others = verdict_of(findings), [f for f in findings if f.code != "verdict.may_be_off"]
    if verdict != "marginal":
        return verdict, by_cause(others)
    rotation_deg, translation_m = largest_sizes(cov)
    return verdict, by_cause([MAY_BE_OFF(rotation_deg=rotation_deg, translation_m=translation_m), *others])


def with_findings(calibration: Calibration, found: Sequence[Finding]) -> Calibration:
    """Add findings to judged extrinsics, which change the verdict unless they are notes."""
    verdict, findings = _verdict([*calibration.findings, *found], calibration.cov)
    return replace(calibration, findings=findings, verdict=verdict)


def with_opinion(calibration: Calibration, opinion: SceneOpinion) -> Calibration:
    """Add the scene's opinion to judged extrinsics; only a contradiction changes the verdict.

    Args:
        calibration: judged by its boards.
        opinion: of the scene without the board.
    """
    return with_findings(replace(calibration, scene=opinion), scene_findings(opinion, calibration))


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
    sizes: dict[str, Any] = {f"change_{worst.unit}": worst.change, f"sigma_{worst.unit}": worst.sigma}
    return [SCENE(severity=failing(sigmas > SCENE_FAILS), action=action, axis=worst.axis, **sizes)]


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
        # No number of captures helps against the LiDAR's own errors; before that, more captures help most as
        # long as their scatter is the larger part.
        is_of_lidar = of_lidar_alone > goal and 2 * of_lidar_alone**2 > sigma**2
        figures: dict[str, Any] = {
            f"sigma_{unit}": sigma,
            f"target_{unit}": goal,
            f"by_axis_{unit}": tuple(axes.tolist()),
            "weakest": MOTIONS[first + worst],
        }
        yield kind(
            # A contradiction is judged by the check that found it; here it says how wrong the result may be.
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


def _scale(scale: tuple[float, float] | None, board: Board) -> list[Finding]:
    """Compare the camera's distances with the LiDAR's."""
    if scale is None or abs(scale[0]) <= max(_MAX_SCALE_ERROR, _SURE * scale[1]):
        return []
    is_fail = abs(scale[0]) - _SURE * scale[1] > _SCALE_FAIL * _MAX_SCALE_ERROR
    return [
        SCALE_OFF(
            severity=failing(is_fail),
            scale=scale[0],
            scale_sigma=scale[1],
            square_m=board.square_m / (1 + scale[0]),
            profile_square_m=board.square_m,
        )
    ]


def angle_findings(sizes: Mapping[str, float]) -> list[Finding]:
    """Find lasers whose angles are not those of the scans."""
    return [
        LASER_ANGLES(angle=name, rms_deg=rms_deg, limit_deg=_MAX_DEG)
        for name, rms_deg in sizes.items()
        if rms_deg > _MAX_DEG
    ]


def _pattern(pattern: tuple[Array, Array] | None, n_captures: int) -> list[Finding]:
    """Find a pattern that sits elsewhere on the plate than the profile states."""
    if pattern is None:
        return []
    (right_m, up_m), cov = pattern[0].tolist(), pattern[1]
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))
    return [PATTERN_OFFSET(right_m=right_m, up_m=up_m, sigma_m=sigma_m, n_captures=n_captures)]


def _motion(estimate: CalibrationEstimate) -> list[Finding]:
    rms_m = estimate.diagnostics.fit_plane_rms_m
    if not rms_m > MAX_PLANE_MISFIT_M:  # NaN where the method has no such residual
        return []
    is_compensated = any(channel.time_offset_s is not None for channel in estimate.channels)
    return [PLANES_APART(action="compensated" if is_compensated else "", rms_m=rms_m)]


def _channels(estimate: CalibrationEstimate, rig: Rig) -> list[Finding]:
    """Compare the channels of one camera, which has one pose."""
    apart = estimate.channel_difference
    if apart is None or (excess := rig.calibration.excess(apart)) <= 1:
        return []
    first, second = (channel.channel for channel in estimate.channels[:2])
    severity = failing(excess > FAIL_FACTOR)
    return [CHANNELS_DIFFER(severity=severity, first=first, second=second, **apart.sizes)]


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


def _nominal(T: Array, nominal: NominalExtrinsic | None) -> list[Finding]:
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


def plate_findings(scans: Iterable[LidarBoard | Refusal], board: Board) -> list[Finding]:
    """Compare the plate's size from the LiDAR with the profile; the uncertainty is mainly the beam's spot.

    On a plate that is too large in the profile by more than the search for its edges reaches, one of two
    opposite edges stays without ring ends, and those of the true edge are dropped.

    Args:
        scans: boards, and refusals: a plate refused for its size counts as measured.
        board: of the profile.
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
        elif scan.code == LIDAR_OTHER_SIZE.code:
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

    Coarse, and before any estimate: it names squares or a lens so wrong that captures are refused.

    Args:
        in_camera, in_lidar: (N, 3) centres of the boards of N captures, m.
        square_m: of the profile.
        n_misfits: images whose corners fit no pose of the board. Wrong squares cause none, a wrong lens does.
    """
    first, second = np.triu_indices(len(in_camera), 1)
    camera_m, lidar_m = (np.linalg.norm(c[first] - c[second], axis=1) for c in (in_camera, in_lidar))
    is_far = (camera_m > _FAR_APART_M) & (lidar_m > _FAR_APART_M)
    if np.count_nonzero(is_far) < 3:
        return []
    ratios = np.log(camera_m[is_far] / lidar_m[is_far])
    ratio = float(np.median(ratios))
    sigma = 1.4826 * float(np.median(np.abs(ratios - ratio))) / np.sqrt(len(in_camera))
    if abs(ratio) < max(_COARSE_SCALE, 4 * sigma):
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


_FAR_APART_M, _COARSE_SCALE = 0.5, 0.03
