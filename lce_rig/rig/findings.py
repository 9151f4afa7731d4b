"""Findings of valid but probably unintended settings of a profile; the subject is the key."""

from lce_rig.core.findings import Kind

SWAPPED_SIDES = Kind(
    "profile.swapped_sides",
    "{subject}: {n_cols}x{n_rows} corners run along the shorter side of the plate "
    "{width_m:g} x {height_m:g} m",
    "check whether to swap width_m and height_m, or the [columns, rows]",
    severity="warning",
)
DRIFTING_CLOCK = Kind(
    "profile.drifting_clock",
    "{subject}: the sensor's own clock without sync drifts away from the others",
    severity="warning",
)
ODD_RATE = Kind(
    "profile.odd_rate",
    "{subject}: {rate_hz:g} revolutions per second; spinning LiDARs turn 5 to 20 times",
    "enter the LiDAR's own rate, not that of the recorded scans",
    severity="warning",
)
UNKNOWN_MODEL = Kind(
    "profile.unknown_model",
    "{subject}: the beams of {value} are not known: recordings can be calibrated, live guidance and "
    "simulation need elevations_deg and columns",
    "the model `other` measures them: `lce-rig rigs new --help`",
    severity="warning",
)
SHARED = Kind(
    "profile.shared",
    "{subject}: {value} equals {other}, but two sensors cannot share it",
    severity="warning",
)
