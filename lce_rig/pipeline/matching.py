"""Which captures show the board to both sensors, and in which the sensors agree on its place."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from lce_rig.calibrate.consensus import Consensus, camera_poses, find_consensus
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, invert
from lce_rig.core.results import LidarBoard, Observation
from lce_rig.detect.detection import Detections, Pair
from lce_rig.pipeline.findings import NO_AGREEMENT
from lce_rig.rig import Rig


def candidates_of(detections: Detections, pair: Pair) -> tuple[list[Observation], dict[str, Refusal]]:
    """List the captures in which both sensors detect the board; and by capture why the others do not."""
    candidates, refused = [], {}
    for name in detections.captures(pair):
        image, lidar = detections.of(pair, name)
        if isinstance(image, Refusal):
            refused[name] = image
        elif isinstance(lidar, Refusal):
            refused[name] = lidar
        else:
            candidates.append(Observation.of(name, image, lidar))
    return candidates, refused


def boards_in(
    detections: Detections, camera: str, lidar: str, captures: Collection[str] | None = None
) -> Array:
    """Stack the board's poses T_cam_board (N, 4, 4) in captures that both sensors see; in all if None."""
    poses: dict[str, Array] = {}
    for pair in detections.pairs:
        if (pair.camera, pair.lidar) == (camera, lidar):
            poses |= {each.capture: each.image.T_cam_board for each in candidates_of(detections, pair)[0]}
    chosen = [T for name, T in poses.items() if captures is None or name in captures]
    return np.array(chosen).reshape(-1, 4, 4)


def match_sensors(
    rig: Rig, detections: Detections, pair: Pair
) -> tuple[dict[str, Refusal], dict[str, LidarBoard]]:
    """Choose the LiDAR's candidates that agree with the images.

    Returns:
        Why captures are unusable, as a sensor found no board or both disagree; and capture -> the candidate
        that is the board, where three captures agree at least.
    """
    chosen: dict[str, LidarBoard] = {}
    candidates, refused = candidates_of(detections, pair)
    consensus = _consensus(rig, candidates)
    if consensus is not None:
        refused |= consensus.refused
        chosen = {observation.capture: observation.lidar for observation in consensus.observations}
    elif len(candidates) >= 3:
        refused |= {item.capture: NO_AGREEMENT.refusal(n_captures=len(candidates)) for item in candidates}
    return dict(sorted(refused.items())), chosen


def _consensus(rig: Rig, candidates: Sequence[Observation]) -> Consensus | None:
    try:
        return find_consensus(candidates, rig.board.to_board())
    except NotEnoughDataError:
        return None


#: So many captures must agree on extrinsics, and more than half of them, before others are looked at again.
_LEAST_AGREEING = 5


def expected_poses(rig: Rig, detections: Detections) -> Mapping[str, Mapping[str, list[Array]]]:
    """Predict where the board is in scans that show it nowhere, or elsewhere than the images.

    Returns:
        By LiDAR and capture the poses T_lidar_board (4, 4) that the image leaves open.
    """
    expected: dict[str, dict[str, list[Array]]] = {}
    for pair in detections.pairs:
        candidates, _ = candidates_of(detections, pair)
        consensus = _consensus(rig, candidates)
        n_agreeing = len(consensus.observations) if consensus else 0
        if consensus is None or n_agreeing < max(_LEAST_AGREEING, len(candidates) / 2):
            continue
        agreeing = {each.capture for each in consensus.observations}
        T_lidar_cam = invert(consensus.T_cam_lidar)
        for name in detections.captures(pair):
            image, _ = detections.of(pair, name)
            if name not in agreeing and not isinstance(image, Refusal):
                poses = [T_lidar_cam @ T_cam_board for T_cam_board in camera_poses(image)]
                expected.setdefault(pair.lidar, {}).setdefault(name, poses)
    return expected
