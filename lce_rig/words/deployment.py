"""Phrases of deployment: what speaks against a result on a robot."""

from collections.abc import Mapping

from lce_rig.words.rendering import Phrase

PHRASES: Mapping[str, Phrase] = {
    "deploy.failed": Phrase("the calibration of {subject} failed", "Collect again, see `lce-rig calibrate`."),
    "deploy.other_robot": Phrase(
        "the result is of robot {robot}, the target of {there}", "Name the target of the right robot."
    ),
    "deploy.other_serial": Phrase(
        "{subject} has serial number {serial}, the deployed one {there}",
        "Name the right target. If the sensor was replaced, force it and say so.",
    ),
    "deploy.older": Phrase(
        "the result's captures are of {date}, the deployed ones of {there}",
        "Deploy the newer session, or use `--rollback` to go back.",
    ),
}
