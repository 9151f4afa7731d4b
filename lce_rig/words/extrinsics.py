"""Phrases for extrinsics that cannot be estimated, and for texts of earlier versions."""

from lce_rig.core.findings import Finding
from lce_rig.core.phrasing import motion_words
from lce_rig.words.rendering import Phrase


def _undetermined(finding: Finding) -> str:
    """{motions} undetermined by {n_captures} captures: boards nearly parallel, spread {spread_deg}."""
    motions, n_captures = finding.figures["motions"], finding.figures["n_captures"]
    assert isinstance(motions, tuple)
    names = " and ".join(motion_words(str(motion)) for motion in motions)
    return (
        f"{names} cannot be determined from {n_captures} captures: their boards are nearly parallel "
        f"(normals spread by {finding.figure('spread_deg'):.1f} deg)"
    )


PHRASES: dict[str, Phrase] = {
    "verdict.text": Phrase("{text}", "{advice}"),
    "shortage.few_captures": Phrase(
        "{n_captures} captures show the board in both sensors (minimum {n_needed})",
        "add captures: ten or more, with the board at different places and tilts",
    ),
    "shortage.few_agree": Phrase(
        "only {n_agreeing} of {n_captures} captures agree with one set of extrinsics (minimum {n_needed})",
        "check the board's size, the intrinsics and the pairing of images with scans; add captures",
    ),
    "shortage.undetermined": Phrase(
        _undetermined,
        "add captures with the board tilted by 20 deg or more, left and right as well as up and down",
    ),
}
