"""Phrases for refused captures, images and scans; codes begin with the stage that refuses."""

from dataclasses import replace

from lce_rig.core.findings import Finding
from lce_rig.words.rendering import Phrase, Template, describe, recommend

MOVE_SLOWLY = "move the board sideways slowly, about 10 cm/s, from 1 s before the capture"
_SLOWER = "move it slower, about 10 cm/s"
_CORNERS = "{n_cols}x{n_rows} inner corners"
_OTHER = _CORNERS + " expected, {n_cols_seen}x{n_rows_seen} detected"
_WHOLE = "show the whole pattern, uncovered; inner corners are where four squares meet, one less than squares"
_UNCOVER = "uncover the whole pattern; if it has these corners, correct board.inner_corners in the profile"
_FOCUS = "hold the board still, expose shorter, come closer, focus the lens"
_LENS = "check the camera's intrinsics ({model} at {width_px}x{height_px} px) and that the board is flat"
_CLOCKS = "check that both sensors' clocks agree"
_NO_FLICKER = "record in daylight or under lamps that do not flicker"
_PLATE = "{board_width_m:.2f} x {board_height_m:.2f} m"
_HOLD_STILL = "hold the board still while capturing, with nothing in front of it or close behind its rim"
_REMOVE_OTHERS = "remove other things of the board's size, or cover them"


def _flicker(finding: Finding) -> str:
    """Most events come from light that flickers, at {frequency_hz} Hz."""
    frequency_hz = finding.figures["frequency_hz"]
    rhythm = f" at {frequency_hz:.0f} Hz" if frequency_hz else ""
    return f"most events come from light that flickers{rhythm}"


def _no_image(finding: Finding) -> str:
    """No image at the time of the scan; the nearest was {nearest_s} away."""
    nearest_s = finding.figures.get("nearest_s")
    nearest = f" (nearest: {nearest_s:.3f} s away)" if isinstance(nearest_s, float) else ""
    return f"no image at the time of the scan{nearest}"


def _lost(finding: Finding) -> str:
    """Lost near its last place, for the code in {cause}, with its figures."""
    return f"lost near its last place: {describe(_cause(finding))}"


def _not_there(finding: Finding) -> str:
    """Not where images and other captures have it, for the code in {cause}, with its figures."""
    return f"not where the image and the other captures have it: {describe(_cause(finding))}"


def _find_again(finding: Finding) -> str:
    """The action of that code."""
    return recommend(_cause(finding))


def _cause(finding: Finding) -> Finding:
    return replace(finding, code=str(finding.figures["cause"]))


def _candidates(finding: Finding) -> str:
    """Best of {n_candidates} candidates: {distance_m}, {rotation_deg} from where the image has the board."""
    n, distance_m = finding.figures["n_candidates"], finding.figure("distance_m")
    which = "the only candidate" if n == 1 else f"the best of {n} candidates"
    apart = f"{distance_m:.1f} m" if distance_m >= 1 else f"{100 * distance_m:.0f} cm"
    return (
        f"{which} in the scan is {apart}, {finding.figure('rotation_deg'):.0f} deg from where the image has "
        "the board"
    )


def _hint_or(otherwise: str) -> Template:
    def hint(finding: Finding) -> str:
        return str(finding.figures["hint"] or otherwise)

    hint.__doc__ = f"{{hint}}, else: {otherwise}."
    return hint


_RECOLLECT = _hint_or("collect this placement again")

