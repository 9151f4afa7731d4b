"""Colours of a scan's points from the image, without points that are hidden from the camera."""

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array, transform

# Minimum size of the cells in which the views of camera and LiDAR are compared.
_SMALLEST_CELL_PX = 4.0


def colour_points(
    scan: Scan, pixels: NDArray[np.uint8], T_cam_lidar: Array, lens: Intrinsics
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Assign each point of a scan the colour of its nearest pixel.

    Args:
        scan: scan of N points; those that are not finite get no colour.
        pixels: (H, W) grey or (H, W, 3) BGR, of the camera's resolution.
        T_cam_lidar: (4, 4).
        lens: intrinsics of the camera.

    Returns:
        RGB (N, 3), black where the camera does not see the point, and whether it does (N,): in the image,
        with nothing before it.
    """
    points_camera = transform(T_cam_lidar, np.asarray(scan.points, np.float64))
    at, _ = lens.project(points_camera)
    is_seen = lens.is_inside(at)
    # The angle between neighbouring rings: the median step of their elevations.
    points = np.asarray(scan.points, np.float64)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    rings = [np.nanmedian(elevation[scan.ring == ring]) for ring in np.unique(scan.ring)]
    step_rad = float(np.median(np.diff(np.sort(rings)))) if len(rings) > 1 else 0.0
    cell_px = max(_SMALLEST_CELL_PX, step_rad * lens.fx_px)
    baseline_m = float(np.linalg.norm(T_cam_lidar[:3, 3]))
    is_seen[is_seen] = ~_is_hidden(at[is_seen], points_camera[is_seen, 2], cell_px, baseline_m * lens.fx_px)
    column, row = np.round(at[is_seen]).astype(int).T
    colours = np.zeros((len(at), 3), np.uint8)
    seen = pixels[row, column]
    colours[is_seen] = seen[:, ::-1] if pixels.ndim == 3 else seen[:, None]
    return colours, is_seen


def _is_hidden(at: Array, depth_m: Array, cell_px: float, baseline_m_px: float) -> NDArray[np.bool_]:
    """Find the points that a nearer surface hides from the camera, but not from the LiDAR.

    In a cell of the image as large as the gap between rings, the point at depth d shifts against the nearest
    one, at d0, by baseline * f * (1 / d0 - 1 / d) between the views of camera and LiDAR. Below half a cell
    both sensors see both.
    """
    cells = np.floor(at / cell_px).astype(int)
    _, place = np.unique(cells, axis=0, return_inverse=True)
    inverse = 1 / np.maximum(depth_m, 1e-3)
    nearest = np.zeros(int(place.max(initial=-1)) + 1)
    np.maximum.at(nearest, place.ravel(), inverse)
    return np.asarray(baseline_m_px * (nearest[place.ravel()] - inverse) > cell_px / 2)
