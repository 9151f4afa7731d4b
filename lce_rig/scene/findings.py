"""Kinds of findings of a scene's edges, and of boards in view, on deployed extrinsics."""

import math

from lce_rig.core.findings import Finding, Kind
from lce_rig.core.phrasing import fill

_BOARD = "collect a session with the board and calibrate it"
_FASTEN = f"fasten the sensors, {_BOARD}"
_UNSEEN = "changes below {smallest:size} would not be seen"
_RECORD = "record furniture, doors or people that stand before something farther off"

STATES = {"unchanged": "no change seen", "changed": "changed", "unknown": "cannot tell"}
"""Words for the state of an axis."""


def _axis_changed(finding: Finding) -> str:
    """Scene, {subject}: changed by {change:size} +- {sigma:size}, or instead: {instead}; {smallest:size}."""
    instead = ", or instead: {instead:motion}" if finding.figures["instead"] else ""
    text = "scene, {subject:motion}: changed by {change:+size} +- {sigma:size}" + instead
    return fill(text, {"subject": finding.subject, **finding.figures})


def _large_scatter(finding: Finding) -> str:
    """Scene, {subject}: changes below {smallest:size} would not be seen; {change:size}, {sigma:size}."""
    is_blind = math.inf in (finding.figures.get("smallest_m"), finding.figures.get("smallest_deg"))
    text = "parts of the scene do not agree on any change" if is_blind else _UNSEEN
    return fill(f"scene, {{subject:motion}}: {text}", {"subject": finding.subject, **finding.figures})


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
BOARD_CHANGED = Kind(
    "scene.board_changed", "board, {subject:motion}: changed by {change:+size} +- {sigma:size}"
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
    severity="note",
)
BOARD_UNSURE = Kind(
    "scene.board_unsure",
    "board, {subject:motion}: " + _UNSEEN,
    "hold the board at more places",
    severity="note",
)
CONTRADICTION = Kind(
    "scene.contradiction",
    "scene and boards contradict each other, {subject:motion}: scene {change:+size} +- {sigma:size}, "
    "boards {board:+size} +- {board_sigma:size}",
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
AXIS_UNCHANGED = Kind(
    "scene.axis_unchanged", "scene, {subject:motion}: no change of {smallest:size} or more", severity="note"
)
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
