"""Find the board in a full LiDAR scan, without a prior."""

from dataclasses import dataclass, field, replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard
from lce_rig.detect.findings import (
    LIDAR_NO_PLATE,
    LIDAR_NO_RETURNS,
    LIDAR_NOT_WHERE_EXPECTED,
    LIDAR_NOTHING_WHERE_EXPECTED,
    LIDAR_OTHER_PLATE,
    LIDAR_OUTLINE,
    LIDAR_TOO_FEW_RINGS,
    LIDAR_TOO_THICK,
    LIDAR_TOUCHING,
)
from lce_rig.detect.lidar.measurement import Beam, build_board, refine
from lce_rig.detect.lidar.plates import Plates, propose_plates, screen_plates
from lce_rig.detect.lidar.segments import OrderedScan, cut_segments, order_scan
from lce_rig.detect.lidar.template import (
    Placement,
    PlaneView,
    lost_share,
    plane_axes,
)

# Fraction of returns beyond the outline, in the board's plane, above which something touches the board.
TOUCHING_SHARE = 0.10
SCATTER_M = 0.02  # added to the LiDAR's noise in the search for plates to report
# Maximum sum of |log| of the ratios of long and short side for a plate to be reported.
MAX_SIZE_MISFIT = 0.75
LAYER_M = 0.06  # half the depth in which returns may belong to one warped or moving sheet


@dataclass(frozen=True)
class Limits:
    """Limits of the search, and for accepting a plate as the board.

    Attributes:
        template_m: largest mean distance of the outline from the ends of the rings.
        rms_m: largest rms distance of the returns from the plane.
        min_rings: fewest rings on the board.
        min_range_m: nearer returns are ignored.
        max_range_m: plates farther away are ignored.
        beam: light spot of the LiDAR, a VLP-16's by default.
    """

    template_m: float = 0.025
    rms_m: float = 0.012
    min_rings: int = 4
    min_range_m: float = 0.4
    max_range_m: float = 6.0
    beam: Beam = field(default_factory=Beam)

    def widened(self, sigma_m: float) -> "Limits":
        """Widen the limits by the scan's noise."""
        template_m = min(self.template_m + 1.5 * sigma_m, 0.06)
        return replace(self, template_m=template_m, rms_m=self.rms_m + 1.5 * sigma_m)


STANDARD = Limits()


def too_thick(heights_m: Array, limit_m: float) -> Refusal:
    """Refuse a board whose returns scatter more about its plane than the LiDAR's noise explains.

    Args:
        heights_m: (N,) distances of the returns from the plane.
        limit_m: largest rms distance.
    """
    return LIDAR_TOO_THICK.refusal(plane_rms_m=float(np.sqrt(np.mean(heights_m**2))), max_plane_rms_m=limit_m)


def outline_misfit(view: PlaneView, placement: Placement, limit_m: float, rms_limit_m: float) -> Refusal:
    """Refuse a plate with another outline than the board's: warped, touched by an object, or partly hidden.

    Args:
        view: beams about the plate.
        placement: the best fit of the outline.
        limit_m: largest error of an outline.
        rms_limit_m: largest rms distance of the returns from the plane.
    """
    distance = placement.distance_m(view.uv)
    n_on = max(1, int((view.is_on & (distance <= 0)).sum()))
    beyond = int((view.is_on & (distance > 0.03)).sum()) / n_on
    heights_m = view.height_m[(distance < -0.03) & (np.abs(view.height_m) < LAYER_M)]
    is_one_sheet = len(heights_m) > 0.8 * max(1, int((distance < -0.03).sum()))
    if is_one_sheet and np.sqrt(np.mean(heights_m**2)) > rms_limit_m:
        return too_thick(heights_m, rms_limit_m)
    distance_m = float(np.linalg.norm(view.origin))
    if beyond > TOUCHING_SHARE:
        return LIDAR_TOUCHING.refusal(distance_m=distance_m, beyond_share=beyond)
    hidden = float(np.mean(~view.is_on[distance <= -0.03])) if np.any(distance <= -0.03) else 0.0
    return LIDAR_OUTLINE.refusal(
        distance_m=distance_m, error_m=float(placement.error_m), max_error_m=limit_m, hidden_share=hidden
    )


