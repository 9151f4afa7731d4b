"""Reasons for refusing images, events and scans; codes begin with the stage that refuses."""

from dataclasses import replace

from lce_rig.core.findings import Finding, Kind, Stage

MOVE_SLOWLY = "move the board sideways, 10 cm/s, from 1 s before"
_CLOSER = "come closer, and move the board sideways at about 10 cm/s"
_SLOWER = "move it slower, about 10 cm/s"
_CORNERS = "{n_cols}x{n_rows} inner corners"
_WHOLE = "show the whole pattern; correct board.inner_corners (squares less one)"
_UNCOVER = "uncover the pattern, come closer, or correct board.inner_corners"
_LENS = "flatten the board, or `lce-rig intrinsics {session} --save-profile FILE`"
_PLATE = "{board_width_m:.2f} x {board_height_m:.2f} m"


def _other_grid(finding: Finding) -> str:
    """{n_cols}x{n_rows} inner corners expected, {n_cols_seen}x{n_rows_seen} or a part detected."""
    at = finding.figures
    seen = f"{at['n_cols_seen']}x{at['n_rows_seen']}" if "n_cols_seen" in at else "a part of a pattern"
    return f"{at['n_cols']}x{at['n_rows']} inner corners expected, {seen} detected"


def _not_there(finding: Finding) -> str:
    """Not at the place expected from the image and other captures: the text of {cause}, with its figures."""
    return f"not at the place expected from the image and other captures: {_cause(finding).text}"


def _find_again(finding: Finding) -> str:
    """The action of that code."""
    return _cause(finding).advice


def _cause(finding: Finding) -> Finding:
    return replace(finding, code=str(finding.figures["cause"]))


