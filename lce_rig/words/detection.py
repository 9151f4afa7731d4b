"""Phrases for refused captures, images and scans; codes begin with the stage that refuses."""

from lce_rig.core.findings import Finding
from lce_rig.words.rendering import Phrase

_HOLD_STILL = "hold the board still while capturing, with nothing in front of it or close behind its rim"
_REMOVE_OTHERS = "remove other things of the board's size, or cover them"


def _no_image(finding: Finding) -> str:
    """No image at the time of the scan; the nearest was {nearest_s} away."""
    nearest_s = finding.figures.get("nearest_s")
    nearest = f" (nearest: {nearest_s:.3f} s away)" if isinstance(nearest_s, float) else ""
    return f"no image at the time of the scan{nearest}"


def _candidates(finding: Finding) -> str:
    """Best of {n_candidates} candidates: {distance_m}, {rotation_deg} from where the image has the board."""
    n, distance_m = finding.figures["n_candidates"], finding.figure("distance_m")
    which = "the only candidate" if n == 1 else f"the best of {n} candidates"
    apart = f"{distance_m:.1f} m" if distance_m >= 1 else f"{100 * distance_m:.0f} cm"
    return (
        f"{which} in the scan is {apart}, {finding.figure('rotation_deg'):.0f} deg from where the image has "
        "the board"
    )


PHRASES: dict[str, Phrase] = {
    "read.text": Phrase("{text}", "{advice}"),
    "read.no_image_at_scan": Phrase(_no_image),
    "image.text": Phrase("{text}", "{advice}"),
    "lidar.text": Phrase("{text}", "{advice}"),
    "pair.text": Phrase("{text}", "{advice}"),
    "pair.no_candidate": Phrase(
        "no surface in the scan fits the board", "move the board clear of other things"
    ),
    "pair.elsewhere": Phrase(
        _candidates,
        "come closer or tilt the board more, so that both sensors see its tilt well",
        {"hold_still": "hold the board still, and 20 cm or more clear of walls, pillars and other things"},
    ),
    "pair.two_places": Phrase(
        "{first} and {second} give different board positions in the scan", _REMOVE_OTHERS
    ),
    "calibrate.text": Phrase("{text}", "{advice}"),
    "calibrate.outlier": Phrase(
        "outlier: plane {plane_m:mm}, edges {edges_m:mm} rms from the other captures' prediction "
        "(median {plane_median_m:mm}, {edges_median_m:mm})",
        _HOLD_STILL,
    ),
}
