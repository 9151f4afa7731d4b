"""Phrases for extrinsics: reasons and notes of a verdict, checks on other captures and sessions."""

import math
from collections.abc import Mapping

from lce_rig.core.calibration import WeakestMotion
from lce_rig.core.findings import Figure, Finding
from lce_rig.words.rendering import Phrase, Template, as_line, figures_apart

_AXES = ("x right", "y down", "z forward")
_RANGES = (
    "measure the LiDAR's constant range errors, which alone exceed the target, correct them in its driver "
    "and lower range_offset_sigma_m and laser_bias_sigma_m in the profile, or put more rings on the board"
)
_LENS = "check that the intrinsics belong to this lens and that the board is flat"
_CORNERS_TOO = "collect captures with the board in all four corners of the image, tilted by 30 to 45 deg"
_SAVE = "Write a profile with the session's intrinsics: `lce-rig intrinsics --save-profile FILE`"
_LOOK = "`lce-rig drift SESSION -o FOLDER` draws the edges"
_WAYS = {
    "bootstrap": "bootstrap samples",
    "left_out": "leave-one-out results",
    "halves": "random halves of the captures",
}
_APART = "{rotation_deg:deg}, {translation_m:mm}"
_CAMERA_AXES = {"x": "x axis (right)", "y": "y axis (down)", "z": "z axis (line of sight)"}


def motion_words(motion: str) -> str:
    """Name a motion by its code, "translation_x" to "rotation_z"; other text is returned unchanged."""
    kind, _, axis = motion.partition("_")
    if axis not in _CAMERA_AXES:
        return motion
    return f"{kind} {'along' if kind == 'translation' else 'about'} the camera's {_CAMERA_AXES[axis]}"


def weakest_words(weakest: WeakestMotion) -> str:
    """Name the least determined motion with its standard deviation."""
    return _weakest(weakest.figures())


def _weakest(figures: Mapping[str, Figure]) -> str:
    sigma, unit, digits = figures.get("weakest_sigma_deg"), "deg", 3
    if sigma is None:
        sigma, unit, digits = 1e3 * float(str(figures["weakest_sigma_m"])), "mm", 1
    return f"{motion_words(str(figures['weakest']))}, sigma {sigma:.{digits}f} {unit}"


def _least_determined(advice: str) -> Template:
    def text(finding: Finding) -> str:
        return f"{advice}; least determined: {_weakest(finding.figures)}"

    text.__doc__ = f"{advice}; least determined: {{weakest}}, {{weakest_sigma_m}} or {{weakest_sigma_deg}}."
    return text


def _control(finding: Finding) -> str:
    """Control failed: moved by {rotation_deg}, {translation_m} ({direction}), the others fit as well."""
    apart = f"{finding.figure('rotation_deg'):.2f} deg, {1000 * finding.figure('translation_m'):.0f} mm"
    direction = motion_words(str(finding.figures["direction"]))
    return f"control failed: moved by {apart} ({direction}), the result fits held-out captures no worse"


def _sensors_disagree(finding: Finding) -> str:
    """The sensors disagree in {n_refused} of {n_captures} captures, {captures}."""
    q = finding.figures
    names = q["captures"]
    assert isinstance(names, tuple)
    shown = ", ".join(map(str, names[:4])) + (" ..." if len(names) > 4 else "")
    return f"the sensors disagree in {q['n_refused']} of {q['n_captures']} captures ({shown})"


def _sigma(unit: str, scale: float) -> Template:
    def text(finding: Finding) -> str:
        what = "rotation" if unit == "deg" else "translation"
        sigma, target = finding.figure(f"sigma_{_suffix(unit)}"), finding.figure(f"target_{_suffix(unit)}")
        by_axis = finding.figures[f"by_axis_{_suffix(unit)}"]
        assert isinstance(by_axis, tuple)
        sizes = [scale * float(str(axis)) for axis in by_axis]
        axes = ", ".join(f"{name} {size:.2g}" for name, size in zip(_AXES, sizes, strict=True))
        sigma_text, target_text = figures_apart(scale * sigma, scale * target)
        return f"{what} standard deviation {sigma_text} {unit}, target {target_text} {unit} ({axes})"

    suffix = _suffix(unit)
    text.__doc__ = f"Standard deviation {{sigma_{suffix}}}, target {{target_{suffix}}}, {{by_axis_{suffix}}}."
    return text