PHRASES: dict[str, Phrase] = {
    "read.text": Phrase("{text}", "{advice}"),
    "read.network_settling": Phrase(
        "{n_steps} windows of events ({seen_s:.2f} s) precede the image, the network needs {n_warm_up}",
        "keep the board or the camera moving for a second before the first capture",
    ),
    "read.before_events": Phrase(
        "the image is {gap_s:.3f} s before the first event", _CLOCKS + ", or start the event camera first"
    ),
    "read.after_events": Phrase(
        "the image is {gap_s:.3f} s after the last event", _CLOCKS + ", or record events to the end"
    ),
    "read.no_events": Phrase("the recording holds no events", "check the events' topic and the camera"),
    "read.events_not_begun": Phrase(
        "no events yet at the time of the scan",
        "start the event camera first, or check that both sensors' clocks agree",
    ),
    "read.events_gone_by": Phrase(
        "the scan arrived after the events that follow it",
        "split the recording where the LiDAR's clock was set back",
    ),
    "read.no_events_at_scan": Phrase(
        "no events at the time of the scan",
        "record events while the LiDAR runs and check that the clocks agree",
    ),
    "read.no_image_at_scan": Phrase(_no_image),
    "image.none": Phrase("no board in any image"),
    "lidar.none": Phrase("no board in the scan"),
    "calibrate.same_placement": Phrase("same placement as in an earlier capture"),
    "image.text": Phrase("{text}", "{advice}"),
    "image.not_at_first_sight": Phrase("no board found by the quick search", "search the image thoroughly"),
    "image.too_dark": Phrase(
        "too dark: 99 % of the image below grey {grey_99:.0f}", "expose longer or add light"
    ),
    "image.overexposed": Phrase(
        "overexposed: {white_share:percent} of the image is white",
        "expose shorter or turn the board away from the light",
    ),
    "image.flat": Phrase(
        "contrast too low: grey values {grey_1:.0f} to {grey_99:.0f}, no " + _CORNERS + " detected",
        "light the board, expose longer",
        {"events": "move the board while events are recorded, only moving edges make them"},
    ),
    "image.blurred": Phrase(
        "too blurred: the sharpest edges are {edge_px:.0f} px wide, no " + _CORNERS + " detected",
        "hold the board still, expose shorter, focus the lens",
        {"events": MOVE_SLOWLY},
    ),
    "image.no_board": Phrase(
        "no board: " + _CORNERS + " expected, none detected (median grey {grey_50:.0f})",
        _WHOLE,
        {"events": f"{_WHOLE}; {MOVE_SLOWLY}"},
    ),
    "image.unclear": Phrase(
        "the " + _CORNERS + " are too unclear to measure",
        "hold the board still, closer and better lit",
        {"events": f"{MOVE_SLOWLY}; come closer"},
    ),
    "image.cut_off": Phrase(
        "board cut off by the {side} border: " + _OTHER, "move the board away from the {side} border"
    ),
    "image.part": Phrase(_OTHER, _UNCOVER, {"events": f"{MOVE_SLOWLY}; {_UNCOVER}"}),
    "image.part_of_small": Phrase(
        "squares of {square_px:.1f} px are too small (minimum {min_square_px:g} px): "
        "{n_cols_seen}x{n_rows_seen} of " + _CORNERS + " detected",
        "come closer, by {closer_share:percent} of the distance or more",
    ),
    "image.other_board": Phrase(
        _OTHER, "correct board.inner_corners in the profile: one less than squares along each side"
    ),
    "image.low_contrast": Phrase(
        "contrast too low: black and white differ by {contrast:.0f} grey values (minimum {min_contrast:.0f})",
        "expose longer or add light",
        {"events": MOVE_SLOWLY},
    ),
    "image.not_sharp": Phrase(
        "too blurred: edges {edge_px:.1f} px wide on squares of {square_px:.1f} px "
        "(minimum {min_sharpness:g} edge widths per square)",
        _FOCUS,
        {"events": f"{MOVE_SLOWLY}; come closer"},
    ),
    "image.no_pose": Phrase("the corners fit no pose of the board in front of the camera", _LENS),
    "image.misfit": Phrase(
        "reprojection error of the corners {rms_px:.2f} px rms (limit {max_rms_px:.2f} px)", _LENS
    ),
    "image.small_squares": Phrase(
        "squares of {square_px:.1f} px (minimum {min_square_px:g} px)", "come {closer_m:.1f} m closer"
    ),
    "image.near_border": Phrase(
        "a corner lies {border_px:.1f} px from the border (minimum {min_border_px:g} px)",
        "move the board towards the middle of the image",
    ),
    "image.tilted": Phrase(
        "tilt {tilt_deg:.0f} deg (limit {max_tilt_deg:g} deg)",
        "turn the board {turn_deg:.0f} deg towards the camera",
    ),
    "image.no_events": Phrase("the capture holds no events", "uncover the lens, switch the event stream on"),
    "image.few_events": Phrase(
        "too few events: {n_events} in the second before the image",
        f"{MOVE_SLOWLY}; if it moved, uncover the lens",
    ),
    "image.flicker": Phrase(_flicker, _NO_FLICKER),
    "image.hot_pixels": Phrase(
        "{n_hot} hot pixels make {share:percent} of the events; the board makes too few",
        f"{MOVE_SLOWLY}; let the camera cool down, or mask them in its driver",
    ),
    "image.hardly_moved": Phrase(
        "the board hardly moved: {events_px:.1f} events/px in 1 s (minimum {min_events_px:g})", MOVE_SLOWLY
    ),
    "image.still_scene": Phrase(
        "the board hardly moved: {events_px:.1f} events/px in 1 s where most are (minimum {min_events_px:g})",
        MOVE_SLOWLY,
    ),
    "image.too_fast": Phrase(
        "the board moved at {speed_mps:.2f} m/s during the scan (limit {max_speed_mps:g} m/s)", _SLOWER
    ),
    "image.turning": Phrase(
        "the board turned at {turn_deg_s:.0f} deg/s during the scan (limit {max_turn_deg_s:g} deg/s)",
        "turn it less, move it sideways only",
    ),
    "image.smeared": Phrase("the board moved {smear_m:mm} during the scan (limit {max_smear_m:mm})", _SLOWER),
    "image.stood_still": Phrase(
        "the board stood still: {events_px:.1f} events/px in 1 s", "move it sideways slowly, about 10 cm/s"
    ),
    "image.made_few_events": Phrase(
        "the board made few events at {speed_mps:.2f} m/s: {events_px:.1f} events/px in 1 s "
        "(minimum {min_events_px:g})",
        "move it sideways slowly, about 10 cm/s, in one direction, and in better light",
    ),
    "lidar.text": Phrase("{text}", "{advice}"),
    "lidar.no_returns": Phrase(
        "{n_points} points, none of them finite and farther than {min_range_m:g} m",
        "check the LiDAR's cable, topic and driver settings",
    ),
    "lidar.too_few_rings": Phrase(
        "{n_rings} rings on the board at {distance_m:.1f} m (minimum {min_rings})",
        "come {closer_m:.1f} m closer",
    ),
    "lidar.too_thick": Phrase(
        "plane {plane_rms_m:1mm} rms (limit {max_plane_rms_m:1mm}): "
        "the board moved during the scan or is not flat",
        "hold the board still, or put it on a stand",
    ),
    "lidar.touching": Phrase(
        "the board at {distance_m:.1f} m touches another surface: "
        "{beyond_share:percent} more returns in its plane",
        "keep walls, tables and hands 0.2 m away from the board's edges and plane",
    ),
    "lidar.outline": Phrase(
        "plate outline at {distance_m:.1f} m: error {error_m:mm} (limit {max_error_m:mm}), "
        "{hidden_share:percent} of the board occluded",
        "show the whole board, with nothing in front of it or at its edges",
    ),
    "lidar.other_plate": Phrase(
        "the plate nearest to the board's size is {width_m:.2f} x {height_m:.2f} m, at {distance_m:.1f} m; "
        "the board is " + _PLATE,
        "check width_m and height_m of the board in the rig profile, or show the whole board",
    ),
    "lidar.no_plate": Phrase(
        "no plate of the board's size (" + _PLATE + ") between {min_range_m:g} and {max_range_m:g} m",
        "hold the board at that distance, in sight of the LiDAR, with nothing at its edges",
    ),
    "lidar.too_few_points": Phrase(
        "{n_points} points on the board (minimum {min_points})", "come {closer_m:.1f} m closer"
    ),
    "lidar.other_size": Phrase(
        "plate {side} {measured_m:.3f} m, in the profile {profile_m:.3f} m",
        "measure the plate and correct board.{side}_m, or remove what touches it",
    ),
    "lidar.ragged_edges": Phrase(
        "ring ends {rms_m:mm} rms from a rectangle (limit {max_rms_m:mm})",
        "keep hands and other things away from the board's border",
    ),
    "lidar.elsewhere": Phrase(
        "best of {n_candidates} candidates in the scan: {distance_m:.2f} m, {rotation_deg:.0f} deg from the "
        "pose predicted by the image and the nominal extrinsics",
        "hold the board clear of other things, where more of the LiDAR's rings meet it",
    ),
    "lidar.lost": Phrase(_lost, _find_again),
    "lidar.not_where_expected": Phrase(_not_there, _find_again),
    "lidar.nothing_where_expected": Phrase(
        "no plate of the board's size at the {distance_m:.1f} m where image and other captures have it",
        "move the board clear of other things",
    ),
    "lidar.turned_away": Phrase(
        "the only plate near the board's last place is rotated by over {max_turn_deg:.0f} deg",
        "move more slowly",
    ),
    "pair.text": Phrase("{text}", "{advice}"),
    "pair.no_candidate": Phrase(
        "no surface in the scan fits the board", "move the board clear of other things"
    ),
    "pair.no_agreement": Phrase(
        "no three of {n_captures} captures agree with one set of extrinsics",
        "check the board's size, the intrinsics and the pairing of images with scans",
    ),
    "pair.elsewhere": Phrase(
        _candidates,
        "come closer or tilt the board more, so that both sensors see its tilt well",
        {"hold_still": "hold the board still, and 20 cm or more clear of walls, pillars and other things"},
    ),
    "pair.two_places": Phrase(
        "{first} and {second} give different board positions in the scan", _REMOVE_OTHERS
    ),
    "calibrate.text": Phrase("{text}", "{advice}"),
    "calibrate.outlier": Phrase(
        "outlier: plane {plane_m:mm}, edges {edges_m:mm} rms from the other captures' prediction "
        "(median {plane_median_m:mm}, {edges_median_m:mm})",
        _HOLD_STILL,
    ),
    "calibrate.other_lens": Phrase(
        "corners {rms_px:.2f} px rms from the intrinsics of the other boards (median {median_px:.2f} px)",
        "check with `lce-rig check --debug-images` whether the board is bent, cut off or moving",
    ),
    "calibrate.known_placement": Phrase(
        "the board is at the placement of capture {capture}",
        "{instruction}",
        {"nowhere": "stop the collection: no new placement is left"},
    ),
    "calibrate.little_gain": Phrase(
        "this placement improves the result by {gain:1percent}, another by {best_gain:percent}",
        "{instruction}",
    ),
}
for _stage, _unit in (("image", "camera"), ("lidar", "LiDAR")):
    _at = "the board is {distance_m:.2f} m from the " + _unit
    PHRASES[f"{_stage}.too_near"] = Phrase(_at + " (minimum {min_distance_m:g} m)", "go {move_m:.1f} m back")
    PHRASES[f"{_stage}.too_far"] = Phrase(_at + " (limit {max_distance_m:g} m)", "come {move_m:.1f} m closer")