def no_plate(scan: OrderedScan, board: Board, limits: Limits) -> Refusal:
    """Refuse a scan without the board, and describe the most similar plate.

    The search is repeated for plates of any size, with more scatter than the LiDAR's noise.

    Args:
        scan: all returns.
        board: the board searched for.
        limits: limits, including the scan's noise.
    """
    coarse = replace(scan, sigma_m=scan.sigma_m + SCATTER_M)
    segments = cut_segments(coarse, limits.max_range_m)
    plates, _ = propose_plates(coarse, segments, board, is_any_size=True)
    board_m = np.array([max(board.width_m, board.height_m), min(board.width_m, board.height_m)])
    misfit = np.abs(np.log(np.maximum(plates.size_m, 1e-2) / board_m)).sum(axis=1)
    misfit[plates.n_rings < 3] += 1.0
    return nearest_plate(plates, misfit, board, limits)


def nearest_plate(plates: Plates, misfit: Array, board: Board, limits: Limits) -> Refusal:
    """Refuse a scan: name the plate nearest in size to the board, or report that none is near.

    Args:
        plates: K of them.
        misfit: (K,) sum of |log| of the ratios of long and short side.
        board: the board searched for.
        limits: limits of the search.
    """
    if len(misfit) and misfit.min() < MAX_SIZE_MISFIT:
        best = int(np.argmin(misfit))
        return other_plate(plates.size_m[best], float(np.linalg.norm(plates.centre[best])), board)
    wanted = {"board_width_m": board.width_m, "board_height_m": board.height_m}
    return LIDAR_NO_PLATE.refusal(**wanted, min_range_m=limits.min_range_m, max_range_m=limits.max_range_m)


def other_plate(size_m: Array, distance_m: float, board: Board) -> Refusal:
    """Refuse a plate of another size (2,)."""
    wanted = {"board_width_m": board.width_m, "board_height_m": board.height_m}
    width_m, height_m = size_m.tolist()
    return LIDAR_OTHER_PLATE.refusal(width_m=width_m, height_m=height_m, distance_m=distance_m, **wanted)


MAX_CANDIDATES = 4
# Fraction of returns beyond the outline above which, beside a board that nothing touches, a plate is part of
# a wall.
PATCH_SHARE = 0.20
# Incidence above which dark squares may return nothing, and minimum fraction of beams lost there.
GRAZING_RAD = np.radians(35.0)
LOST_SHARE = 0.10


def find_lidar_boards(
    scan: Scan,
    board: Board,
    limits: Limits = STANDARD,
) -> list[LidarBoard] | Refusal:
    """Find the plates of the board's size in a scan, best first.

    Rings are cut into straight segments, segments in one plane grow into plates, the board's outline is
    registered with each plate, and the plates that it fits are measured. All thresholds widen with the noise
    that the scan itself shows.

    Args:
        scan: one revolution, or part of one.
        board: board, which defines the outer size.
        limits: limits, not including the scan's noise.

    Returns:
        At most 4 boards that do not overlap, or the refusal.

    References:
        LCE-Calib, "Automatic Feature Extraction From LiDARs": selection and features.
    """
    ordered = order_scan(scan, limits.min_range_m)
    if len(ordered.index) == 0:
        return LIDAR_NO_RETURNS.refusal(n_points=len(scan.points), min_range_m=limits.min_range_m)
    diagonal_m = float(np.hypot(board.width_m, board.height_m))
    segments = cut_segments(ordered, limits.max_range_m, 2.0 * diagonal_m)
    plates, ends = propose_plates(ordered, segments, board)
    limits = limits.widened(ordered.sigma_m)
    boards: list[LidarBoard] = []
    misses: list[Refusal] = []
    max_beyond = np.inf
    for on_stand in (False, True):
        for start in screen_plates(plates, ends, board, limits.template_m, on_stand=on_stand):
            measured = measure_plate(ordered, scan, board, start, limits, max_beyond)
            if isinstance(measured, Refusal):
                misses.append(measured)
            elif measured is not None:
                boards.append(measured)
                if measured.quality.beyond_share < TOUCHING_SHARE:
                    max_beyond = PATCH_SHARE
        if boards:
            break
    if boards:
        return distinct_boards(boards, board)
    return misses[0] if misses else no_plate(ordered, board, limits)


