"""Follow the board from one scan to the next."""

from dataclasses import replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.results import LidarBoard, Refusal
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.detect.lidar.search import STANDARD, Limits, find_lidar_boards, measure_plate
from lce_rig.detect.lidar.segments import Indices, order_scan
from lce_rig.detect.lidar.template import Placement, plane_axes

WORSE_M = 0.003  # by how much the outline of a board held still may fit worse than before
# Farther from its last pose a board did not stand still: the search is the safer start.
STILL_M, STILL_TURN = 0.02, np.cos(np.radians(1.5))
STILL_SHARE = 0.9  # of the board's returns must lie where it was for a closer look
MAX_TURN = np.cos(np.radians(45.0))


def track_lidar_board(
    scan: Scan,
    board: Board,
    previous: LidarBoard,
    *,
    margin_m: float = 0.25,
    min_range_m: float = 0.4,
    min_rings: int = STANDARD.min_rings,
    max_rms_m: float = STANDARD.rms_m,
    beam: Beam | None = None,
) -> LidarBoard | Refusal:
    """Find the board near its previous pose: only returns in a box about it are looked at.

    A board held still is measured again where it was; one that moved is searched for in the box.

    Args:
        scan: one revolution.
        board: the outer size is what is looked for.
        previous: the board in an earlier scan.
        margin_m: by how much the box reaches beyond the board on every side.
        min_range_m: nearer returns are ignored.
        min_rings: fewest rings on the board.
        max_rms_m: largest rms distance of the board's returns from its plane, without noise.
        beam: light spot of the LiDAR; that of a VLP-16 where None.

    Returns:
        The best candidate in the box, or why there is none.

    References:
        LCE-Calib, "Checkerboard Tracking".
    """
    nearby = scan.select(_near(scan, board, previous, margin_m))
    limits = Limits(STANDARD.template_m, max_rms_m, min_rings)
    still = _measure_again(nearby, board, previous, min_range_m, limits, beam)
    if still is not None:
        return still
    found = find_lidar_boards(
        nearby,
        board,
        min_range_m=min_range_m,
        max_range_m=np.inf,
        min_rings=min_rings,
        max_rms_m=max_rms_m,
        beam=beam,
    )
    if isinstance(found, Refusal):
        return Refusal("lidar.lost", figures={**found.figures, "cause": found.code})
    for candidate in found:
        if candidate.plane[:3] @ previous.plane[:3] > MAX_TURN:
            return candidate
    return Refusal("lidar.turned_away", figures={"max_turn_deg": float(np.degrees(np.arccos(MAX_TURN)))})


def _near(scan: Scan, board: Board, previous: LidarBoard, margin_m: float) -> Indices:
    """List the returns in a box about the board's last place."""
    T = previous.T_lidar_board
    half = np.array([board.width_m / 2, board.height_m / 2, 0.0]) + margin_m
    rotation, centre = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    # A sphere first: it is the cheaper test, and few returns pass it.
    away = np.ascontiguousarray(scan.points.T) - centre[:, None]
    with np.errstate(invalid="ignore", over="ignore"):
        near = np.flatnonzero((away * away).sum(axis=0) < float(half @ half))
    is_inside = (np.abs(away[:, near].T @ rotation) <= half).all(axis=1)
    return np.asarray(near[is_inside])


def _measure_again(
    nearby: Scan, board: Board, previous: LidarBoard, min_range_m: float, limits: Limits, beam: Beam | None
) -> LidarBoard | None:
    """Start from the last pose, which a board held still hardly leaves; None unless it fits as well again."""
    T = previous.T_lidar_board
    half = np.array([board.width_m / 2, board.height_m / 2, 3.0 * previous.sigma_m])
    is_on = (np.abs((nearby.points - T[:3, 3]) @ T[:3, :3]) <= half).all(axis=1)
    if np.count_nonzero(is_on) < max(STILL_SHARE * len(previous.points), 1):
        return None
    ordered = order_scan(nearby, min_range_m)
    if len(ordered.index) == 0:
        return None
    width_axis = plane_axes(previous.plane[:3]).T @ T[:3, 0]
    half_m = (board.width_m / 2, board.height_m / 2)
    start = Placement(0.0, 0.0, float(np.arctan2(width_axis[1], width_axis[0])), half_m)
    limits = replace(limits, template_m=min(limits.template_m, previous.quality["template_m"] + WORSE_M))
    measured = measure_plate(
        ordered, nearby, board, previous.plane, T[:3, 3], start, limits.widened(ordered.sigma_m), beam
    )
    if not isinstance(measured, LidarBoard):
        return None
    is_still = np.linalg.norm(measured.T_lidar_board[:3, 3] - T[:3, 3]) < STILL_M
    return measured if is_still and measured.plane[:3] @ previous.plane[:3] > STILL_TURN else None
