"""Phrases of guided collection: why there is no guidance yet, and why it goes on."""

from collections.abc import Mapping

from lce_rig.words.rendering import Phrase

PHRASES: Mapping[str, Phrase] = {
    "guide.no_beams": Phrase("no guidance: {cause}"),
    "guide.no_nominal": Phrase(
        "guidance begins after {n_captures} captures: "
        "the profile has no nominal extrinsics of {camera} and {lidar}"
    ),
}
