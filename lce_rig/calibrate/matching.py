"""Which LiDAR candidate and which camera pose of a capture an extrinsic says belong together."""

import itertools
from dataclasses import replace

import numpy as np

from lce_rig.calibrate.options import CaptureCandidates
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, transform
from lce_rig.core.results import Observation


def match_candidates(candidates: CaptureCandidates, board: Board, T_cam_lidar: Array) -> Observation:
    """Pair the candidates of one capture that lie closest to each other under a known extrinsic.

    Centres and normals decide, the angle weighed by the plate's half diagonal; turns in the plane do not
    count, since a scan cannot tell a rectangle's.

    Args:
        candidates: what both sensors saw.
        board: its size weighs angles against distances.
        T_cam_lidar: (4, 4).
    """
    poses = [candidates.image.T_cam_board]
    if candidates.image.T_cam_board_alternative is not None:
        poses.append(candidates.image.T_cam_board_alternative)
    arm_m = np.hypot(board.width_m, board.height_m) / 2

    def misfit(pair: tuple[int, int]) -> float:
        T_cam_board, lidar = poses[pair[0]], candidates.lidar[pair[1]]
        normal = T_cam_lidar[:3, :3] @ lidar.plane[:3]
        centre = transform(T_cam_lidar, lidar.T_lidar_board[None, :3, 3])[0]
        turn_m = arm_m * np.linalg.norm(normal - T_cam_board[:3, 2])
        return float(np.hypot(turn_m, np.linalg.norm(centre - T_cam_board[:3, 3])))

    pose_index, lidar_index = min(
        itertools.product(range(len(poses)), range(len(candidates.lidar))), key=misfit
    )
    image = replace(candidates.image, T_cam_board=poses[pose_index])
    return Observation(candidates.capture, image, candidates.lidar[lidar_index])
