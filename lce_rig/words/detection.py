"""Phrases for refused captures, images and scans; codes begin with the stage that refuses."""

from lce_rig.core.findings import Finding
from lce_rig.words.rendering import Phrase


def _no_image(finding: Finding) -> str:
    """No image at the time of the scan; the nearest was {nearest_s} away."""
    nearest_s = finding.figures.get("nearest_s")
    nearest = f" (nearest: {nearest_s:.3f} s away)" if isinstance(nearest_s, float) else ""
    return f"no image at the time of the scan{nearest}"


PHRASES: dict[str, Phrase] = {
    "read.text": Phrase("{text}", "{advice}"),
    "read.no_image_at_scan": Phrase(_no_image),
    "image.text": Phrase("{text}", "{advice}"),
    "lidar.text": Phrase("{text}", "{advice}"),
    "pair.text": Phrase("{text}", "{advice}"),
    "calibrate.text": Phrase("{text}", "{advice}"),
}