def measure_plate(
    ordered: OrderedScan,
    scan: Scan,
    board: Board,
    start: tuple[Array, Array, Placement],
    limits: Limits,
    max_beyond: float = np.inf,
) -> LidarBoard | Refusal | None:
    """Register the board's outline from a first guess, measure the board and check it against the limits.

    Args:
        ordered: the returns of the scan.
        scan: their scan.
        board: nominal size.
        start: first guess of the plane (4,) as (n, d), its point (3,) in m that is the outline's origin, and
            the outline.
        limits: limits, including the scan's noise.
        max_beyond: largest share of returns in the plane beyond the guessed outline.

    Returns:
        The board, the refusal of a plate, or None without a plate.
    """
    refined = refine(ordered, *start, limits.template_m, max_beyond)
    if refined is None:
        return None
    view, placement = refined
    if placement.error_m > STANDARD.template_m:
        view, placement = _past_dark_squares(ordered, board, start, limits, max_beyond) or refined
    if placement.error_m > limits.template_m:
        # Beams at a hidden border only show that the plate reaches that far.
        view, placement = (
            refine(ordered, *start, limits.template_m, max_beyond, may_be_hidden=True) or refined
        )
    if placement.error_m > limits.template_m:
        return outline_misfit(view, placement, limits.template_m, limits.rms_m)
    measured = build_board(ordered, scan, board, view, placement, limits.beam)
    if measured is None:
        return None
    n_rings, distance_m = measured.quality.n_rings, measured.quality.distance_m
    if n_rings < limits.min_rings:
        # The number of rings is proportional to 1 / distance.
        closer_m = max(0.1, distance_m * (1.0 - n_rings / limits.min_rings))
        return LIDAR_TOO_FEW_RINGS.refusal(
            n_rings=n_rings, min_rings=limits.min_rings, distance_m=distance_m, closer_m=closer_m
        )
    if measured.sigma_m > limits.rms_m:
        heights_m = measured.points @ measured.plane[:3] + measured.plane[3]
        return too_thick(heights_m, limits.rms_m)
    return measured


def _past_dark_squares(
    scan: OrderedScan,
    board: Board,
    start: tuple[Array, Array, Placement],
    limits: Limits,
    max_beyond: float,
) -> tuple[PlaneView, Placement] | None:
    """Register the outline of a board whose dark squares, at grazing incidence, return nothing or too far.

    Such beams do not locate the outline; the others must fit it as if there were no noise. Of boards at 42 to
    66 deg before a VLP-16 and a VLP-32C, 12 to 41 % of the beams are lost; of walls and tables at most 9 %.

    Args:
        scan: all returns.
        board, start, limits, max_beyond: see `measure_plate`.

    Returns:
        See `refine`; None if the beams do not graze the plate, too few are lost, or the outline does not fit.
    """
    plane, centre, _ = start
    if plane[3] > np.cos(GRAZING_RAD) * np.linalg.norm(centre):
        return None
    dark_m = np.sqrt(2.0) * board.square_m
    refined = refine(scan, *start, limits.template_m, max_beyond, dark_m)
    if refined is None or refined[1].error_m > STANDARD.template_m:
        return None
    return refined if lost_share(scan, *refined) > LOST_SHARE else None


def distinct_boards(found: list[LidarBoard], board: Board) -> list[LidarBoard]:
    """Rank the candidates and drop those that overlap a better one."""
    distinct: list[LidarBoard] = []
    for candidate in sorted(found, key=lambda c: _penalty(c, board)):
        centre = candidate.T_lidar_board[:3, 3]
        away = [float(np.linalg.norm(centre - other.T_lidar_board[:3, 3])) for other in distinct]
        if all(a > min(board.width_m, board.height_m) / 2 for a in away):
            distinct.append(candidate)
    return distinct[:MAX_CANDIDATES]


