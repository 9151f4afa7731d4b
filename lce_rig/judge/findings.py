"""Kinds of findings against extrinsics and intrinsics: reasons and notes of a verdict."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

from lce_rig.core.findings import Figure, Finding, Kind, Severity, worst
from lce_rig.core.phrasing import fill

Verdict = Literal["pass", "marginal", "fail"]
# Probability below which sessions that agree are reported to differ more than predicted.
_UNLIKELY = 0.05
_ANY = ""
_OF_CAPTURES = frozenset(
    (
        "verdict.plane_residual",
        "verdict.edge_residual",
        "verdict.planes_apart",
        "verdict.sensors_disagree",
        "verdict.few_used",
    )
)
"""Symptoms in the captures, also of errors that hardly displace the extrinsics."""
_FOLLOWS: Mapping[str, Collection[str]] = {
    _ANY: (
        *_OF_CAPTURES,
        "verdict.channels_differ",
        "verdict.cameras_differ",
        "verdict.far_from_nominal",
        "verdict.scene",
    ),
    "association.mirrored": ("verdict.intrinsics",),
    "verdict.channels_turned": ("verdict.time_offset", "verdict.scatter", "verdict.moved", "verdict.drift"),
    "verdict.time_offset": ("verdict.scatter",),
}
"""Codes of the findings that follow from a cause; symptoms follow from any."""
_SYMPTOMS = frozenset(_FOLLOWS[_ANY])
_UNCERTAIN = frozenset(("verdict.rotation_uncertain", "verdict.translation_uncertain"))
OF_SIZES = frozenset(("verdict.scale", "verdict.range_offset", "verdict.range_scale", "verdict.laser_angles"))
"""Causes from which wrong sizes of the plate follow."""
PLATES = frozenset(("verdict.plate_size", "verdict.plate_edge"))
"""Findings of wrong sizes of the plate."""
_FIRST = (
    "association",
    "verdict.exchanged",
    "verdict.channels_turned",
    "verdict.lens_model",
    "verdict.readout",
    "verdict.intrinsics",
    "verdict.time_offset",
)
"""Causes that precede others of their severity, as they are detected without an estimate."""
_LACKS = {
    ("verdict.few_placements", ""),
    ("verdict.rotation_uncertain", ""),
    ("verdict.translation_uncertain", ""),
    ("verdict.not_certified", ""),
}
"""Code and action of findings against which more captures help."""
_VERDICTS: Mapping[Severity, Verdict] = {"note": "pass", "warning": "marginal", "error": "fail"}
_APART = "{rotation_deg:deg}, {translation_m:mm}"
_CORNERS_TOO = "hold the board in all four corners of the image, tilted by 30 to 45 deg"
_SAVE = "`lce-rig intrinsics {session} --save-profile FILE`"
_LOOK = "(drawn by `lce-rig drift {session} -o FOLDER`)"
_STILL = "hold the board still, check board size and intrinsics"
_RANGES = "measure the LiDAR's ranges, then lower range_offset_sigma_m"
_MEASURE = {
    "resolve": "resolve what contradicts first: more captures do not reduce this",
    "measure_intrinsics": _CORNERS_TOO,
    "measure_square_size": "measure across all squares, divide, and enter square_m and square_sigma_m",
    "measure_pattern_offset": "measure the pattern's margins: pattern_offset_m, pattern_offset_sigma_m",
    "measure_plate_size": "measure the plate, and enter width_m, height_m and plate_sigma_m",
    "measure_board_bow": "lay a straight edge across the board, and enter bow_sigma_m",
    "other_method": "calibrate without `--method paper`",
}
_CAUSES = {
    "captures": "the scatter of the captures",
    "lidar_ranges": "the LiDAR's constant range errors",
    "intrinsics": "the intrinsics",
    "square_size": "the size of the squares",
    "pattern_offset": "the pattern's place on the plate",
    "plate_size": "the plate's size",
    "board_bow": "the board's bow",
    "algorithm_1": "Algorithm 1, which differs from the likelihood's estimate",
}


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict that results from findings."""
    return _VERDICTS[worst(findings)]


