"""Follow the board from one scan to the next."""

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.geometry import invert, transform
from lce_rig.core.results import LidarBoard, Refusal
from lce_rig.detect.lidar_board import find_lidar_boards


def track_lidar_board(
    scan: Scan, board: Board, previous: LidarBoard, *, margin_m: float = 0.25
) -> LidarBoard | Refusal:
    """Find the board near its previous pose: only returns in a box about it are looked at.

    Args:
        scan: one revolution.
        board: the outer size is what is looked for.
        previous: the board in an earlier scan.
        margin_m: by how much the box is larger than the board on every side.
    """
    local = transform(invert(previous.T_lidar_board), scan.points)
    half = np.array([board.width_m / 2, board.height_m / 2, 0.0]) + margin_m
    found = find_lidar_boards(scan.select((np.abs(local) <= half).all(axis=1)), board)
    return found if isinstance(found, Refusal) else found[0]