def _suffix(unit: str) -> str:
    return "deg" if unit == "deg" else "m"


def _intrinsics(finding: Finding) -> str:
    """Intrinsics do not fit: {rms_px}, {possible_px}, {displacement_px}, {turn_deg}, {focal_ratio}."""
    q = finding.figures
    how = "do not fit" if finding.severity == "error" else "fit only roughly"
    parts = ["corners fit, but only with wrong board poses"]
    if q["is_visible"]:
        rms_px, possible_px = finding.figure("rms_px"), finding.figure("possible_px")
        parts = [f"reprojection error {rms_px:.2f} px, possible {possible_px:.2f} px"]
    displacement_px = q["displacement_px"]
    if not isinstance(displacement_px, float) or not math.isfinite(displacement_px):
        parts.append("they project to no pixels where boards were seen")
    elif q["is_bent"]:
        parts.append(
            f"pixels displaced by {displacement_px:.1f} +- {finding.figure('displacement_sigma_px'):.1f} px"
        )
    if q["is_turned"]:
        turn = f"{finding.figure('turn_deg'):.2f} +- {finding.figure('turn_sigma_deg'):.2f} deg"
        parts.append(f"that alone rotates the extrinsics by {turn}")
    if q["is_focal_off"]:
        percent = 100 * (finding.figure("focal_ratio") - 1)
        larger = "larger" if percent > 0 else "smaller"
        parts.append(
            f"focal length {abs(percent):.1f} +- {100 * finding.figure('focal_sigma'):.1f} % {larger}"
        )
    return f"the profile's intrinsics {how}: {'; '.join(parts)}"


def _reach(finding: Finding) -> str:
    """The session covers {covered}, determines pixels near the border to {image_sigma_px}, {limit_px}."""
    q = finding.figures
    sigma_px, limit_px = q["image_sigma_px"], finding.figure("limit_px")
    known = "does not determine pixels near its border"
    if isinstance(sigma_px, float) and math.isfinite(sigma_px):
        sigma_text, limit_text = figures_apart(sigma_px, limit_px)
        known = f"determines pixels near its border to {sigma_text} px (limit {limit_text} px)"
    return f"the session covers {100 * finding.figure('covered'):.0f} % of the image and {known}"


def _collect_first(finding: Finding) -> str:
    """Collect in all four corners, as {covered}, {image_sigma_px}, {limit_px} say; then run intrinsics."""
    return (
        f"check whether lens, focus or resolution were changed. {as_line(_reach(finding))} "
        f"{as_line(_CORNERS_TOO)} Then run `lce-rig intrinsics --save-profile FILE`"
    )


def _scale(finding: Finding) -> str:
    """Camera distances differ by {scale} +- {scale_sigma}: squares {square_m}, not {profile_square_m}."""
    scale = finding.figure("scale")
    longer = "longer" if scale > 0 else "shorter"
    percent = f"{100 * abs(scale):.1f} +- {100 * finding.figure('scale_sigma'):.1f} %"
    wanted_m = finding.figure("profile_square_m")
    squares = f"{1000 * finding.figure('square_m'):.1f} mm instead of {1000 * wanted_m:.1f} mm"
    return (
        f"camera distances are {percent} {longer} than the LiDAR's: the squares measure {squares}, "
        "or the intrinsics belong to another lens"
    )


def _widened(finding: Finding) -> str:
    """Standard deviations are {ratio} times the method's, as {spread} vary."""
    way = _WAYS[str(finding.figures["spread"])]
    return f"standard deviations widened {finding.figure('ratio'):.1f} times: {way} vary that much"


