"""Say why no board was found in a scan: the nearest miss, with its figure and what to do."""

from dataclasses import replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard, Refusal
from lce_rig.detect.lidar_plates import propose_plates, screen_plates
from lce_rig.detect.lidar_segments import OrderedScan, cut_segments
from lce_rig.detect.lidar_template import Placement, PlaneView, beams_about, view_plane

# Share of returns beyond the outline, in the board's plane, from which something touches the board.
TOUCHING_SHARE = 0.10
SCATTER_M = 0.02  # by how much more than the LiDAR's noise a moving board's returns may scatter to be named
MAX_SIZE_MISFIT = (
    0.75  # sum of |log| of the ratios of long and short side up to which a plate is worth naming
)
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
    distance = placement.distance_m(view.uv)
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
    scan: OrderedScan, board: Board, limit_m: float, min_range_m: float, max_range_m: float
) -> Refusal:
    """Refuse a scan in which no plate is the board, naming what comes nearest to it.

    The search is repeated for plates of any size and of returns that scatter more than the LiDAR's do.

    Args:
        scan: all returns.
        board: what was looked for.
        limit_m: largest error of an outline.
        min_range_m: from where it was looked for.
        max_range_m: up to where.
    """
    coarse = replace(scan, sigma_m=scan.sigma_m + SCATTER_M)
    plates, ends = propose_plates(coarse, cut_segments(coarse, max_range_m), board, is_any_size=True)
    for plane, centre, placement in screen_plates(plates, ends, board, limit_m):
        radius_m = float(np.hypot(*placement.half_m))
        view = view_plane(scan, beams_about(scan, centre, radius_m), plane, centre, radius_m, LAYER_M)
        distance = placement.distance_m(view.uv)
        heights_m = view.height_m[(distance < -0.03) & view.is_on]
        if len(heights_m) > 0.8 * (distance < -0.03).sum() and np.std(heights_m) > 2.0 * scan.sigma_m + 0.008:
            return too_thick(heights_m, 2.0 * scan.sigma_m + 0.008)
    board_m = np.array([max(board.width_m, board.height_m), min(board.width_m, board.height_m)])
    wanted = f"{board.width_m:.2f} x {board.height_m:.2f} m"
    misfit = np.abs(np.log(np.maximum(plates.size_m, 1e-2) / board_m)).sum(axis=1)
    misfit[plates.n_rings < 3] += 1.0
    if len(misfit) and misfit.min() < MAX_SIZE_MISFIT:
        best = int(np.argmin(misfit))
        return Refusal(
            "lidar",
            f"the plate nearest to the board's size is {plates.size_m[best, 0]:.2f} x "
            f"{plates.size_m[best, 1]:.2f} m, at {np.linalg.norm(plates.centre[best]):.1f} m; "
            f"the board is {wanted}",
            "check width_m and height_m of the board in the rig profile, or show the whole board",
        )
    return Refusal(
        "lidar",
        f"no plate of the board's size ({wanted}) between {min_range_m:g} and {max_range_m:g} m",
        "hold the board 1.5 to 3 m from the LiDAR, in sight, with nothing at its edges",
    )
