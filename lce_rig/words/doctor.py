"""Phrases of profiles."""

from collections.abc import Mapping

from lce_rig.words.rendering import Phrase

PHRASES: Mapping[str, Phrase] = {
    "profile.swapped_sides": Phrase(
        "{subject}: {n_cols}x{n_rows} inner corners run along the shorter side of the plate "
        "{width_m:g} x {height_m:g} m",
        "check whether to swap width_m and height_m, or the inner_corners",
    ),
    "profile.drifting_clock": Phrase(
        "{subject}: the sensor's own clock without sync drifts away from the others",
    ),
    "profile.unknown_model": Phrase(
        "{subject}: the beams of {value} are not known: recordings can be calibrated, live guidance and "
        "simulation need elevations_deg and columns",
        "enter them and your LiDAR's noise (docs/rig-profiles.md: LiDAR models), or make a new profile with "
        "`lce-rig rigs new --lidar other --from RECORDING`",
    ),
    "profile.other_driver": Phrase(
        "{subject}: {value} reads Velodynes, and the model is {model}",
        "remove the driver block, or correct the model",
    ),
    "profile.unknown_driver": Phrase("{subject}: there is no driver {value}", "choose one of: {known}"),
    "profile.shared": Phrase("{subject}: {value} equals {other}, but two sensors cannot share it"),
}