_CAUSES = {
    "captures": "the scatter of the captures",
    "lidar_ranges": "the LiDAR's constant range errors",
    "focal_length": "the focal length",
    "principal_point": "the principal point",
    "distortion": "the lens distortion",
    "square_size": "the size of the squares",
    "pattern_offset": "the pattern's place on the plate",
    "plate_size": "the plate's size",
    "board_bow": "the board's bow",
}
_CONTRADICTIONS = {
    "intrinsics": "the profile's intrinsics and those of the session's boards",
    "scale": "the camera's distances and the LiDAR's",
    "channels": "the camera's channels",
    "cameras": "the cameras",
    "group_rest": "two groups of captures",
}
_MEASURE_LENS = (
    "measure the intrinsics (`lce-rig intrinsics --save-profile FILE`), or enter their standard deviations "
    "in the profile"
)
_MEASURE = {
    "resolve": "resolve what contradicts first: more captures do not reduce this",
    "measure_focal_length": _MEASURE_LENS,
    "measure_principal_point": _MEASURE_LENS,
    "measure_distortion": _MEASURE_LENS,
    "measure_square_size": "measure across all squares, divide, and enter square_m and square_sigma_m",
    "measure_pattern_offset": (
        "measure the pattern's margins on all four sides of the plate, and enter pattern_offset_m and "
        "pattern_offset_sigma_m"
    ),
    "measure_plate_size": "measure the plate, and enter width_m, height_m and plate_sigma_m",
    "measure_board_bow": "lay a straight edge across the board, and enter bow_sigma_m",
}


def cause_words(source: str) -> str:
    """Name a cause of standard deviations, as `Contribution.source`."""
    if source in _CAUSES:
        return _CAUSES[source]
    check = source.removeprefix("contradiction_")
    subsets = check.replace("_", " and ")
    return f"the contradiction of {_CONTRADICTIONS.get(check, f'{subsets} captures')}"


def _largest_cause(finding: Finding) -> str:
    """Of the standard deviation {total_m} or {total_deg}, {share} is {source}: {sigma_m} or {sigma_deg}."""
    q = finding.figures
    if "sigma_m" in q:
        what = "translation"
        sizes = f"{1000 * finding.figure('sigma_m'):.1f} of {1000 * finding.figure('total_m'):.1f} mm"
    else:
        what, sizes = (
            "rotation",
            f"{finding.figure('sigma_deg'):.2f} of {finding.figure('total_deg'):.2f} deg",
        )
    return (
        f"largest cause of the {what}'s uncertainty: {cause_words(str(q['source']))}, {sizes} "
        f"({100 * finding.figure('share'):.0f} % of the variance)"
    )


def _may_be_off(finding: Finding) -> str:
    """With 95 % probability each, errors are smaller than {rotation_deg} and {translation_m}."""
    off_deg, off_mm = finding.figure("rotation_deg"), 1000 * finding.figure("translation_m")
    return (
        f"with 95 % probability each, the rotation is off by less than {off_deg:.2f} deg and the translation "
        f"by less than {off_mm:.0f} mm"
    )


def _known_better(finding: Finding) -> str:
    """The session's boards determine {source} to {error_sigma}, the profile to {profile_sigma}: {error}."""
    source = str(finding.figures["source"])
    scale, unit = (1.0, "px") if source == "principal_point" else (100.0, "%")
    error, sigma, of_profile = (
        scale * finding.figure(name) for name in ("error", "error_sigma", "profile_sigma")
    )
    return (
        f"the session's boards determine {cause_words(source)} better than the profile: {error:+.2f} +- "
        f"{sigma:.2f} {unit} from it, which has +- {of_profile:.2f} {unit}"
    )


def _plate(finding: Finding) -> str:
    """The plate's {side} is {measured_m} in the scans, {profile_m} in the profile."""
    measured_m, profile_m = finding.figure("measured_m"), finding.figure("profile_m")
    percent, size = 100 * abs(measured_m / profile_m - 1), "larger" if measured_m > profile_m else "smaller"
    return (
        f"plate {finding.figures['side']} {measured_m:.3f} m in the scans, {profile_m:.3f} m in the profile: "
        f"{percent:.1f} % {size}"
    )


def _commonest(finding: Finding) -> str:
    """The commonest of {causes} of refusal with their counts, or: collect more captures."""
    causes = finding.figures["causes"]
    assert isinstance(causes, tuple)
    lines = [f"{cause[0]} x {cause[2]}" for cause in causes if isinstance(cause, tuple)]
    return "\n".join(lines) or "collect more captures"


