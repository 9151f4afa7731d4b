"""Findings of the causes that explain the captures: kind, size, and displacement of the extrinsics."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lce_rig.calibrate.likelihood.hypothesis import Hypothesis, at_full_weight
from lce_rig.calibrate.likelihood.layout import Indices
from lce_rig.calibrate.result import BY_ALGORITHM_1, CalibrationEstimate, Sensitivity
from lce_rig.core.findings import Finding, Severity
from lce_rig.core.geometry import Array, difference, tangent_sizes
from lce_rig.core.results import Observation
from lce_rig.judge.contributions import summed_covariance
from lce_rig.judge.explanations import CONSTANT, MOUNTINGS, SCATTER, Cause, Selected, explain
from lce_rig.judge.findings import (
    BOW,
    DRIFTED,
    FAIL_FACTOR,
    FOCUS_DRIFT,
    LASER_ANGLES,
    LENS,
    MOVED,
    OF_SIZES,
    OUTLIER,
    PATTERN_OFFSET,
    PLATE_SIZE,
    PLATES,
    RANGE_CONTRAST,
    RANGE_OFFSET,
    RANGE_SCALE,
    SCALE_OFF,
    SCATTERED,
    TWO_BOARDS,
)
from lce_rig.judge.reach import CHANGED_CHI2
from lce_rig.rig import CalibrationSettings, Rig

# Minimum number of captures to test for changes during the session: extrinsics of two or three captures
# absorb other errors. Constant errors are tested on any number.
_FEWEST = 6
MAX_PLANE_MISFIT_M = 0.012
"""Limit of the rms difference between both sensors' planes: still boards stay below 8 mm, hand-held ones
reach 20 to 30 mm."""


def hypothesis_of(estimate: CalibrationEstimate, rejected: Sequence[Observation]) -> Hypothesis | None:
    """Give all captures of an estimate full weight, to test explanations; None without a likelihood.

    Args:
        estimate: estimate of any method.
        rejected: captures with the board in both sensors that the estimate does not use.
    """
    if estimate.joint is None:
        return None
    joint, camera = estimate.joint
    seen = sorted([*estimate.observations.values(), *rejected], key=lambda o: o.capture)
    lenses = [estimate.lens]
    if joint.state.layout.base is not None:
        lenses.append(estimate.lens_of_base)
    return at_full_weight(joint, seen, lenses, camera)


def find_causes(
    hypothesis: Hypothesis,
    estimate: CalibrationEstimate,
    target: CalibrationSettings,
    causes: Sequence[Cause],
) -> tuple[Selected, ...]:
    """Find errors that explain the captures of an estimate better than noise, up to the first reason.

    Args:
        hypothesis: the likelihood of its captures.
        estimate: estimate of any method.
        target: target standard deviations.
        causes: to test; only mountings for two LiDARs, or two cameras.
    """
    found: list[Selected] = []
    tested = causes if len(estimate.observations) >= _FEWEST else [c for c in causes if c in CONSTANT]
    for selected in explain(hypothesis, tested):
        found.append(selected)
        if selected.gain.cause != "alone" and _severity(selected.change, target) != "note":
            break
    # After a motion, the extrinsics in use differ by the captures that they rely on, too.
    if any(each.gain.cause in MOUNTINGS for each in found):
        return tuple(found)
    return tuple(_in_use(each, estimate) for each in found)


def _in_use(selected: Selected, estimate: CalibrationEstimate) -> Selected:
    """Measure the change relative to the extrinsics in use, if these are significantly wrong.

    Algorithm 1 estimates no constant errors, so its extrinsics may be farther off than the likelihood's.
    """
    apart = difference(selected.after.T_in_use, estimate.T_cam_lidar)
    cov = estimate.cov + summed_covariance([e for e in estimate.sensitivities if e.source != BY_ALGORITHM_1])
    is_off = float(apart @ np.linalg.solve(cov, apart)) > CHANGED_CHI2
    return selected._replace(change=apart) if is_off else selected


def report_causes(
    selected: Sequence[Selected], estimate: CalibrationEstimate, rig: Rig, camera: str, lidar: str
) -> tuple[list[Finding], list[Sensitivity]]:
    """Report the causes, each with a severity from its displacement of the extrinsics in use.

    The largest displacement is the reason, if it is one. The others are notes, as they may follow from it.

    Returns:
        The findings, and the displacement of the extrinsics that resolves the reason, if there is one.
    """

    def rank(each: Selected) -> tuple[bool, float]:
        return each.gain.cause == "alone", -rig.calibration.in_targets(*tangent_sizes(each.change))

    by_size = sorted(selected, key=rank)
    named = [(each, _finding(each, estimate, rig, camera, lidar)) for each in by_size]
    found = [finding for _, finding in named if finding is not None]
    reasons = [(f, each) for s in ("error", "warning") for each, f in named if f and f.severity == s]
    if reasons:
        reason, cause = reasons[0]
        others = [replace(each, severity="note") for each in found if each is not reason]
        # Sizes of the plate follow from others.
        follows = reason.code in PLATES and not OF_SIZES.isdisjoint(each.code for each in others)
        is_resolved = follows or _is_over(cause, estimate.used)
        return [reason, *others], [] if is_resolved else [_displacement(cause, reason)]
    if estimate.joint is None:
        return found, []
    levels = estimate.joint[0].levels
    noise = levels.largest_of_images
    if selected:
        noise = min(noise, selected[-1].after.with_fitted_noise.levels.largest_of_images)
    if levels.of_ranges > max(noise, SCATTER):
        return [*found, SCATTERED(lidar, action="ranges", ratio=levels.of_ranges)], []
    return [*found, *([SCATTERED(ratio=noise)] if noise > SCATTER else [])], []


def _displacement(cause: Selected, reason: Finding) -> Sensitivity:
    """Return the displacement of the extrinsics that resolves a cause.

    The result lies between two groups of captures that differ, which gives half of their change. After a move
    the whole change counts, as either side may hold now.
    """
    share = 0.5 if cause.gain.cause == "groups" else 1.0
    return Sensitivity(reason.code.removeprefix("verdict."), 1.0, share * cause.change[None])


def is_explained(selected: Sequence[Selected], estimate: CalibrationEstimate) -> bool:
    """Check whether the causes bring both sensors' planes together, so that symptoms follow from them."""
    # NaN if the method has no such residual.
    most_m = float(np.fmax(estimate.diagnostics.fit_plane_rms_m, MAX_PLANE_MISFIT_M)) / 2
    return bool(selected) and selected[-1].after.planes_apart_m <= most_m


