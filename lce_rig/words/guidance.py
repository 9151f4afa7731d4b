"""Phrases of guided collection: why there is no guidance yet, and why it goes on."""

from collections.abc import Mapping

from lce_rig.core.findings import Finding
from lce_rig.words.rendering import Phrase, figures_apart


def _few_captures(finding: Finding) -> str:
    """About {n_more} more (minimum {n_least} captures)."""
    return f"{_more(finding)} (minimum {finding.figures['n_least']} captures)"


def _rotation_above(finding: Finding) -> str:
    """About {n_more} more (held-out {rotation_deg} > {limit_deg})."""
    stated, limit = figures_apart(finding.figure("rotation_deg"), finding.figure("limit_deg"))
    return f"{_more(finding)} (held-out {stated} > {limit} deg)"


def _position_above(finding: Finding) -> str:
    """About {n_more} more (held-out {position_m} > {limit_m})."""
    figures = 1000 * finding.figure("position_m"), 1000 * finding.figure("limit_m")
    stated, limit = figures_apart(*figures)
    return f"{_more(finding)} (held-out {stated} > {limit} mm)"


def _more(finding: Finding) -> str:
    n_more = finding.figures["n_more"]
    return "more captures" if n_more is None else f"about {n_more} more"


PHRASES: Mapping[str, Phrase] = {
    "guide.no_beams": Phrase("no guidance: {cause}"),
    "guide.no_nominal": Phrase(
        "guidance begins after {n_captures} captures: "
        "the profile has no nominal extrinsics of {camera} and {lidar}"
    ),
    "guide.few_captures": Phrase(_few_captures),
    "guide.rotation_above": Phrase(_rotation_above),
    "guide.position_above": Phrase(_position_above),
    "guide.predicted": Phrase(
        "{subject}: predicted standard deviations for {n_captures} captures: rotation {rotation_deg:2deg} "
        "(target {target_deg:g}), position {position_mm:.0f} mm (target {target_mm:g})"
    ),
}
