"""Kinds of findings of a scene's edges, and of boards in view, on deployed extrinsics."""

from lce_rig.core.findings import Finding, Kind
from lce_rig.core.phrasing import fill

_BOARD = "collect a session with the board and calibrate it"
_FASTEN = f"fasten the sensors, {_BOARD}"
_RECORD = "record furniture, doors or people that stand before something farther off"

STATES = {"unchanged": "no change seen", "changed": "changed", "unknown": "cannot tell"}
"""Words for the state of an axis."""


def _size(finding: Finding, name: str, sign: str = "") -> str:
    """Print a figure that is an angle in deg or a length in m."""
    if f"{name}_deg" in finding.figures:
        return f"{finding.figure(f'{name}_deg'):{sign}.2f} deg"
    return f"{1000 * finding.figure(f'{name}_m'):{sign}.0f} mm"


def _board_changed(finding: Finding) -> str:
    """Changed by {change_m} or {change_deg} +- {sigma_m} or {sigma_deg}; {smallest_m}."""
    axis = fill("{subject:motion}", {"subject": finding.subject})
    return f"board, {axis}: changed by {_size(finding, 'change', '+')} +- {_size(finding, 'sigma')}"


def _board_unsure(finding: Finding) -> str:
    """Changes below {smallest_m} or {smallest_deg} would not be seen; {change_m}, {sigma_m}."""
    axis = fill("{subject:motion}", {"subject": finding.subject})
    return f"board, {axis}: changes below {_size(finding, 'smallest')} would not be seen"


def _contradiction(finding: Finding) -> str:
    """Scene {change_deg} or {change_m} +- {sigma_deg}, {sigma_m}, boards {board_deg}, {board_sigma_deg}.

    Or {board_m}, {board_sigma_m}.
    """
    axis = fill("{subject:motion}", {"subject": finding.subject})
    scene = f"{_size(finding, 'change', '+')} +- {_size(finding, 'sigma')}"
    board = f"{_size(finding, 'board', '+')} +- {_size(finding, 'board_sigma')}"
    return f"scene and boards contradict each other, {axis}: scene {scene}, boards {board}"


def _axis_unchanged(finding: Finding) -> str:
    """No change of {smallest_m} or {smallest_deg}; {change_m}, {change_deg}, {sigma_m}, {sigma_deg}."""
    axis = fill("{subject:motion}", {"subject": finding.subject})
    return f"scene, {axis}: no change of {_size(finding, 'smallest')} or more"


def _axis_changed(finding: Finding) -> str:
    """Changed by {change_m} or {change_deg} +- {sigma_m} or {sigma_deg}; {smallest_m}, {instead}."""
    change = f"{_size(finding, 'change', '+')} +- {_size(finding, 'sigma')}"
    instead = fill(", or instead: {instead:motion}", finding.figures) if finding.figures["instead"] else ""
    return fill("scene, {subject:motion}", {"subject": finding.subject}) + f": changed by {change}{instead}"


def _large_scatter(finding: Finding) -> str:
    """Parts of the scene disagree; {smallest_m} or {smallest_deg} would be seen."""
    axis, smallest = fill("scene, {subject:motion}", {"subject": finding.subject}), _size(finding, "smallest")
    if "inf" in smallest:
        return f"{axis}: parts of the scene do not agree on any change"
    return f"{axis}: changes below {smallest} would not be seen"


UNCHANGED = Kind(
    "scene.unchanged", "the extrinsics fit the edges of the scene in {n_captures} captures", severity="note"
)
CHANGED = Kind("scene.changed", "the extrinsics do not fit the edges of the scene: {changed:motion}", _FASTEN)
UNKNOWN = Kind(
    "scene.unknown",
    "the edges of the scene cannot tell: {unknown:motion}",
    _RECORD,
    severity="warning",
)
FEW_EDGES = Kind(
    "scene.few_edges",
    "{n_edges} edges of the scene in {n_captures} captures are too few or too close together",
    _RECORD,
)
UNCHANGED_WITH_BOARD = Kind(
    "scene.unchanged_with_board",
    "the extrinsics fit: the scene of {n_captures} captures, or the board in {n_boards}, covers each axis",
    severity="note",
)
CHANGED_WITH_BOARD = Kind(
    "scene.changed_with_board", "the extrinsics do not fit the scene or the board: {changed:motion}", _FASTEN
)
UNKNOWN_WITH_BOARD = Kind(
    "scene.unknown_with_board",
    "neither the scene nor the board can tell: {unknown:motion}",
    _RECORD,
    severity="warning",
)
BOARD_CHANGED = Kind("scene.board_changed", _board_changed)
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
    severity="note",
)
BOARD_UNSURE = Kind("scene.board_unsure", _board_unsure, "hold the board at more places", severity="note")
CONTRADICTION = Kind(
    "scene.contradiction",
    _contradiction,
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
BEST_UNCERTAIN = Kind(
    "scene.best_uncertain",
    "the best extrinsics in all axes together are uncertain: {axes:motion}",
    _BOARD,
    severity="warning",
)
AXIS_UNCHANGED = Kind("scene.axis_unchanged", _axis_unchanged, severity="note")
AXIS_CHANGED = Kind("scene.axis_changed", _axis_changed)
LARGE_SCATTER = Kind(
    "scene.large_scatter", _large_scatter, "record more places or more upright edges", severity="warning"
)
FLAT = Kind(
    "scene.flat",
    "scene, {subject:motion}: no extrinsics along this axis fit the edges clearly",
    "check that the result is of this rig, and images sharp and lit",
    severity="warning",
)
NO_PEAK = Kind(
    "scene.no_peak",
    "scene, {subject:motion}: the best fit is at the end of the range searched",
    _BOARD,
    severity="warning",
)
SIDE_WITHOUT_EDGES = Kind(
    "scene.side_without_edges",
    "no edges of the scene in the {subject} third of the images ({share:percent} of all)",
    _RECORD,
    severity="note",
)
