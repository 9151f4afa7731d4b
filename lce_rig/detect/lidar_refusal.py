"""Why no board was found in a scan: the nearest miss, with its figures."""

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
    return Refusal("lidar.no_returns", figures={"n_points": n_points, "min_range_m": min_range_m})


def too_few_rings(found: LidarBoard, min_rings: int) -> Refusal:
    """Refuse a board on which too few rings lie; their number goes with 1 / distance."""
    n_rings, distance_m = found.quality["n_rings"], found.quality["distance_m"]
    closer_m = max(0.1, distance_m * (1.0 - n_rings / min_rings))
    return Refusal(
        "lidar.too_few_rings",
        figures={
            "n_rings": int(n_rings),
            "min_rings": min_rings,
            "distance_m": distance_m,
            "closer_m": closer_m,
        },
    )


def too_thick(heights_m: Array, limit_m: float) -> Refusal:
    """Refuse a board whose returns scatter about its plane by more than the LiDAR's noise explains.

    Args:
        heights_m: (N,) of the returns over the plane.
        limit_m: largest rms of them.
    """
    low_m, high_m = np.percentile(heights_m, [2.5, 97.5])
    return Refusal(
        "lidar.too_thick",
        figures={
            "thickness_m": float(high_m - low_m),
            "rms_m": float(np.sqrt(np.mean(heights_m**2))),
            "max_rms_m": limit_m,
        },
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
    distance_m = float(np.linalg.norm(view.origin))
    if beyond > TOUCHING_SHARE:
        return Refusal("lidar.touching", figures={"distance_m": distance_m, "beyond_share": beyond})
    hidden = float(np.mean(~view.is_on[distance <= -0.03])) if np.any(distance <= -0.03) else 0.0
    return Refusal(
        "lidar.outline",
        figures={
            "distance_m": distance_m,
            "error_m": float(placement.error_m),
            "max_error_m": limit_m,
            "hidden_share": hidden,
        },
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
    wanted = {"board_width_m": board.width_m, "board_height_m": board.height_m}
    misfit = np.abs(np.log(np.maximum(plates.size_m, 1e-2) / board_m)).sum(axis=1)
    misfit[plates.n_rings < 3] += 1.0
    if len(misfit) and misfit.min() < MAX_SIZE_MISFIT:
        best = int(np.argmin(misfit))
        return Refusal(
            "lidar.other_plate",
            figures={
                "width_m": float(plates.size_m[best, 0]),
                "height_m": float(plates.size_m[best, 1]),
                "distance_m": float(np.linalg.norm(plates.centre[best])),
                **wanted,
            },
        )
    return Refusal(
        "lidar.no_plate", figures={**wanted, "min_range_m": min_range_m, "max_range_m": max_range_m}
    )
