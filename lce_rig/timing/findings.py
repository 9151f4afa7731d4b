"""Kinds of findings on the sensors' clocks: images and pulses, edges, synchronisation."""

from lce_rig.core.findings import Finding, Kind, note_kind, warning_kind

NOTHING_YET = Kind("pulses.nothing_yet", "no images and pulses yet")
IMAGES_NOT_NUMBERED = Kind(
    "pulses.images_not_numbered", "its images carry no numbers: they cannot be matched to pulses"
)
CLOCK_NOT_TIED = Kind(
    "pulses.clock_not_tied", "its clock is not synchronised yet: images cannot be matched to pulses"
)
NO_PULSES = Kind("pulses.none", "images and no pulses", "check the board's line to the computer")
IMAGES_WITHOUT_PULSES = Kind(
    "pulses.images_without", "images without pulses", "set the camera to trigger mode, and check its line"
)
AMBIGUOUS_PULSES = Kind(
    "pulses.ambiguous",
    "more than one pulse in {window_ms:.0f} ms could have triggered an image",
    "start with slower pulses, or lower sync.triggers.{subject}.max_delay_s",
)
PULSES_NOT_FOLLOWED = Kind(
    "pulses.not_followed", "its images do not follow the pulses", "set the camera to trigger mode"
)
RESTARTED = Kind("pulses.restarted", "the camera or the sync board restarted its count")
SLIPPED = note_kind(
    "pulses.slipped",
    "matching images to pulses restarted {n_restarts} times; {n_matched} matched, {n_unmatched} not",
)

NO_EDGES = Kind("edges.none_seen", "no edges detected yet", "connect and enable its trigger input")
EDGES_TOO_CLOSE = Kind(
    "edges.too_close",
    "its clock is uncertain by {sigma_ms:.0f} ms, too much for pulses every {period_ms:.0f} ms",
    "connect the PPS line, or start at a lower trigger rate",
)
EDGES_NOT_THE_PULSES = Kind(
    "edges.not_the_pulses", "the detected edges are not the board's pulses", "check the wire"
)

BOARDS_MAY_MOVE = note_kind("sync.boards_may_move", "boards may move")
BOARDS_MUST_STAND = note_kind(
    "sync.boards_must_stand",
    "boards must stand still",
    actions={
        "add_board": "add `sync` to the profile (docs/wiring-and-sync.md) to let boards move",
        "see_lines": "see the lines of these sensors and of the sync board",
    },
)
NO_BOARD = warning_kind("sync.no_board", "no sync board", actions={"named": ""})
NONE_IN_PROFILE = warning_kind("sync.none_in_profile", "{key} is none", actions={"named": ""})
NOT_TIED = warning_kind(
    "sync.not_tied",
    "the clock of {subject} is not synchronised with the rig's",
    "run `lce-rig doctor --rig RIG`",
    actions={"named": ""},
)
TOO_UNCERTAIN = warning_kind(
    "sync.too_uncertain",
    "time of {subject}: standard deviation {sigma_ms:.1f} ms (limit {limit_ms:.1f} ms)",
    actions={"named": ""},
)


def _no_image(finding: Finding) -> str:
    """No image at the time of the scan; the nearest was {nearest_s} away."""
    nearest_s = finding.figures.get("nearest_s")
    nearest = f" (nearest: {nearest_s:.3f} s away)" if isinstance(nearest_s, float) else ""
    return f"no image at the time of the scan{nearest}"


READ_NO_IMAGE_AT_SCAN = Kind("read.no_image_at_scan", _no_image)
READ_NO_OTHER = Kind(
    "read.no_other", "no sample of another sensor at that time", "check that their clocks agree"
)
