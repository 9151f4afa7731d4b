"""Which captures show the board to both sensors, and in which the sensors agree on its place."""

from lce_rig.core.results import LidarBoard, Refusal
from lce_rig.detect.detection import Detections, Pair
from lce_rig.extrinsics import CaptureCandidates
from lce_rig.extrinsics.consensus import find_consensus
from lce_rig.rig import Rig


def candidates_of(detections: Detections, pair: Pair) -> tuple[list[CaptureCandidates], dict[str, Refusal]]:
    """List the captures in which both sensors detect the board; and by capture why the others do not."""
    candidates, refused = [], {}
    for name in detections.captures(pair):
        image, lidar = detections.of(pair, name)
        if isinstance(image, Refusal):
            refused[name] = image
        elif isinstance(lidar, Refusal):
            refused[name] = lidar
        else:
            candidates.append(CaptureCandidates(name, image, lidar, detections.session_of.get(name, "")))
    return candidates, refused


def refusals_of(rig: Rig, detections: Detections, pair: Pair) -> dict[str, Refusal]:
    """State why captures of a pair are unusable: a sensor found no board, or both sensors disagree."""
    return match_sensors(rig, detections, pair)[0]


def match_sensors(
    rig: Rig, detections: Detections, pair: Pair
) -> tuple[dict[str, Refusal], dict[str, LidarBoard]]:
    """Choose the LiDAR's candidates that agree with the images.

    Returns:
        As `refusals_of`; and capture -> the candidate that is the board, where three captures agree at least.
    """
    chosen: dict[str, LidarBoard] = {}
    candidates, refused = candidates_of(detections, pair)
    if len(candidates) >= 3:
        consensus = find_consensus(candidates, rig.board.to_board())
        nowhere = Refusal("pair.no_agreement", figures={"n_captures": len(candidates)})
        refused |= consensus.refused if consensus else {item.capture: nowhere for item in candidates}
        chosen = {each.capture: each.lidar for each in consensus.observations} if consensus else {}
    return dict(sorted(refused.items())), chosen
