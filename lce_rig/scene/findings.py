"""Kinds of findings on deployed extrinsics, from a scene's edges and boards in view."""

from lce_rig.core.findings import Kind

_BOARD = "collect a session with the board and calibrate it"
_FASTEN = f"fasten the sensors, {_BOARD}"
_SEEN = "changes from {smallest_deg:deg}, {smallest_m:mm} would be seen"
_RECORD = "record furniture, doors or people that stand before something farther off"

STATES = {"unchanged": "holds", "changed": "changed", "unknown": "cannot tell"}
"""Words for a verdict."""

UNCHANGED = Kind("scene.unchanged", f"scene: the edges fit, {_SEEN}", severity="note")
CHANGED = Kind(
    "scene.changed",
    "scene: changed by {rotation_deg:deg} +- {sigma_deg:deg}, {translation_m:mm} +- {sigma_m:mm}: "
    "{axes:motion}",
    _FASTEN,
)
ELSEWHERE = Kind(
    "scene.elsewhere",
    "scene: changed, the edges fit best {rotation_deg:deg}, {translation_m:mm} away, elsewhere about as well",
    _FASTEN,
)
DOUBTFUL = Kind(
    "scene.doubtful",
    "scene: the edges fit other extrinsics slightly better, which chance may explain",
    "record more places",
    severity="warning",
)
UNKNOWN = Kind(
    "scene.unknown",
    "scene: the edges do not determine changes below {smallest_deg:deg}, {smallest_m:mm}",
    _RECORD,
    severity="warning",
)
FEW_EDGES = Kind(
    "scene.few_edges",
    "scene: {n_edges} edges in {n_captures} captures are too few",
    _RECORD,
)
WEAK = Kind(
    "scene.weak",
    "scene: no extrinsics near these fit the edges clearly",
    "check that the result is of this rig, and images sharp and lit",
    severity="warning",
)
AMBIGUOUS = Kind(
    "scene.ambiguous",
    "scene: several extrinsics fit the edges about equally well",
    "record more places",
    severity="warning",
)
BEYOND_REACH = Kind(
    "scene.beyond_reach",
    "scene: the best fit is at the border of the region searched",
    _BOARD,
    severity="warning",
)
BOARD_CHANGED_JOINTLY = Kind(
    "scene.board_changed_jointly",
    "boards: all axes together changed by {rotation_deg:deg}, {translation_m:mm}, {sigmas:.1f} standard "
    "deviations: {axes:motion}",
    _FASTEN,
)
BOARD_HIDES = Kind(
    "scene.board_hides",
    "boards: {rotation:motion} by {rotation_deg:deg} with {translation:motion} by {translation_m:mm}, "
    "or less, would not be seen",
    "hold the board at more places",
    severity="note",
)
CONTRADICTION = Kind(
    "scene.contradiction",
    "scene and boards contradict each other: they differ by {rotation_deg:deg}, {translation_m:mm}",
    "check clocks and intrinsics, and collect a session with the board",
    severity="warning",
)
NO_SAMPLES = Kind(
    "scene.no_samples",
    "no image or events of {subject} within the tolerance of a scan of {lidar}",
    "check the topics and timestamps of the recording, or record this camera",
)
NO_FIRING_TIMES = Kind(
    "scene.no_firing_times",
    "{n_captures} captures of a moving rig are not used: scans of {subject} or images have no times",
    "record points with their firing times, or let the rig stand",
    severity="warning",
)
CLOCKS_APART = Kind(
    "scene.clocks_apart",
    "while the rig moves, images of {subject} fit best {apart_s:+.2f} s from their timestamps",
    "let the rig stand, or correct the clocks (`lce-rig doctor --rig RIG`)",
    severity="warning",
)
CLOCKS_INSTEAD = Kind(
    "scene.clocks_instead",
    "or the clocks are apart: while the rig moves, images of {subject} {apart_s:+.2f} s from their "
    "timestamps explain it nearly as well",
    "let the rig stand, which tells one from the other",
    severity="warning",
)
EVENTS_OF_STANDING_RIG = Kind(
    "scene.events_of_standing_rig",
    "{subject} is judged by events, which show only moving things, and the rig was not seen to move",
    "move the rig slowly past upright edges, or record images as well",
    severity="warning",
)