def _is_over(selected: Selected, used: Sequence[str]) -> bool:
    """Check whether a sensor moved after the first captures and the result uses only later ones."""
    explanation = selected.gain.explanation
    if explanation.cause != "moved" or explanation.weights[0] == 0:
        return False
    names = zip(selected.after.captures, explanation.weights, strict=True)
    return not {name for name, weight in names if weight > 0} & set(used)


def _severity(change: Array, target: CalibrationSettings) -> Severity:
    """Return the severity of a change (6,) of the extrinsics in use, in units of the targets."""
    size = target.in_targets(*tangent_sizes(change))
    if size <= 1:
        return "note"
    return "error" if size > FAIL_FACTOR else "warning"


def _finding(
    selected: Selected, estimate: CalibrationEstimate, rig: Rig, camera: str, lidar: str
) -> Finding | None:
    """Report one cause; None for a single capture that the result does not use."""
    cause, after = selected.gain.cause, selected.after
    rotation_deg, translation_m = tangent_sizes(selected.change)
    severity = _severity(selected.change, rig.calibration)
    apart: dict[str, Any] = {"rotation_deg": rotation_deg, "translation_m": translation_m}
    if cause in MOUNTINGS:
        return _of_mounting(selected, estimate, apart, severity)
    at, board, n = after.state.layout, rig.board, len(after.captures)
    z, cov = after.state.z, after.reduced.cost.covariance()
    figures: dict[str, Any] = {"severity": severity, **apart}

    def value(columns: Indices) -> tuple[float, float]:
        return float(z[columns].mean()), float(np.sqrt(cov[columns[:, None], columns].mean()))

    if cause == "squares":
        scale, sigma = value(at.z.of(["squares"]))
        return SCALE_OFF(
            scale=-scale,
            scale_sigma=sigma,
            square_m=board.square_m * (1 + scale),
            profile_square_m=board.square_m,
            **figures,
        )
    if cause == "range_offset":
        offset_m, sigma_m = value(at.lasers[0])
        enter_m = rig.lidars[lidar].range_offset_m + offset_m
        return RANGE_OFFSET(lidar, offset_m=offset_m, sigma_m=sigma_m, enter_m=enter_m, **figures)
    if cause == "range_scale":
        scale, sigma = value(at.z.of(["stretch"]))
        return RANGE_SCALE(lidar, scale=scale, scale_sigma=sigma, **figures)
    if cause == "range_contrast":
        contrast_m, sigma_m = value(at.z.of(["contrast"]))
        return RANGE_CONTRAST(lidar, contrast_m=contrast_m, sigma_m=sigma_m, **figures)
    if cause == "pattern":
        place = at.z.of(["pattern"])
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov[place[:, None], place])[-1]))
        right_m, up_m = z[place].tolist()
        return PATTERN_OFFSET(right_m=right_m, up_m=up_m, sigma_m=sigma_m, n_captures=n, **figures)
    if cause == "plate":
        k = int(np.argmax(np.abs(z[at.plate])))
        side, profile_m = (("width", board.width_m), ("height", board.height_m))[k]
        # The likelihood does not separate the plate's size from the edge shift; the scans' outlines do.
        qualities = [o.lidar.quality for o in estimate.observations.values()]
        sizes = [(getattr(q, f"{side}_m"), getattr(q, f"{side}_sigma_m")) for q in qualities]
        measured_m, sigma_m = np.median(sizes, axis=0).tolist()
        return PLATE_SIZE(
            side=side, measured_m=measured_m, sigma_m=sigma_m, profile_m=profile_m, n_captures=n, **figures
        )
    if cause == "bow":
        bows = z[at.z.of(["bow"])]
        k = int(np.argmax(np.abs(bows)))
        return BOW(side=("width", "height")[k], bow_m=abs(float(bows[k])), **figures)
    if cause in ("azimuths", "elevations"):
        errors = z[at.lasers[1 if cause == "azimuths" else 2]]
        rms_deg = float(np.degrees(np.std(errors)))
        return LASER_ANGLES(lidar, angle=cause.removesuffix("s"), rms_deg=rms_deg, **figures)
    if cause == "lens":
        return LENS(camera, **figures)
    if cause == "two_boards":
        share, cut = float(selected.gain.value[0]), selected.gain.explanation.cut
        return TWO_BOARDS(capture=after.captures[cut], share=share, **figures)
    return FOCUS_DRIFT(camera, share=-float(selected.gain.value[2]), **figures)