def _undetermined(finding: Finding) -> str:
    """{motions} undetermined by {n_captures} captures: boards nearly parallel, spread {spread_deg}."""
    motions, n_captures = finding.figures["motions"], finding.figures["n_captures"]
    assert isinstance(motions, tuple)
    names = " and ".join(motion_words(str(motion)) for motion in motions)
    return (
        f"{names} cannot be determined from {n_captures} captures: their boards are nearly parallel "
        f"(normals spread by {finding.figure('spread_deg'):.1f} deg)"
    )


def _agree(finding: Finding) -> str:
    """The {n_sessions} calibrations of {camera} and {lidar} agree: {rotation_deg}, {translation_m} apart.

    {p} is the chance to differ more; {is_generous}: the standard deviations predict more than is seen.
    """
    q = finding.figures
    how = "less than" if q["is_generous"] else "as"
    apart = f"{finding.figure('rotation_deg'):.3f} deg and {1000 * finding.figure('translation_m'):.1f} mm"
    return (
        f"the {q['n_sessions']} calibrations of {q['camera']} and {q['lidar']} agree: "
        f"they differ by at most {apart}, {how} their standard deviations predict"
    )


def _scene_change(finding: Finding) -> str:
    sizes = [finding.figure(name) for name in ("rotation_deg", "rotation_sigma_deg")]
    sizes += [1000 * finding.figure(name) for name in ("translation_m", "translation_sigma_m")]
    return f"{sizes[0]:.2f} deg, {sizes[2]:.0f} mm (expected {sizes[1]:.2f} deg, {sizes[3]:.0f} mm)"


def _scene_used(finding: Finding) -> str:
    """The scene moved the boards' extrinsics by {rotation_deg}, {translation_m}; {n_captures}, {n_edges}.

    Expected: {rotation_sigma_deg}, {translation_sigma_m}.
    """
    return f"the scene moved the boards' extrinsics by {_scene_change(finding)}"


def _scene_not_used(finding: Finding) -> str:
    """The scene would move the extrinsics by {rotation_deg}, {translation_m}; {n_captures}, {n_edges}.

    Expected: {rotation_sigma_deg}, {translation_sigma_m}.
    """
    return f"the scene contradicts the boards and is not used: it would move them by {_scene_change(finding)}"


def _scene(finding: Finding) -> str:
    """The scene contradicts {axis} by {change_deg} or {change_m}; {sigma_deg}, {sigma_m}, {sigmas}.

    In {n_captures} captures, {n_axes} axes contradict.
    """
    q = finding.figures
    if "change_deg" in q:
        change = f"{finding.figure('change_deg'):+.2f} +- {finding.figure('sigma_deg'):.2f} deg"
    else:
        change = f"{1000 * finding.figure('change_m'):+.0f} +- {1000 * finding.figure('sigma_m'):.0f} mm"
    return f"the edges of the scene contradict the extrinsics: {motion_words(str(q['axis']))} by {change}"


