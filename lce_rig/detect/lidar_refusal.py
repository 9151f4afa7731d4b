"""Say why no board was found in a scan: the nearest miss, with its figure and what to do."""

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard, Refusal
from lce_rig.detect.lidar_plates import propose_plates
from lce_rig.detect.lidar_segments import OrderedScan, Segments
from lce_rig.detect.lidar_template import Placement, PlaneView, signed_distance

# Share of returns beyond the outline, in the board's plane, from which something touches the board.
TOUCHING_SHARE = 0.10
LAYER_M = 0.06  # half the depth in which returns may belong to one warped or moving sheet


def no_returns(n_points: int, min_range_m: float) -> Refusal:
    """Refuse a scan without usable returns."""
    return Refusal(
        "lidar",
        f"{n_points} points, none of them finite and farther than {min_range_m:g} m",
        "check the LiDAR's cable, topic and driver settings",
    )


def too_few_rings(found: LidarBoard, min_rings: int) -> Refusal:
    """Refuse a board on which too few rings lie; their number goes with 1 / distance."""
    n_rings, distance_m = found.quality["n_rings"], found.quality["distance_m"]
    closer_m = max(0.1, distance_m * (1.0 - n_rings / min_rings))
    return Refusal(
        "lidar",
        f"{n_rings:.0f} rings on the board at {distance_m:.1f} m ({min_rings} needed)",
        f"come {closer_m:.1f} m closer",
    )


def too_thick(heights_m: Array, limit_m: float) -> Refusal:
    """Refuse a board whose returns scatter about its plane by more than the LiDAR's noise explains.

    Args:
        heights_m: (N,) of the returns over the plane.
        limit_m: largest rms of them.
    """
    low_m, high_m = np.percentile(heights_m, [2.5, 97.5])
    return Refusal(
        "lidar",
        f"surface {100 * (high_m - low_m):.0f} cm thick, rms {1000 * np.sqrt(np.mean(heights_m**2)):.0f} mm "
        f"({1000 * limit_m:.0f} allowed): the board moved during the sweep or is not flat",
        "hold the board still, or put it on a stand",
    )


def outline_misfit(view: PlaneView, placement: Placement, limit_m: float, rms_limit_m: float) -> Refusal:
    """Refuse a plate whose outline is not the board's: it is warped, something touches it, parts are hidden.

    Args:
        view: beams about the plate.
        placement: where the outline fits best.
        limit_m: largest error of an outline.
        rms_limit_m: largest rms distance of the returns from the plane.
    """
    distance, _ = signed_distance(placement.local(view.uv), placement.half_m)
    n_on = max(1, int((view.is_on & (distance <= 0)).sum()))
    beyond = int((view.is_on & (distance > 0.03)).sum()) / n_on
    heights_m = view.height_m[(distance < -0.03) & (np.abs(view.height_m) < LAYER_M)]
    is_one_sheet = len(heights_m) > 0.8 * max(1, int((distance < -0.03).sum()))
    if is_one_sheet and np.sqrt(np.mean(heights_m**2)) > rms_limit_m:
        return too_thick(heights_m, rms_limit_m)
    where = f"at {np.linalg.norm(view.origin):.1f} m"
    if beyond > TOUCHING_SHARE:
        return Refusal(
            "lidar",
            f"the board {where} touches another surface: {100 * beyond:.0f} % more returns lie in its plane",
            "keep walls, tables and hands 0.2 m away from the board's edges and plane",
        )
    hidden = float(np.mean(~view.is_on[distance <= -0.03])) if np.any(distance <= -0.03) else 0.0
    return Refusal(
        "lidar",
        f"the outline of the plate {where} is off by {1000 * placement.error_m:.0f} mm "
        f"({1000 * limit_m:.0f} allowed), {100 * hidden:.0f} % of the board hidden",
        "show the whole board, with nothing before it and nothing at its edges",
    )


def no_plate(
    scan: OrderedScan, segments: Segments, board: Board, min_range_m: float, max_range_m: float
) -> Refusal:
    """Refuse a scan in which no plate has the board's size, naming the plate that comes nearest to it."""
    board_m = np.array([max(board.width_m, board.height_m), min(board.width_m, board.height_m)])
    plates, _ = propose_plates(scan, segments, board, n_plates=3, is_any_size=True)
    wanted = f"{board.width_m:.2f} x {board.height_m:.2f} m"
    if len(plates.plane):
        misfit = np.abs(np.log(np.maximum(plates.size_m, 1e-2) / board_m)).sum(axis=1)
        misfit[plates.n_rings < 3] += 1.0
        best = int(np.argmin(misfit))
        if misfit[best] < 0.75:
            length_m, width_m = plates.size_m[best]
            return Refusal(
                "lidar",
                f"the plate nearest to the board's size is {length_m:.2f} x {width_m:.2f} m, at "
                f"{np.linalg.norm(plates.centre[best]):.1f} m; the board is {wanted}",
                "check width_m and height_m of the board in the rig profile, or show the whole board",
            )
    return Refusal(
        "lidar",
        f"no plate of the board's size ({wanted}) between {min_range_m:g} and {max_range_m:g} m",
        "hold the board 1.5 to 3 m from the LiDAR, in sight, with nothing at its edges",
    )