def _of_mounting(
    selected: Selected, estimate: CalibrationEstimate, apart: dict[str, Any], severity: Severity
) -> Finding | None:
    """Report captures with another mounting, or a mounting that drifts."""
    explanation, names = selected.gain.explanation, selected.after.captures
    chance = float(10.0**selected.gain.log10_chance)
    if explanation.cause == "drift":
        return DRIFTED(severity=severity, chance=chance, **apart)
    captures = tuple(name for name, w in zip(names, explanation.weights, strict=True) if w > 0)
    if explanation.cause == "alone":
        if not set(captures) & set(estimate.used):
            return None
        # A note: its weight in the result is small.
        return OUTLIER(severity="note", capture=captures[0], **apart)
    figures: dict[str, Any] = {
        "captures": captures,
        "n_captures": len(captures),
        "place": "",
        "neighbour": "",
    }
    if explanation.cause == "moved":
        figures = describe_move(names, explanation.cut)
    severity = "warning" if severity == "error" and _is_over(selected, estimate.used) else severity
    return MOVED(severity=severity, chance=chance, **figures, **apart)


def describe_move(captures: Sequence[str], cut: int) -> dict[str, Any]:
    """Return the smaller side of a move before capture `cut`, and the capture next to it, as figures."""
    is_first = 2 * cut < len(captures)
    own = tuple(captures[:cut] if is_first else captures[cut:])
    neighbour = captures[cut if is_first else cut - 1]
    place = "first" if is_first else "last"
    return {"captures": own, "n_captures": len(own), "place": place, "neighbour": neighbour}
