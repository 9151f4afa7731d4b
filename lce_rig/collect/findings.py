"""Reasons why captures are rejected, why guidance is missing, and why collection continues."""

from lce_rig.core.findings import Finding, Kind
from lce_rig.core.phrasing import captures_to_add


def _placements(finding: Finding) -> str:
    """Add {n_captures} captures ({is_enough}: predicted to suffice): {placements}."""
    figures = finding.figures
    return captures_to_add(figures["n_captures"], figures["is_enough"], figures["placements"])


GUIDE_NO_BEAMS = Kind("guide.no_beams", "no guidance: {cause}", severity="warning")
GUIDE_NO_NOMINAL = Kind(
    "guide.no_nominal",
    "guidance begins after {n_captures} captures: "
    "the profile has no nominal extrinsics of {camera} and {lidar}",
    severity="warning",
)
GUIDE_OF_PEERS = Kind(
    "guide.of_peers",
    "no guidance for two sensors of one kind: "
    "{n_captures} placements at all distances, sides and tilts suffice",
    severity="note",
)
GUIDE_CONTINUES = Kind(
    "guide.continues",
    "captures to go: {n_more} (minimum {n_least}, below {limit_deg:g} deg, {limit_mm:g} mm)",
    severity="note",
)
GUIDE_PREDICTED = Kind(
    "guide.predicted",
    "{subject}: predicted below {rotation_deg:2deg} (target {target_deg:g}), {position_mm:.1f} mm "
    "(target {target_mm:g})",
    severity="note",
)
GUIDE_ADD = Kind(
    "guide.add", "captures to add, where each reduces the uncertainty most", _placements, severity="note"
)
READ_EVENTS_GONE_BY = Kind(
    "read.events_gone_by",
    "the scan arrived after the events that follow it",
    "split the recording where the LiDAR's clock was set back",
)
READ_NO_EVENTS_AT_SCAN = Kind(
    "read.no_events_at_scan",
    "no events at the time of the scan",
    "record events while the LiDAR runs and check that the clocks agree",
)
EVENTS_TURNED = Kind(
    "events.turned",
    "{subject}: the events are {turn} against the frames of the same camera (correlation {correlation:.2f})",
    "turn the events or the frames in the driver, or in the recording",
)
EVENTS_POLARITY = Kind(
    "events.polarity",
    "{subject}: the polarity of the events is inverted (correlation with the frames {correlation:.2f}); "
    "the extrinsics do not depend on it",
    "exchange the polarities in the driver",
    severity="warning",
)
EVENTS_LATE = Kind(
    "events.late",
    "{subject}: the events are {late_s:+.2f} s late relative to the frames of the same camera",
    "enter cameras.{camera}.channels.{channel}.timestamps.expected_offset_s: {expected_offset_s:g}",
    severity="warning",
)
IMAGE_NONE = Kind("image.none", "no board in any image")
CALIBRATE_SAME_PLACEMENT = Kind("calibrate.same_placement", "same placement as in an earlier capture")
LIDAR_ELSEWHERE = Kind(
    "lidar.elsewhere",
    "best of {n_candidates} candidates in the scan: {distance_m:.2f} m, {rotation_deg:.0f} deg from the "
    "pose predicted by the image and the nominal extrinsics",
    "hold the board clear of other objects, where more rings hit it",
)
CALIBRATE_KNOWN_PLACEMENT = Kind(
    "calibrate.known_placement",
    "the board is at the placement of capture {capture}",
    "{instruction}",
    actions={"nowhere": "stop the collection: no new placement is left"},
)
CALIBRATE_LITTLE_GAIN = Kind(
    "calibrate.little_gain",
    "this placement improves the result by {gain:1percent}, another by {best_gain:percent}",
    "{instruction}",
)
CLOCK_SIMULATED = Kind("clock.simulated", "simulated", severity="note")
