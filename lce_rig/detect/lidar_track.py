"""Follow the board from one scan to the next."""

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.results import LidarBoard, Refusal
from lce_rig.detect.lidar_board import find_lidar_boards
from lce_rig.detect.lidar_features import Beam

MAX_TURN = np.cos(np.radians(45.0))


def track_lidar_board(
    scan: Scan,
    board: Board,
    previous: LidarBoard,
    *,
    margin_m: float = 0.25,
    min_range_m: float = 0.4,
    min_rings: int = 4,
    beam: Beam | None = None,
) -> LidarBoard | Refusal:
    """Find the board near its previous pose: only returns in a box about it are looked at.

    Args:
        scan: one revolution.
        board: the outer size is what is looked for.
        previous: the board in an earlier scan.
        margin_m: by how much the box reaches beyond the board on every side.
        min_range_m: nearer returns are ignored.
        min_rings: fewest rings on the board.
        beam: light spot of the LiDAR; that of a VLP-16 where None.

    Returns:
        The best candidate in the box, or why there is none.

    References:
        LCE-Calib, "Checkerboard Tracking".
    """
    T = previous.T_lidar_board
    half = np.array([board.width_m / 2, board.height_m / 2, 0.0]) + margin_m
    rotation, centre = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    # A sphere first: it is the cheaper test, and few returns pass it.
    away = scan.points - centre
    with np.errstate(invalid="ignore"):
        near = np.flatnonzero(np.einsum("ij,ij->i", away, away) < float(half @ half))
    near = near[(np.abs(away[near] @ rotation) <= half).all(axis=1)]
    found = find_lidar_boards(
        scan.select(near), board, min_range_m=min_range_m, max_range_m=np.inf, min_rings=min_rings, beam=beam
    )
    if isinstance(found, Refusal):
        return Refusal("lidar", f"lost near its last place: {found.cause}", found.action)
    for candidate in found:
        if candidate.plane[:3] @ previous.plane[:3] > MAX_TURN:
            return candidate
    return Refusal(
        "lidar", "the only plate near the board's last place is turned by over 45 deg", "move more slowly"
    )
