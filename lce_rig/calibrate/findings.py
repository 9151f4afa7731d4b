"""Findings of the calibration: captures that disagree, and too few captures."""

from lce_rig.core.findings import Finding, Kind
from lce_rig.core.phrasing import captures_to_add, fill


def _tilt(finding: Finding) -> str:
    """{where}, or: add captures with the board tilted by 20 deg or more to all sides."""
    where = finding.figures.get("where")
    if isinstance(where, tuple):
        return captures_to_add(*where)
    return "add captures with the board tilted by 20 deg or more to all sides"


def _elsewhere(finding: Finding) -> str:
    """Best of {n_candidates} candidates: {distance_m}, {rotation_deg} from the board's pose in the image."""
    n, distance_m = finding.figures["n_candidates"], finding.figure("distance_m")
    which = "the only candidate" if n == 1 else f"the best of {n} candidates"
    apart = f"{distance_m:.1f} m" if distance_m >= 1 else f"{100 * distance_m:.0f} cm"
    return (
        f"{which} in the scan is {apart}, {finding.figure('rotation_deg'):.0f} deg from the board's "
        "pose in the image"
    )


_MATCH = "match images and scans by time or name, and collect into a new session"
_ORDERS = {
    "late": "one capture late: {n_explained} of {n_captures} fit the scan of the capture before",
    "early": "one capture early: {n_explained} of {n_captures} fit the scan of the capture after",
    "reversed": "in reversed order: {n_explained} of {n_captures} fit a scan from the other end",
}


def _mirrored(finding: Finding) -> str:
    """Images or scans are mirrored: {n_explained} of {n_captures} ({captures}), {n_agreeing} unchanged."""
    some = bool(finding.figures["captures"])
    what = "images of {captures:few} are" if some else "images or scans are"
    return fill(
        what
        + " mirrored: {n_explained} of {n_captures} captures agree when mirrored, {n_agreeing} unchanged",
        finding.figures,
    )


def _other_order(finding: Finding) -> str:
    """Images are late, early or reversed ({order}): {n_explained} of {n_captures}; {n_agreeing} unchanged."""
    return fill(
        f"images are {_ORDERS[str(finding.figures['order'])]}, {{n_agreeing}} unchanged", finding.figures
    )


FEW_CAPTURES = Kind(
    "shortage.few_captures",
    "{n_captures} captures show the board in both sensors (minimum {n_needed})",
    "add captures with the board at other places and tilts",
    severity="warning",
)
FEW_AGREE = Kind(
    "shortage.few_agree",
    "only {n_agreeing} of {n_captures} captures agree with one set of extrinsics",
    "check board size, intrinsics, and the pairing of images with scans",
    severity="warning",
)
MIRRORED = Kind(
    "association.mirrored", _mirrored, "switch off mirroring in the camera; give points x forward, y left"
)
OTHER_ORDER = Kind("association.other_order", _other_order, _MATCH)
EXCHANGED_IMAGES = Kind(
    "association.exchanged_images",
    "images are exchanged: {n_explained} of {n_captures} ({captures:few}) fit the scan of another capture",
    _MATCH,
)
UNDETERMINED = Kind(
    "shortage.undetermined",
    "{motions:motion} cannot be determined from {n_captures} captures: their boards are nearly parallel "
    "(normals spread by {spread_deg:1deg})",
    _tilt,
    severity="warning",
)
ELSEWHERE = Kind(
    "pair.elsewhere",
    _elsewhere,
    "come closer or tilt the board more",
    actions={"hold_still": "hold the board still, 20 cm or more clear of walls and other things"},
)
TWO_PLACES = Kind(
    "pair.two_places",
    "{first} and {second} give different board positions in the scan",
    "remove other things of the board's size, or cover them",
)
TURNED = Kind(
    "pair.turned",
    "the plate is turned by {rotation_deg:1deg} about its normal between both LiDARs",
    "keep other plates and boxes out of view",
)
OUTLIER = Kind(
    "calibrate.outlier",
    "outlier: plane {plane_m:mm}, edges {edges_m:mm} rms from the other captures' prediction "
    "(median {plane_median_m:mm}, {edges_median_m:mm})",
    "hold the board still, with nothing in front of it or close behind it",
)
