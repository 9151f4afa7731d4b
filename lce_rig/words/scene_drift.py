"""Phrases for the scene's opinion on extrinsics (`drift`)."""

from lce_rig.core.findings import Finding
from lce_rig.words.extrinsics import motion_words
from lce_rig.words.rendering import Phrase

_BOARD = "collect a session with the board and run `lce-rig calibrate`"
_RECORD = "record where upright edges of furniture, doors or people stand before something farther away"

STATES = {"unchanged": "no change seen", "changed": "changed", "unknown": "cannot tell"}
"""What is said of an axis, by its state."""


def _figure(finding: Finding, name: str, signed: bool = False) -> str:
    sign = "+" if signed else ""
    if f"{name}_deg" in finding.figures:
        return f"{finding.figure(f'{name}_deg'):{sign}.2f} deg"
    return f"{1000 * finding.figure(f'{name}_m'):{sign}.0f} mm"


def _motions(finding: Finding, name: str) -> str:
    axes = finding.figures[name]
    assert isinstance(axes, tuple)
    return ", ".join(motion_words(str(axis)) for axis in axes)


def _unchanged(finding: Finding) -> str:
    """No change seen in {n_captures} captures."""
    return f"the extrinsics fit the edges of the scene in {finding.figures['n_captures']} captures"


def _changed(finding: Finding) -> str:
    """The extrinsics changed: {changed}; {n_captures}, {unknown}."""
    return f"the extrinsics do not fit the edges of the scene: {_motions(finding, 'changed')}"


def _unknown(finding: Finding) -> str:
    """The scene cannot tell {unknown}; {n_captures}, {changed}."""
    return f"the edges of the scene cannot tell: {_motions(finding, 'unknown')}"


def _best_uncertain(finding: Finding) -> str:
    """The search in all axes leaves {axes} open."""
    return f"the best extrinsics in all axes together are uncertain: {_motions(finding, 'axes')}"


def _unchanged_with_board(finding: Finding) -> str:
    """No change seen in {n_captures} captures, {n_boards} of which show the board."""
    n = finding.figures
    return (
        f"the extrinsics fit: the scene of {n['n_captures']} captures, "
        f"or the board in {n['n_boards']}, covers each axis"
    )


def _changed_with_board(finding: Finding) -> str:
    """The scene or the board says that {changed} changed; {n_captures}, {n_boards}, {unknown}."""
    return f"the extrinsics do not fit the scene or the board: {_motions(finding, 'changed')}"


def _unknown_with_board(finding: Finding) -> str:
    """Neither the scene nor the board can tell {unknown}; {n_captures}, {n_boards}, {changed}."""
    return f"neither the scene nor the board can tell: {_motions(finding, 'unknown')}"


def _board_changed(finding: Finding) -> str:
    """Changed by {change_m} or {change_deg} +- {sigma_m} or {sigma_deg}; {smallest_m}."""
    change = f"{_figure(finding, 'change', signed=True)} +- {_figure(finding, 'sigma')}"
    return f"board, {motion_words(finding.subject)}: changed by {change}"


def _board_unsure(finding: Finding) -> str:
    """Changes below {smallest_m} or {smallest_deg} would not be seen; {change_m}, {sigma_m}."""
    return (
        f"board, {motion_words(finding.subject)}: changes below {_figure(finding, 'smallest')} "
        "would not be seen"
    )


def _axis_unchanged(finding: Finding) -> str:
    """No change of {smallest_m} or {smallest_deg}; {change_m}, {change_deg}, {sigma_m}, {sigma_deg}."""
    return f"scene, {motion_words(finding.subject)}: no change of {_figure(finding, 'smallest')} or more"


def _axis_changed(finding: Finding) -> str:
    """Changed by {change_m} or {change_deg} +- {sigma_m} or {sigma_deg}; {smallest_m}, {instead}."""
    change = f"{_figure(finding, 'change', signed=True)} +- {_figure(finding, 'sigma')}"
    instead = f", or instead: {_motions(finding, 'instead')}" if finding.figures["instead"] else ""
    return f"scene, {motion_words(finding.subject)}: changed by {change}{instead}"


def _large_scatter(finding: Finding) -> str:
    """Parts of the scene disagree; {smallest_m} or {smallest_deg} would be seen."""
    if "inf" in _figure(finding, "smallest"):
        return f"scene, {motion_words(finding.subject)}: parts of the scene do not agree on any change"
    smallest = _figure(finding, "smallest")
    return f"scene, {motion_words(finding.subject)}: changes below {smallest} would not be seen"


def _flat(finding: Finding) -> str:
    """The score along the axis has no clear peak."""
    return f"scene, {motion_words(finding.subject)}: no extrinsics along this axis fit the edges clearly"


def _no_peak(finding: Finding) -> str:
    """The best fit is at the end of the range."""
    return f"scene, {motion_words(finding.subject)}: the best fit is at the end of the range searched"


PHRASES = {
    "scene.unchanged": Phrase(_unchanged),
    "scene.changed": Phrase(_changed, f"fasten the sensors, {_BOARD}"),
    "scene.unknown": Phrase(_unknown, f"{_RECORD}, or {_BOARD}"),
    "scene.few_edges": Phrase(
        "{n_edges} edges of the scene in {n_captures} captures are too few or too close together", _RECORD
    ),
    "scene.unchanged_with_board": Phrase(_unchanged_with_board),
    "scene.changed_with_board": Phrase(_changed_with_board, f"fasten the sensors, {_BOARD}"),
    "scene.unknown_with_board": Phrase(_unknown_with_board, f"{_RECORD}, or {_BOARD}"),
    "scene.board_changed": Phrase(_board_changed),
    "scene.board_unsure": Phrase(_board_unsure, "hold the board at more places"),
    "scene.no_samples": Phrase(
        "no image or events of {subject} within the tolerance of a scan of {lidar}",
        "check the topics and timestamps of the recording, or record this camera",
    ),
    "scene.no_firing_times": Phrase(
        "{n_captures} captures of a moving rig are not used: scans of {subject} or images have no times",
        "record points with their firing times, or let the rig stand",
    ),
    "scene.clocks_apart": Phrase(
        "while the rig moves, images of {subject} fit best {apart_s:+.2f} s from their timestamps",
        "let the rig stand, or correct the clocks: `lce-rig doctor` measures them",
    ),
    "scene.clocks_instead": Phrase(
        "or the clocks are apart: while the rig moves, images of {subject} {apart_s:+.2f} s from their "
        "timestamps explain it nearly as well",
        "let the rig stand, which tells one from the other",
    ),
    "scene.events_of_standing_rig": Phrase(
        "{subject} is judged by events, which show only what moves, and the rig was not seen to move",
        "move the rig slowly past upright edges, or record images as well",
    ),
    "scene.best_uncertain": Phrase(_best_uncertain, _BOARD),
    "scene.axis_unchanged": Phrase(_axis_unchanged),
    "scene.axis_changed": Phrase(_axis_changed),
    "scene.large_scatter": Phrase(_large_scatter, "record more places or more upright edges"),
    "scene.flat": Phrase(
        _flat, "check that the result belongs to this rig and that the images are sharp and lit"
    ),
    "scene.no_peak": Phrase(_no_peak, _BOARD),
    "scene.side_without_edges": Phrase(
        "no edges of the scene in the {subject} third of the images ({share:percent} of all)", _RECORD
    ),
}
