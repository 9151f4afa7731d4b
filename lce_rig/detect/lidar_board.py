"""Find the board in a full LiDAR scan, without a prior."""

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard, Refusal
from lce_rig.detect.lidar_features import Beam, build_board, refine
from lce_rig.detect.lidar_plates import Plates, propose_plates
from lce_rig.detect.lidar_segments import cut_segments, order_scan
from lce_rig.detect.lidar_template import Placement, plane_axes, register_ends

MAX_CANDIDATES = 4


def find_lidar_boards(
    scan: Scan,
    board: Board,
    *,
    min_range_m: float = 0.4,
    max_range_m: float = 6.0,
    min_rings: int = 4,
    max_template_m: float = 0.025,
    beam: Beam | None = None,
) -> list[LidarBoard] | Refusal:
    """Find the plates of the board's size in a scan, best first.

    Rings are cut into straight segments, segments in one plane grow into plates, the board's outline is
    registered with each plate, and the plates that it fits are measured.

    Args:
        scan: one revolution, or part of one.
        board: the outer size is what is looked for.
        min_range_m: nearer returns are ignored.
        max_range_m: plates farther away are ignored.
        min_rings: fewest rings on the board.
        max_template_m: largest mean distance of the outline from where the rings end; grows with the noise.
        beam: light spot of the LiDAR; that of a VLP-16 where None.

    Returns:
        At most 4 boards, or why there is none.

    References:
        LCE-Calib, "Automatic Feature Extraction From LiDARs": selection and features.
    """
    ordered = order_scan(scan, min_range_m)
    segments = cut_segments(ordered, max_range_m)
    plates, ends = propose_plates(ordered, segments, board)
    limit_m = min(max_template_m + 1.5 * ordered.sigma_m, 0.06)
    found: list[tuple[float, LidarBoard]] = []
    for plane, origin, placement in _screen(plates, ends, board, limit_m):
        refined = refine(ordered, plane, origin, placement, limit_m)
        if refined is None:
            continue
        view, placement = refined
        candidate = build_board(ordered, scan, board, view, placement, beam or Beam())
        if candidate.quality["n_rings"] < min_rings or len(candidate.points) < 10:
            continue
        found.append((_doubt(candidate), candidate))
    found.sort(key=lambda item: item[0])
    distinct: list[LidarBoard] = []
    for _, candidate in found:
        centre = candidate.T_lidar_board[:3, 3]
        if all(np.linalg.norm(centre - other.T_lidar_board[:3, 3]) > 0.2 for other in distinct):
            distinct.append(candidate)
    if not distinct:
        return Refusal("lidar", "no plate of the board's size", "show the board to the LiDAR at 1.5-3 m, free of other things")
    return distinct[:MAX_CANDIDATES]


def _doubt(board: LidarBoard) -> float:
    """Rank a candidate in m: how badly the outline fits, and how little of its size the rings can show."""
    quality = board.quality
    return quality["template_m"] + 0.25 * (quality["width_sigma_m"] + quality["height_sigma_m"])


def _screen(plates: Plates, ends: Array, board: Board, limit_m: float) -> list[tuple[Array, Array, Placement]]:
    """Register the outline with the ends of each plate's segments and keep the plates it fits, best first."""
    if len(plates.centre) == 0:
        return []
    relative = ends - plates.centre[:, None]
    placements = register_ends(relative @ plane_axes(plates.plane[:, :3]), board)
    rank = sorted(range(len(placements)), key=lambda k: placements[k].error_m)
    # What fits far worse than the best plate is no rival of it.
    limit_m = min(limit_m, 3 * placements[rank[0]].error_m + 0.01)
    return [(plates.plane[k], plates.centre[k], placements[k]) for k in rank if placements[k].error_m < limit_m]