READ_NETWORK_SETTLING = Kind(
    "read.network_settling",
    "{n_steps} windows of events ({seen_s:.2f} s) precede the image, the network needs {n_warm_up}",
    "keep the board or the camera moving for a second before the first capture",
)
READ_OUTSIDE_EVENTS = Kind(
    "read.outside_events",
    "the image is {gap_s:.3f} s before the first event or after the last one",
    "check both sensors' clocks; record events before and after all images",
)
READ_NO_EVENTS = Kind(
    "read.no_events",
    "there are no events",
    "uncover the lens, switch the event stream on, check the events' topic",
)
IMAGE_NOT_AT_FIRST_SIGHT = Kind(
    "image.not_at_first_sight", "no board found by the quick search", "search the image thoroughly"
)
IMAGE_TOO_DARK = Kind(
    "image.too_dark", "too dark: 99 % of the image below grey {grey_99:.0f}", "expose longer or add light"
)
IMAGE_OVEREXPOSED = Kind(
    "image.overexposed",
    "overexposed: {white_share:percent} of the image is white",
    "shorten the exposure, or turn the board away from the light",
)
IMAGE_NO_BOARD = Kind(
    "image.no_board",
    "no board: " + _CORNERS + " expected, none detected (median grey {grey_50:.0f})",
    _WHOLE,
    actions={"events": "move the whole board sideways, or correct board.inner_corners"},
)
IMAGE_UNCLEAR = Kind(
    "image.unclear",
    "the corners are too unclear to measure (" + _CORNERS + " expected)",
    "hold the board still, closer and better lit",
    actions={"events": _CLOSER},
)
IMAGE_CUT_OFF = Kind(
    "image.cut_off",
    "board cut off by the {side} border: not all of the " + _CORNERS + " detected",
    "move the board away from the {side} border",
)
IMAGE_PART = Kind(
    "image.part",
    _other_grid,
    _UNCOVER,
    actions={"events": "move the whole pattern sideways in view, or correct board.inner_corners"},
)
IMAGE_OTHER_BOARD = Kind(
    "image.other_board",
    _other_grid,
    "correct board.inner_corners in the profile: squares less one, each way",
)
IMAGE_OTHER_DICTIONARY = Kind(
    "image.other_dictionary",
    "no markers of {dictionary}, {n_seen} of {seen_dictionary}",
    "correct board.dictionary in the profile",
)
IMAGE_OTHER_IDS = Kind(
    "image.other_ids",
    "markers with ids from {first_seen} to {last_seen} beside those of the board, {first_id} to {last_id}",
    "correct board.squares, tags and first_id; hide other boards",
)
IMAGE_OTHER_LAYOUT = Kind(
    "image.other_layout",
    "{n_fitting} of {n_markers} markers lie where the profile's board has them",
    "correct board.squares and marker_m, or board.tags and tag_spacing",
)
IMAGE_OTHER_SPACING = Kind(
    "image.other_spacing",
    "gaps between tags measure {share:g} of the side of a tag, {stated:g} in the profile",
    "measure the pattern and correct board.tag_spacing",
)
IMAGE_FEW_CORNERS = Kind(
    "image.few_corners",
    "{n_corners} corners are clear enough to measure (minimum {n_needed})",
    "uncover more of the pattern, come closer",
)
IMAGE_LOW_CONTRAST = Kind(
    "image.low_contrast",
    "contrast too low: black and white differ by {contrast:.0f} grey values (minimum {min_contrast:.0f})",
    "expose longer or add light",
    actions={"events": MOVE_SLOWLY},
)
IMAGE_BLURRED = Kind(
    "image.blurred",
    "too blurred: edges {edge_px:.1f} px wide (limit {max_edge_px:.1f} px)",
    "hold the board still, shorten the exposure, come closer, or focus",
    actions={"events": MOVE_SLOWLY + "; come closer"},
)
IMAGE_NO_POSE = Kind(
    "image.no_pose", "the corners detected fit no pose of the board in front of the camera", _LENS
)
IMAGE_MISFIT = Kind(
    "image.misfit",
    "corners detected, but the profile's intrinsics do not fit them: reprojection error {rms_px:.2f} px rms "
    "(limit {max_rms_px:.2f} px)",
    _LENS,
)
LENS_MISFITS = frozenset({IMAGE_NO_POSE.code, IMAGE_MISFIT.code})
"""Codes of images whose corners are detected, and refused by the intrinsics."""
BOARD_THERE = LENS_MISFITS | {
    *(IMAGE_CUT_OFF.code, IMAGE_OTHER_BOARD.code, IMAGE_OTHER_DICTIONARY.code),
    *(IMAGE_OTHER_IDS.code, IMAGE_OTHER_LAYOUT.code, IMAGE_OTHER_SPACING.code),
}
"""Codes of images that show a board, which is refused."""
IMAGE_SMALL_SQUARES = Kind(
    "image.small_squares",
    "squares of {square_px:.1f} px (minimum {min_square_px:g} px)",
    "come {closer_m:.1f} m closer",
)
IMAGE_NEAR_BORDER = Kind(
    "image.near_border",
    "a corner lies {border_px:.1f} px from the border (minimum {min_border_px:g} px)",
    "move the board towards the middle of the image",
)
IMAGE_TILTED = Kind(
    "image.tilted",
    "tilt {tilt_deg:.0f} deg (limit {max_tilt_deg:g} deg)",
    "turn the board {turn_deg:.0f} deg towards the camera",
)
IMAGE_FLICKER = Kind(
    "image.flicker",
    "most events come from light that flickers",
    "record in daylight or under lamps that do not flicker",
)
IMAGE_HOT_PIXELS = Kind(
    "image.hot_pixels",
    "{n_hot} hot pixels make {share:percent} of the events; the board makes too few",
    "move the board, let the camera cool down, or mask them in its driver",
)
IMAGE_HARDLY_MOVED = Kind(
    "image.hardly_moved",
    "the board hardly moved: {events_px:.1f} events/px in 1 s (minimum {min_events_px:g})",
    MOVE_SLOWLY + "; check lens and biases",
)
IMAGE_FEW_EVENTS = Kind(
    "image.few_events",
    "the board moved at {speed_mps:.2f} m/s and made {events_px:.1f} events/px in 1 s "
    "(minimum {min_events_px:g})",
    "lower the contrast thresholds (biases) of the event camera, add light",
)
IMAGE_TOO_FAST = Kind(
    "image.too_fast",
    "the board moved at {speed_mps:.2f} m/s during the scan (limit {max_speed_mps:g} m/s)",
    _SLOWER,
)
IMAGE_TURNING = Kind(
    "image.turning",
    "the board turned at {turn_deg_s:.0f} deg/s during the scan (limit {max_turn_deg_s:g} deg/s)",
    "turn it less, move it sideways only",
)
LIDAR_NO_RETURNS = Kind(
    "lidar.no_returns",
    "{n_points} points, none of them finite and farther than {min_range_m:g} m",
    "check the LiDAR's cable, topic and driver settings",
)
LIDAR_OTHER_ORIGIN = Kind(
    "lidar.other_origin",
    "the rings meet at ({x_m:.2f}, {y_m:.2f}, {z_m:.2f}) m, not at the origin of the points' frame "
    "(limit {limit_m:g} m)",
    "record the points in the LiDAR's own frame, not in the robot's",
)
LIDAR_TOO_FEW_RINGS = Kind(
    "lidar.too_few_rings",
    "{n_rings} rings on the board at {distance_m:.1f} m (minimum {min_rings})",
    "come {closer_m:.1f} m closer",
)
LIDAR_TOO_THICK = Kind(
    "lidar.too_thick",
    "plane {plane_rms_m:1mm} rms (limit {max_plane_rms_m:1mm}): "
    "the board moved during the scan or is not flat",
    "hold the board still, or put it on a stand",
)
LIDAR_MOVED = Kind(
    "lidar.moved",
    "board or LiDAR moved by {moved_m:mm} while scans of the board at {distance_m:.1f} m were accumulated",
    "keep board and LiDAR still",
)
LIDAR_TOUCHING = Kind(
    "lidar.touching",
    "the board at {distance_m:.1f} m touches another surface: "
    "{beyond_share:percent} more returns in its plane",
    "keep walls, tables and hands 0.2 m away from the board",
)
LIDAR_OUTLINE = Kind(
    "lidar.outline",
    "plate outline at {distance_m:.1f} m: error {error_m:mm} (limit {max_error_m:mm}), "
    "{hidden_share:percent} of the board occluded",
    "show the whole board, with nothing in front of it or at its edges",
)
LIDAR_NO_BORDER = Kind(
    "lidar.no_border",
    "the border at {distance_m:.1f} m is located at {n_upright} upright and {n_level} level places only",
    "keep 10 cm around the board free, with a wall behind; scan longer",
)
LIDAR_OUT_OF_VIEW = Kind(
    "lidar.out_of_view",
    "{share:percent} of the board at {distance_m:.1f} m returned nothing: it reaches out of the LiDAR's view",
    "move it to the middle of the LiDAR's view, or accumulate for longer",
)
LIDAR_TURNED = Kind(
    "lidar.turned",
    "plate at {distance_m:.1f} m: beams hit it at more than {max_turn_deg:.0f} deg from its normal",
    "turn the board towards the LiDAR",
)
LIDAR_OTHER_PLATE = Kind(
    "lidar.other_plate",
    "the plate nearest to the board's size is {width_m:.2f} x {height_m:.2f} m, at {distance_m:.1f} m; "
    "the board is " + _PLATE,
    "check the board's width_m and height_m, or show the whole board",
)
LIDAR_NO_PLATE = Kind(
    "lidar.no_plate",
    "no plate of the board's size (" + _PLATE + ") between {min_range_m:g} and {max_range_m:g} m",
    "hold the board there, in sight of the LiDAR, with nothing at its edges",
)
LIDAR_TOO_FEW_POINTS = Kind(
    "lidar.too_few_points",
    "{n_points} points on the board (minimum {min_points})",
    "come {closer_m:.1f} m closer",
)
LIDAR_OTHER_SIZE = Kind(
    "lidar.other_size",
    "plate {side} {measured_m:.3f} m, in the profile {profile_m:.3f} m",
    "measure the plate and correct board.{side}_m, or remove what touches it",
)
LIDAR_RAGGED_EDGES = Kind(
    "lidar.ragged_edges",
    "ring ends {rms_m:mm} rms from a rectangle (limit {max_rms_m:mm})",
    "keep hands and other things away from the board's border",
)
LIDAR_NOT_WHERE_EXPECTED = Kind("lidar.not_where_expected", _not_there, _find_again)
LIDAR_NOTHING_WHERE_EXPECTED = Kind(
    "lidar.nothing_where_expected",
    "no plate of the board's size at the {distance_m:.1f} m expected from the image and other captures",
    "move the board clear of other things",
)


def _distance_kinds(stage: Stage, sensor: str) -> tuple[Kind, Kind]:
    distance = "the board is {distance_m:.2f} m from the " + sensor
    near = Kind(f"{stage}.too_near", distance + " (minimum {min_distance_m:g} m)", "go {move_m:.1f} m back")
    far = Kind(f"{stage}.too_far", distance + " (limit {max_distance_m:g} m)", "come {move_m:.1f} m closer")
    return near, far


TOO_NEAR_OR_FAR: dict[Stage, tuple[Kind, Kind]] = {
    "image": _distance_kinds("image", "camera"),
    "lidar": _distance_kinds("lidar", "LiDAR"),
}