def arrange(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Sort findings: the cause, then other reasons, the findings that follow from the cause, and notes.

    The cause is the worst finding that is not a symptom. Symptoms follow from it, and the cause is as severe
    as the worst of them. Standard deviations follow if the contradiction is their largest part, sizes of the
    plate if ranges, lasers' angles or squares are off.
    """
    causes = [f for f in findings if f.severity != "note" and f.code not in _SYMPTOMS | _UNCERTAIN]
    sizes = [f for f in findings if f.code in OF_SIZES]
    if sizes:
        causes = [f for f in causes if f.code not in PLATES]
    order = {id(f): k for k, f in enumerate(findings)}

    def rank(finding: Finding) -> tuple[bool, bool, int]:
        is_first = finding.code in _FIRST or finding.family in _FIRST
        return finding.severity != "error", not is_first, order[id(finding)]

    cause = min(causes, key=rank, default=None)

    def follows(finding: Finding) -> str:
        if sizes and finding.code in PLATES:
            return sizes[0].code
        if cause is None or finding is cause or finding.severity == "note":
            return ""
        is_widened = finding.code in _UNCERTAIN and finding.action == "resolve"
        follows_it = finding.code in (*_FOLLOWS[_ANY], *_FOLLOWS.get(cause.code, ()))
        return cause.code if is_widened or follows_it else ""

    placed = [replace(f, follows=follows(f)) for f in findings if f is not cause]
    # Sizes of the plate that follow from a note are notes.
    is_harmless = bool(sizes) and all(f.severity == "note" for f in sizes)
    placed = [replace(f, severity="note") if is_harmless and f.code in PLATES else f for f in placed]
    if cause is not None:
        worst_of = worst([cause, *(f for f in placed if f.follows == cause.code)])
        placed = [replace(cause, severity=worst_of, follows=""), *placed]
    return tuple(sorted(placed, key=lambda f: (f.severity == "note", bool(f.follows), f.severity != "error")))


def is_symptom_alone(findings: Sequence[Finding]) -> bool:
    """Check whether all reasons are symptoms of errors that hardly displace the extrinsics."""
    follow = _OF_CAPTURES | (PLATES if any(f.code in OF_SIZES for f in findings) else frozenset())
    codes = [f.code for f in findings if f.severity != "note" and f.code not in _UNCERTAIN]
    return bool(codes) and all(code in follow for code in codes)


def causes_of(findings: Sequence[Finding]) -> list[Finding]:
    """List the reasons of a verdict that do not follow from others."""
    return [each for each in findings if each.severity != "note" and not each.follows]


def lacks_captures(findings: Sequence[Finding]) -> bool:
    """Check whether too few or too similar captures are one of the causes."""
    return any((each.code, each.action) in _LACKS for each in causes_of(findings))


def advice_of(finding: Finding, plan: str, session: str) -> str:
    """Return a finding's action in a session; the plan of captures if captures are missing."""
    return plan if plan and lacks_captures([finding]) else finding.advice_at(session)


FAIL_FACTOR = 3.0
"""A standard deviation, or a difference of two results, of this many targets fails."""


def failing(is_fail: bool) -> Severity:
    """Return "error" for a finding that fails the result, else "warning"."""
    return "error" if is_fail else "warning"


def cause_words(source: str) -> str:
    """Name a cause of standard deviations, as `Contribution.source`."""
    if source in _CAUSES:
        return _CAUSES[source]
    return f"the contradiction ({source.removeprefix('contradiction_').replace('_', ' ')})"


def _correction(q: Mapping[str, Figure]) -> str:
    """Render the displacement of pixels and the turn of the camera, where significant."""
    parts = [
        fill(text, q)
        for name, text in (
            ("is_displaced", "{displacement_px:.1f} +- {displacement_sigma_px:.1f} px"),
            ("is_turned", "a turn of {turn_deg:.2f} +- {turn_sigma_deg:deg}"),
        )
        if q.get(name)
    ]
    return f" by {', '.join(parts)}" if parts else ""


def _intrinsics(finding: Finding) -> str:
    """Intrinsics do not fit: {rms_px}, {possible_px}, {displacement_px}, {turn_deg}."""
    q = finding.figures
    if finding.severity == "note":
        return f"boards correct intrinsics{_correction(q) or ' slightly'}"
    fit = "do not fit" if finding.severity == "error" else "fit roughly"
    displacement_px, correction = q["displacement_px"], _correction(q)
    if not isinstance(displacement_px, float) or not math.isfinite(displacement_px):
        reason = "they project to no pixels where boards were seen"
    elif correction:
        reason = f"off{correction}"
    else:
        reason = fill("reprojection error {rms_px:.2f} px, possible {possible_px:.2f} px", q)
    return f"intrinsics {fit}: {reason}"


def _lens_model(finding: Finding) -> str:
    """Corners fit to {rms_px} px with lens model {model}, to {other_px} with {other}; {noise_px} is noise."""
    text = fill("corners fit the lens model {model} to {rms_px:.2f} px only, ", finding.figures)
    fisheye = "the fisheye model " if finding.figures["other"] == "equidistant" else ""
    fits, possible = f"{fisheye}{{other}} to {{other_px:.2f}} px", "{noise_px:.2f} px are possible"
    return text + fill(fits if finding.figures["other"] else possible, finding.figures)


def _reach(finding: Finding) -> str:
    """The session covers {covered}, determines pixels near the border to {image_sigma_px}, {limit_px}."""
    sigma_px, known = finding.figures["image_sigma_px"], "does not determine pixels near its border"
    if isinstance(sigma_px, float) and math.isfinite(sigma_px):
        known = "determines pixels near its border to {image_sigma_px:.2f} px (limit {limit_px:.2f} px)"
        known = fill(known, finding.figures)
    return f"the session covers {100 * finding.figure('covered'):.0f} % of the image and {known}"


_NOMINAL_ERRORS = {
    "inverted": "is inverted (p_cam = R p_lidar + t is meant)",
    "reordered": "has its quaternion scalar last",
    "reordered_inverted": "is inverted and has its quaternion scalar last",
}


def _corrected(finding: Finding) -> str:
    """Enter {enter_quaternion_wxyz} and {enter_translation_m}."""
    return f"nominal_extrinsics {_NOMINAL_ERRORS[finding.action]}: enter\n" + fill(
        "quaternion_wxyz: [{enter_quaternion_wxyz:.4f}]\ntranslation_m: [{enter_translation_m:.4f}]",
        finding.figures,
    )


def _scale(finding: Finding) -> str:
    """Camera distances differ by {scale} +- {scale_sigma}: squares {square_m}, not {profile_square_m}."""
    scale, sigma = 100 * finding.figure("scale"), 100 * finding.figure("scale_sigma")
    squares = fill("squares of {square_m:1mm}, not {profile_square_m:1mm}", finding.figures)
    if finding.severity == "note":
        squares = fill("squares {square_m:1mm}", finding.figures)
        return f"boards correct the scale by {abs(scale):.1f} +- {sigma:.1f} %: {squares}, or lens or ranges"
    side = "far" if scale > 0 else "near"
    return f"{squares}, or lens or ranges off: boards {abs(scale):.1f} +- {sigma:.1f} % too {side}"


def _plate(finding: Finding) -> str:
    """Plates measure {measured_m} in {side} in {n_captures} captures, the profile says {profile_m}."""
    percent = 100 * (finding.figure("measured_m") / finding.figure("profile_m") - 1)
    sizes = fill(
        "plates measure {measured_m:.3f} m in {side} in {n_captures} captures, "
        "{profile_m:.3f} m in the profile",
        finding.figures,
    )
    return f"{sizes}: {abs(percent):.1f} % {'larger' if percent > 0 else 'smaller'}"


def _pattern_offset(finding: Finding) -> str:
    """The pattern sits {right_m}, {up_m} +- {sigma_m} from its place in {n_captures} captures."""
    sides = [
        fill(f"{{{name}:mm}} {words[finding.figure(name) < 0]}", {name: abs(finding.figure(name))})
        for name, words in (("right_m", ("right", "left")), ("up_m", ("up", "down")))
    ]
    place = "from the profile's place on the plate in {n_captures} captures (+- {sigma_m:mm})"
    return fill(f"the pattern sits {', '.join(sides)} {place}", finding.figures)


def _range_offset(finding: Finding) -> str:
    """The ranges of {subject} are {offset_m} +- {sigma_m} too long."""
    side = "long" if finding.figure("offset_m") > 0 else "short"
    sizes = {name: abs(finding.figure(name)) for name in ("offset_m", "sigma_m")}
    return fill(f"ranges of {finding.subject} are {{offset_m:mm}} +- {{sigma_m:mm}} too {side}", sizes)


def _range_scale(finding: Finding) -> str:
    """The ranges of {subject} are {scale} +- {scale_sigma} too long."""
    scale, sigma = 100 * finding.figure("scale"), 100 * finding.figure("scale_sigma")
    side = "long" if scale > 0 else "short"
    return (
        f"ranges of {finding.subject} are {abs(scale):.1f} +- {sigma:.1f} % too {side}, or all of the board"
    )


def _scattered(finding: Finding) -> str:
    """Board poses in images, or ranges of {subject}, scatter {ratio} times as much as usual."""
    what = f"ranges of {finding.subject}" if finding.subject else "board poses in images"
    return fill(f"{what} scatter {{ratio:.0f}} times as much as usual, cause unknown", finding.figures)


def _moved(finding: Finding) -> str:
    """The {place} {n_captures} captures, {captures}, fit a mounting {rotation_deg}, {translation_m} apart.

    {neighbour} lies before or after them; {chance}: to differ as much on one mounting; {sensor} moved, where
    others show that it did, even if no capture of this pair does.
    """
    place, n = finding.figures["place"], finding.figure("n_captures")
    changed = fill("a mounting changed by " + _APART, finding.figures)
    when = {"last": "after {neighbour}", "first": "before {neighbour}"}.get(str(place), "to and fro")
    which = f"the {place} " if place else ""
    captures = fill("{n_captures} captures ({captures:few}) fit", finding.figures)
    if n == 1:
        which, captures = "", fill("capture {captures:few} fits", finding.figures)
    elif n == 0:
        which, captures = "", "no capture shows"
    sensor = finding.figures.get("sensor") or "a sensor"
    return f"{which}{captures} {changed}: {sensor} moved {fill(when, finding.figures)}"


def _agree(finding: Finding) -> str:
    """The {n_sessions} calibrations of {camera} and {lidar} agree: {rotation_deg}, {translation_m} apart.

    {p} is the chance to differ more; {is_generous}: the standard deviations predict more than is seen.
    """
    apart = fill(
        "the {n_sessions} calibrations of {camera} and {lidar} agree: they differ by at most "
        "{rotation_deg:3deg} and {translation_m:1mm}",
        finding.figures,
    )
    if not finding.figures["are_independent"]:
        return f"{apart}; common errors stay hidden, as they share captures"
    if finding.figure("p") < _UNLIKELY:
        return f"{apart}, more than their standard deviations predict (chance {finding.figure('p'):.2f})"
    how = "less than" if finding.figures["is_generous"] else "as"
    return f"{apart}, {how} their standard deviations predict"


NOT_CERTIFIED = Kind(
    "verdict.not_certified", "not certified as the global minimum (gap {gap:.1e})", "collect more captures"
)
ROTATION_UNCERTAIN = Kind(
    "verdict.rotation_uncertain",
    "rotation sigma {sigma_deg:deg}, target {target_deg:deg} (x, y, z {by_axis_deg:.2g} deg)",
    "add captures; least determined: {weakest:motion}",
    actions={"measure_ranges": _RANGES, **_MEASURE},
)
TRANSLATION_UNCERTAIN = Kind(
    "verdict.translation_uncertain",
    "translation sigma {sigma_m:1mm}, target {target_m:1mm} (x, y, z {by_axis_m:1mm})",
    "add captures; least determined: {weakest:motion}",
    actions={"measure_ranges": _RANGES, **_MEASURE},
)
PLANE_RESIDUAL = Kind(
    "verdict.plane_residual",
    "LiDAR points {mean_m:mm} on average from the camera's board planes (limit {limit_m:mm})",
    _STILL,
)
EDGE_RESIDUAL = Kind(
    "verdict.edge_residual",
    "ring ends {mean_m:mm} on average from the board's edges (limit {limit_m:mm})",
    _STILL,
)
PLANES_APART = Kind(
    "verdict.planes_apart",
    "camera and LiDAR board planes differ by {rms_m:mm} rms (still boards: under 10 mm)",
    "hold the board still and check the image-scan matching",
    severity="warning",
    actions={"compensated": "move the board more slowly and evenly, about 10 cm/s"},
)
CHANNELS_DIFFER = Kind(
    "verdict.channels_differ",
    "{first} and {second} of one camera differ by " + _APART + ", beyond their uncertainty",
    "each alone: `lce-rig calibrate {session} --channels frames --name frames`",
)
CHANNELS_TURNED = Kind(
    "verdict.channels_turned",
    "{first} and {second} of one camera are rotated by 180 deg against each other",
    "turn the images of one of them in its driver, or in the recording",
)
SENSORS_DISAGREE = Kind(
    "verdict.sensors_disagree",
    "the sensors disagree in {n_refused} of {n_captures} captures ({captures:few})",
    "look for a moving board, a second board, or wrong matching",
)
FEW_USED = Kind(
    "verdict.few_used",
    "{n_used} of {n_captures} captures could be used",
    "run `lce-rig check {session}` for the causes",
    severity="warning",
)
FEW_PLACEMENTS = Kind(
    "verdict.few_placements",
    "{n_used} captures show {n_placements} different placements (minimum {n_needed})",
    "move the board between captures",
    severity="warning",
)
FAR_FROM_NOMINAL = Kind(
    "verdict.far_from_nominal",
    "{rotation_deg:1deg}, {translation_m:mm} from the nominal extrinsics "
    "(tolerance {tolerance_deg:g} deg, {tolerance_m:mm})",
    "check nominal_extrinsics and frames in the profile, and the sensors used",
    actions=dict.fromkeys(_NOMINAL_ERRORS, _corrected),
)
PLATE_SIZE = Kind(
    "verdict.plate_size", _plate, "measure the plate, then `lce-rig calibrate {session} --rig FILE`"
)
PLATE_EDGE = Kind(
    "verdict.plate_edge",
    "no edge where the profile's plate ends in {side} ({profile_m:.3f} m) in {n_lacking} of {n_captures} "
    "scans",
    "measure the plate and correct board.{side}_m",
)
INTRINSICS = Kind(
    "verdict.intrinsics",
    _intrinsics,
    "if rough or changed: " + _SAVE,
    actions={
        "collect": "cover the corners, then " + _SAVE,
        "weighed": "use the result's, or " + _SAVE,
    },
)
LENS_MODEL = Kind(
    "verdict.lens_model",
    _lens_model,
    "enter it: `lce-rig intrinsics {session} --model {other} --save-profile FILE`",
    actions={"none": "check that the images are as the camera takes them and of one lens"},
)
READOUT = Kind(
    "verdict.readout",
    "corners are sheared by {shear_px:.2f} px per 100 rows: rows exposed in turn while boards moved",
    "hold the board still at each capture (a stand), or use a global shutter",
    severity="warning",
)
TWO_BOARDS = Kind(
    "verdict.two_boards",
    "captures from {capture} on show squares {share:+1percent} larger than those before: two boards?",
    "use one board in a session, and collect again",
)
INTRINSICS_BETTER = Kind(
    "intrinsics.better",
    "the boards determine the intrinsics better than the profile ({covered:percent} of the image covered, "
    "{image_sigma_px:.2f} px near its border)",
    "write them into one: `lce-rig intrinsics {session} --save-profile FILE`",
    severity="note",
)
INTRINSICS_FIT = Kind(
    "intrinsics.fit", "the profile's intrinsics fit the boards", "keep them", severity="note"
)
INTRINSICS_UNDETERMINED = Kind("intrinsics.undetermined", _reach, _CORNERS_TOO, severity="warning")
MOVED = Kind("verdict.moved", _moved, "fasten the sensors and collect again")
LAST_REJECTED = Kind(
    "verdict.last_rejected",
    "the last capture, {capture}, is an outlier, and none after it shows whether a sensor moved",
    "collect two more captures",
    severity="note",
)
SCALE_OFF = Kind(
    "verdict.scale",
    _scale,
    "measure the squares, then `lce-rig calibrate {session} --rig FILE`",
    actions={"lens": _SAVE},
)
PATTERN_OFFSET = Kind(
    "verdict.pattern_offset",
    _pattern_offset,
    "measure the pattern's margins and enter board.pattern_offset_m",
    severity="warning",
)
LASER_ANGLES = Kind(
    "verdict.laser_angles",
    "the lasers' {angle}s differ from those of the scans by {rms_deg:deg} rms",
    "check the LiDAR's model and beam table in its driver",
)
RANGE_OFFSET = Kind(
    "verdict.range_offset",
    _range_offset,
    "enter range_offset_m: {enter_m:.3f}, then `lce-rig calibrate {session} --rig FILE`",
)
RANGE_SCALE = Kind(
    "verdict.range_scale",
    _range_scale,
    "measure squares and plate: if they are as in the profile, ranges are off",
)
RANGE_CONTRAST = Kind(
    "verdict.range_contrast",
    "ranges on dark squares are {contrast_m:+1mm} +- {sigma_m:1mm} longer than on white ones",
    "use a matt print of less contrast for the LiDAR",
)
BOW = Kind(
    "verdict.bow",
    "the plate is bent by {bow_m:1mm} along its {side}",
    "lay a straight edge across the board, and enter bow_sigma_m",
)
LENS = Kind(
    "verdict.lens",
    "boards and ranges fit other intrinsics: these would move the extrinsics by " + _APART,
    "cover the corners, then " + _SAVE,
)
OUTLIER = Kind(
    "verdict.outlier",
    "capture {capture} disagrees with the others by " + _APART,
)
DRIFTED = Kind(
    "verdict.drift",
    "the mounting drifted by " + _APART + " from the first capture to the last",
    "fasten the sensors, let them warm up, and collect again",
)
FOCUS_DRIFT = Kind(
    "verdict.focus_drift",
    "the camera's scale drifted by {share:+1percent} from the first capture to the last",
    "fix the focus, let the camera warm up, and collect again",
)
SCATTERED = Kind(
    "verdict.scatter",
    _scattered,
    "hold the board still and check the image-scan matching",
    severity="warning",
    actions={"ranges": "check the LiDAR's mode and the board's surface, and collect again"},
)
TIME_OFFSET = Kind(
    "verdict.time_offset",
    "the timestamps of {channel} are off by {offset_s:+1ms} +- {sigma_s:1ms}",
    "enter cameras.{subject}.channels.{channel}.timestamps.expected_offset_s: {enter_s:.4f}",
    severity="note",
)
EXCHANGED = Kind(
    "verdict.exchanged",
    "{subject} are exchanged: each fits the profile's {fits} of the other",
    "check topics, ports or files of both, and collect again",
)
CAMERAS_DIFFER = Kind(
    "verdict.cameras_differ",
    "{subject}: board positions differ by {rms_m:mm} rms ({images_rms_m:mm} from the images alone), "
    "relative poses from extrinsics and images by " + _APART,
    "check whether a camera has moved, and the intrinsics",
)
LIDARS_DIFFER = Kind(
    "verdict.lidars_differ",
    "{subject}: their pose to each other and that by their poses to {camera} differ by " + _APART,
    "check whether a sensor has moved, and the board's size",
)
LIDARS_UNNAMED = Kind(
    "verdict.lidars_unnamed",
    "{subject}: the profile has no nominal pose, and nothing else shows whether their names are exchanged",
    "enter their rough pose in nominal_extrinsics, and calibrate again",
    severity="warning",
)
OTHER_MODEL = Kind(
    "verdict.other_model",
    "{subject}: the scans have a ring {ring}; a {model} has {n_lasers} rings, counted from 0",
    "correct the model, or the topics and files if LiDARs are exchanged",
)
MAY_BE_OFF = Kind(
    "verdict.may_be_off",
    "with 95 % probability each, the rotation is off by less than {rotation_deg:deg} and the translation by "
    "less than {translation_m:mm}",
    severity="note",
)
SCENE = Kind(
    "verdict.scene",
    "the edges of the scene contradict the extrinsics by {rotation_deg:deg} +- {sigma_deg:deg}, "
    "{translation_m:mm} +- {sigma_m:mm}: {axes:motion}",
    f"check intrinsics and board {_LOOK}",
    actions={
        "deployed": f"a sensor may have moved {_LOOK}",
        "distances": f"check the squares {_LOOK}",
        "times": f"hold boards still {_LOOK}",
    },
)
ELSEWHERE = Kind(
    "verify.elsewhere",
    "in {n_elsewhere} of {n_captures} captures the scan has no surface where the extrinsics place the board",
)
UNSEEN = Kind("verify.unseen", "both sensors detect the board in no capture")
REPEAT_AGREE = Kind("repeat.agree", _agree, severity="note")
REPEAT_DISAGREE = Kind(
    "repeat.disagree",
    "the {n_sessions} calibrations of {camera} and {lidar} disagree: they differ by up to "
    "{rotation_deg:3deg} and {translation_m:1mm}, {ratio:.1f} times as "
    "much as predicted, most in {axes:motion}",
    "do not use any of them until the cause is known",
    actions={
        "odd_one": "find the fault in {odd_one}, without it the others agree",
        "overlays": "compare overlays of {first} and {second}: `lce-rig verify {session} --name NAME`",
    },
)
