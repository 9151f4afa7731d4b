"""Find the board in a full LiDAR scan, without a prior."""

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.results import LidarBoard, Refusal
from lce_rig.detect import lidar_refusal
from lce_rig.detect.lidar_features import Beam, build_board, refine
from lce_rig.detect.lidar_plates import propose_plates, screen_plates
from lce_rig.detect.lidar_segments import cut_segments, order_scan

MAX_CANDIDATES = 4
# A plate with as many rings and as little else in its plane is not outdone by plates that fit far worse.
CLEAR_RINGS = 6
CLEAR_SHARE = 0.05


def find_lidar_boards(
    scan: Scan,
    board: Board,
    *,
    min_range_m: float = 0.4,
    max_range_m: float = 6.0,
    min_rings: int = 4,
    max_template_m: float = 0.025,
    max_rms_m: float = 0.012,
    beam: Beam | None = None,
) -> list[LidarBoard] | Refusal:
    """Find the plates of the board's size in a scan, best first.

    Rings are cut into straight segments, segments in one plane grow into plates, the board's outline is
    registered with each plate, and the plates that it fits are measured. All thresholds widen with the noise
    that the scan itself shows.

    Args:
        scan: one revolution, or part of one.
        board: the outer size is what is looked for.
        min_range_m: nearer returns are ignored.
        max_range_m: plates farther away are ignored.
        min_rings: fewest rings on the board.
        max_template_m: largest mean distance of the outline from where the rings end, without noise.
        max_rms_m: largest rms distance of the board's returns from its plane, without noise.
        beam: light spot of the LiDAR; that of a VLP-16 where None.

    Returns:
        At most 4 boards that do not overlap, or why there is none.

    References:
        LCE-Calib, "Automatic Feature Extraction From LiDARs": selection and features.
    """
    ordered = order_scan(scan, min_range_m)
    if len(ordered.index) == 0:
        return lidar_refusal.no_returns(len(scan.points), min_range_m)
    segments = cut_segments(ordered, max_range_m, 2.0 * float(np.hypot(board.width_m, board.height_m)))
    plates, ends = propose_plates(ordered, segments, board)
    limit_m = min(max_template_m + 1.5 * ordered.sigma_m, 0.06)
    rms_limit_m = max_rms_m + 1.5 * ordered.sigma_m
    found: list[LidarBoard] = []
    misses: list[Refusal] = []
    rival_m = limit_m
    for plane, origin, start in screen_plates(plates, ends, board, limit_m):
        if start.error_m > rival_m:
            break
        refined = refine(ordered, plane, origin, start, limit_m)
        if refined is None:
            continue
        view, placement = refined
        if placement.error_m > limit_m:
            misses.append(lidar_refusal.outline_misfit(view, placement, limit_m, rms_limit_m))
            continue
        candidate = build_board(ordered, scan, board, view, placement, beam or Beam())
        if candidate is None:
            continue
        if candidate.quality["n_rings"] < min_rings:
            misses.append(lidar_refusal.too_few_rings(candidate, min_rings))
        elif candidate.sigma_m > rms_limit_m:
            heights_m = candidate.points @ candidate.plane[:3] + candidate.plane[3]
            misses.append(lidar_refusal.too_thick(heights_m, rms_limit_m))
        else:
            found.append(candidate)
            if (
                candidate.quality["n_rings"] >= CLEAR_RINGS
                and candidate.quality["beyond_share"] < CLEAR_SHARE
            ):
                rival_m = min(rival_m, 2 * start.error_m + 0.005)
    if found:
        return _distinct(found, board)
    if misses:
        return misses[0]
    return lidar_refusal.no_plate(ordered, board, limit_m, min_range_m, max_range_m)


def _distinct(found: list[LidarBoard], board: Board) -> list[LidarBoard]:
    """Rank the candidates and drop those that overlap a better one."""
    distinct: list[LidarBoard] = []
    for candidate in sorted(found, key=lambda c: _doubt(c, board)):
        centre = candidate.T_lidar_board[:3, 3]
        away = [float(np.linalg.norm(centre - other.T_lidar_board[:3, 3])) for other in distinct]
        if all(a > min(board.width_m, board.height_m) / 2 for a in away):
            distinct.append(candidate)
    return distinct[:MAX_CANDIDATES]


def _doubt(found: LidarBoard, board: Board) -> float:
    """Rate a candidate in m: misfit of outline and size, what no ring shows, what else is in its plane."""
    q = found.quality
    doubt = q["template_m"] + 0.03 / q["n_rings"] + 0.15 * (q["width_sigma_m"] + q["height_sigma_m"])
    doubt += 0.05 * q["beyond_share"]
    for measured_m, sigma_m, wanted_m in (
        (q["width_m"], q["width_sigma_m"], board.width_m),
        (q["height_m"], q["height_sigma_m"], board.height_m),
    ):
        doubt += 0.5 * max(0.0, abs(measured_m - wanted_m) - 2 * sigma_m - 0.005)
    return doubt