PHRASES: dict[str, Phrase] = {
    "verdict.text": Phrase("{text}", "{advice}"),
    "verdict.no_certificate": Phrase(
        "not certified: method {method} has no certificate", "use --method paper"
    ),
    "verdict.not_certified": Phrase(
        "not certified as the global minimum (gap {gap:.1e})", "collect more captures"
    ),
    "verdict.rotation_uncertain": Phrase(
        _sigma("deg", 1.0),
        _least_determined("collect more captures"),
        {"measure_ranges": _least_determined(_RANGES), **_MEASURE},
    ),
    "verdict.translation_uncertain": Phrase(
        _sigma("mm", 1000.0),
        _least_determined("collect more captures"),
        {"measure_ranges": _least_determined(_RANGES), **_MEASURE},
    ),
    "verdict.plane_residual": Phrase(
        "LiDAR points {mean_m:mm} on average from the camera's board planes (limit {limit_m:mm})",
        "hold the board still, check board size and intrinsics",
    ),
    "verdict.edge_residual": Phrase(
        "ring ends {mean_m:mm} on average from the board's edges (limit {limit_m:mm})",
        "hold the board still, check board size and intrinsics",
    ),
    "verdict.held_out": Phrase(
        "held-out captures fit worse ({held_out_m:1mm}) than captures used ({fitted_m:1mm})",
        "collect more captures",
    ),
    "verdict.planes_apart": Phrase(
        "camera and LiDAR board planes differ by {rms_m:mm} rms (still boards: under 10 mm)",
        "hold the board still and check the image-scan matching",
        {"compensated": "move the board more slowly and evenly, about 10 cm/s"},
    ),
    "verdict.channels_differ": Phrase(
        "{first} and {second} of one camera differ by " + _APART + ", beyond their uncertainty",
        "calibrate each alone (--channels) and find the captures that contradict it",
    ),
    "verdict.sensors_disagree": Phrase(
        _sensors_disagree,
        "look for a moving board, a second board, or wrong matching",
    ),
    "verdict.few_used": Phrase(
        "{n_used} of {n_captures} captures could be used", "run `lce-rig check` for the causes"
    ),
    "verdict.few_placements": Phrase(
        "{n_used} captures show {n_placements} different placements (minimum {n_needed})",
        "move the board between captures",
    ),
    "verdict.far_from_nominal": Phrase(
        "{rotation_deg:1deg}, {translation_m:mm} from the nominal extrinsics "
        "(tolerance {tolerance_deg:g} deg, {tolerance_m:mm})",
        "check nominal_extrinsics and the frames in the profile, and that these sensors were used",
    ),
    "verdict.plate_size": Phrase(_plate, "measure the plate"),
    "verdict.intrinsics": Phrase(
        _intrinsics,
        "check whether lens or resolution were changed. " + _SAVE,
        {
            "refocused": "check whether the lens was refocused. " + _SAVE,
            "collect": _collect_first,
        },
    ),
    "intrinsics.better": Phrase(
        "the session determines the intrinsics better than the profile: it covers {covered:percent} of the "
        "image and determines pixels near its border to {image_sigma_px:.2f} px (limit {limit_px:.2f} px)",
        "put them into the profile",
    ),
    "intrinsics.fit": Phrase("the profile's intrinsics fit the boards of the session", "keep them"),
    "intrinsics.undetermined": Phrase(_reach, _CORNERS_TOO),
    "verdict.changed": Phrase(
        "extrinsics change significantly at capture {capture}, by " + _APART,
        "fasten the sensors, one may have moved, and collect again",
    ),
    "verdict.two_groups": Phrase(
        "{n_captures} captures ({captures}) fit other extrinsics than the rest, significantly, by " + _APART,
        "fasten the sensors, one may have moved to and fro, and collect again",
    ),
    "verdict.shares_differ": Phrase(
        "{first} and {second} boards differ significantly, by " + _APART,
        _LENS,
        {"near": "check the squares' size and the focal length, and that the board is flat"},
    ),
    "verdict.control": Phrase(
        _control,
        "collect more captures; if this persists, re-measure the board",
    ),
    "verdict.scale": Phrase(_scale, "measure the squares"),
    "verdict.edge_shift": Phrase(
        "ring ends {shift_m:mm} beyond the plate's edges (limit {limit_m:mm}, the beam's width)",
        "measure the plate",
    ),
    "verdict.laser_offset": Phrase(
        "ranges of laser ring {ring} {offset_m:mm} too long (limit {limit_m:mm}, from the profile)",
        "correct them in the LiDAR's driver",
    ),
    "verdict.camera_changed": Phrase(
        "{subject}: relative pose from the images changes significantly at capture {capture}, by " + _APART,
        "fasten the cameras, one may have moved, and collect again",
    ),
    "verdict.camera_shares_differ": Phrase(
        "{subject}: relative poses from images of {first} and {second} boards differ significantly, by "
        + _APART,
        _LENS,
        {"near": "check the squares' size and the focal length, and that the board is flat"},
    ),
    "verdict.cameras_scatter": Phrase(
        "{subject}: board positions from the images differ by {rms_m:mm} rms for any relative pose "
        "({scatter:.1f} times the typical value)",
        "hold the board still between the images and check the intrinsics",
    ),
    "verdict.cameras_differ": Phrase(
        "{subject}: board positions differ by {rms_m:mm} rms ({images_rms_m:mm} from the images alone), "
        "relative poses from extrinsics and images by " + _APART,
        "check whether a camera has moved, and the intrinsics",
    ),
    "verdict.scene_used": Phrase(_scene_used),
    "verdict.scene_unknown": Phrase(
        "the scene shows nothing that the boards do not show better; {n_edges} edges, {n_captures} captures",
    ),
    "verdict.scene_not_used": Phrase(
        _scene_not_used,
        "check the intrinsics and the board's size. `lce-rig drift SESSION -o FOLDER` draws the edges",
    ),
    "verdict.widened": Phrase(_widened),
    "verdict.largest_cause": Phrase(_largest_cause, "", _MEASURE),
    "verdict.known_better": Phrase(_known_better),
    "verdict.may_be_off": Phrase(_may_be_off),
    "verdict.scene": Phrase(
        _scene,
        f"check the intrinsics, squares and plate. {_LOOK}",
        {
            "deployed": f"check whether a sensor has moved since. {_LOOK}",
            "distances": f"measure the squares and check the focal length. {_LOOK}",
            "times": f"hold the board still and check the image-scan matching. {_LOOK}",
        },
    ),
    "verify.elsewhere": Phrase(
        "in {n_elsewhere} of {n_captures} captures the scan has no surface where the extrinsics place the "
        "board"
    ),
    "verify.unseen": Phrase("both sensors detect the board in no capture"),
    "results.agree": Phrase(
        "the {n_sessions} results of {camera} and {lidar} agree: they differ by up to {rotation_deg:3deg} "
        "and {translation_m:1mm}; common errors stay hidden, as they share captures",
    ),
    "results.disagree": Phrase(
        "{first} and {second} of {camera} and {lidar} disagree: results differ by up to {rotation_deg:3deg} "
        "and {translation_m:1mm}, more than their uncertainties allow",
        "compare the overlays of both (`lce-rig verify --name NAME`) and collect more captures",
    ),
    "results.outdated": Phrase(
        "{subject}: the profile or the captures that it used have changed since",
        "run `lce-rig calibrate` again with the same options",
    ),
    "repeat.agree": Phrase(_agree),
    "repeat.disagree": Phrase(
        "the {n_sessions} calibrations of {camera} and {lidar} disagree: they differ by up to "
        "{rotation_deg:3deg} and {translation_m:1mm}, {ratio:.1f} times as much as predicted",
        "do not use any of them until the cause is known",
        {"odd_one": "find the fault in {odd_one}, without it the others agree"},
    ),
    "union.moved": Phrase(
        "the extrinsics of {camera} and {lidar} from {first} and {second} differ by {rotation_deg:3deg} and "
        "{translation_m:1mm}, more than their uncertainties allow (chance {p:.2g})",
        "the sensors were moved in between, or one of the sessions is wrong: calibrate them separately",
        {"odd_one": "leave out {odd_one}: the sensors were moved, or the session is wrong; the others agree"},
    ),
    "repeat.failed": Phrase(
        "the calibration of {subject} ({camera} and {lidar}) failed",
        "run `lce-rig calibrate` for its reasons",
    ),
    "shortage.few_detected": Phrase(
        "both sensors found the board in {n_detected} of {n_captures} captures (minimum {n_needed})",
        _commonest,
    ),
    "shortage.few_captures": Phrase(
        "{n_captures} captures show the board in both sensors (minimum {n_needed})",
        "add captures: ten or more, with the board at different places and tilts",
    ),
    "shortage.few_agree": Phrase(
        "only {n_agreeing} of {n_captures} captures agree with one set of extrinsics (minimum {n_needed})",
        "check the board's size, the intrinsics and the pairing of images with scans; add captures",
    ),
    "shortage.undetermined": Phrase(
        _undetermined,
        "add captures with the board tilted by 20 deg or more, left and right as well as up and down",
    ),
    "shortage.text": Phrase("{text}", "{advice}"),
    "repeat.not_calibrated": Phrase("{subject}: {sensors}: {what}", "{hint}"),
    "repeat.only_one": Phrase("{camera} and {lidar} are calibrated in {subject} only"),
    "repeat.other_board": Phrase("{first} and {subject} were taken with different boards"),
}