def _penalty(found: LidarBoard, board: Board) -> float:
    """Score a candidate in m: residuals of outline and size, unobserved parts, other returns in its plane."""
    q = found.quality
    penalty = q.template_m + 0.03 / max(q.n_rings, 1) + 0.15 * (q.width_sigma_m + q.height_sigma_m)
    penalty += 0.05 * q.beyond_share
    for measured_m, sigma_m, wanted_m in (
        (q.width_m, q.width_sigma_m, board.width_m),
        (q.height_m, q.height_sigma_m, board.height_m),
    ):
        penalty += 0.5 * max(0.0, abs(measured_m - wanted_m) - 2 * sigma_m - 0.005)
    return penalty


MARGIN_M = 0.25  # margin of the searched box around the board, on every side


def look_for_board(
    scan: Scan,
    board: Board,
    T_lidar_board: Array,
    limits: Limits = STANDARD,
) -> LidarBoard | Refusal:
    """Find the board near a pose predicted from an image and extrinsics, or from an earlier scan.

    The outline is registered from that pose; where this fails, the box about it is searched.

    Args:
        scan: one revolution.
        board: board, which defines the outer size.
        T_lidar_board: (4, 4) predicted.
        limits: limits, not including the scan's noise; their maximum range is not used.

    Returns:
        The board, or the refusal.

    References:
        LCE-Calib, "Checkerboard Tracking".
    """
    at_once = _measure_at(scan, board, T_lidar_board, limits)
    if isinstance(at_once, LidarBoard) and _is_at(at_once, T_lidar_board):
        return at_once
    half = np.array([board.width_m / 2, board.height_m / 2, 0.0]) + MARGIN_M
    rotation, centre = T_lidar_board[:3, :3].astype(np.float32), T_lidar_board[:3, 3].astype(np.float32)
    # Test a sphere first: it is cheaper, and few returns pass.
    away = np.ascontiguousarray(scan.points.T) - centre[:, None]
    with np.errstate(invalid="ignore", over="ignore"):
        near = np.flatnonzero((away * away).sum(axis=0) < float(half @ half))
    nearby = scan.select(near[(np.abs(away[:, near].T @ rotation) <= half).all(axis=1)])
    found = find_lidar_boards(nearby, board, replace(limits, max_range_m=np.inf))
    return board_at(found, T_lidar_board, at_once if isinstance(at_once, Refusal) else None)


def board_at(
    found: list[LidarBoard] | Refusal, T_lidar_board: Array, cause: Refusal | None = None
) -> LidarBoard | Refusal:
    """Choose the board at a pose (4, 4), or refuse with the given reason or the search's."""
    if isinstance(found, Refusal):
        cause = cause or found
        return LIDAR_NOT_WHERE_EXPECTED.refusal(**cause.figures, cause=cause.code)
    distance_m = float(np.linalg.norm(T_lidar_board[:3, 3]))
    nothing = LIDAR_NOTHING_WHERE_EXPECTED.refusal(distance_m=distance_m)
    return next((candidate for candidate in found if _is_at(candidate, T_lidar_board)), nothing)


def _measure_at(
    scan: Scan, board: Board, T_lidar_board: Array, limits: Limits
) -> LidarBoard | Refusal | None:
    """Register and measure the outline from a pose, like `measure_plate`."""
    ordered = order_scan(scan, limits.min_range_m)
    if len(ordered.index) == 0:
        return LIDAR_NO_RETURNS.refusal(n_points=len(scan.points), min_range_m=limits.min_range_m)
    normal, centre = T_lidar_board[:3, 2], T_lidar_board[:3, 3]
    plane = np.append(normal, -normal @ centre) * (-1.0 if normal @ centre > 0 else 1.0)
    width_axis = plane_axes(plane[:3]).T @ T_lidar_board[:3, 0]
    half_m = (board.width_m / 2, board.height_m / 2)
    outline = Placement(0.0, 0.0, float(np.arctan2(width_axis[1], width_axis[0])), half_m)
    return measure_plate(ordered, scan, board, (plane, centre, outline), limits.widened(ordered.sigma_m))


def _is_at(found: LidarBoard, T_lidar_board: Array) -> bool:
    """Check whether a board is within MARGIN_M and 15 deg of a pose."""
    away_m = float(np.linalg.norm(found.T_lidar_board[:3, 3] - T_lidar_board[:3, 3]))
    return away_m < MARGIN_M and abs(float(found.plane[:3] @ T_lidar_board[:3, 2])) > np.cos(np.radians(15.0))
