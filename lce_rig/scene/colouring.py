"""Colours of a scan's points from the camera's image, without points that something nearer hides."""

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, transform

# A scan is sparse: points within one part in so many of the image's width hide each other.
_CELLS = 160
# A surface seen at a grazing angle does not hide itself.
_DEEPER_M, _DEEPER_SHARE = 0.2, 0.05


def colour_points(
    points_lidar: NDArray[np.floating], pixels: NDArray[np.uint8], T_cam_lidar: Array, lens: Intrinsics
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Give each point the colour of its nearest pixel.

    Args:
        points_lidar: (N, 3) m, frame lidar.
        pixels: (H, W) grey or (H, W, 3) BGR, of the camera's resolution.
        T_cam_lidar: (4, 4).
        lens: of the camera.

    Returns:
        RGB (N, 3), black where the camera does not see the point, and whether it does (N,): in the image,
        with nothing nearer before it.
    """
    points_camera = transform(T_cam_lidar, np.asarray(points_lidar, np.float64))
    at, _ = lens.project(points_camera)
    is_seen = lens.is_inside(at)
    depth_m = np.linalg.norm(points_camera, axis=1)
    is_seen[is_seen] = ~_is_hidden(at[is_seen], depth_m[is_seen], lens)
    column, row = np.round(at[is_seen]).astype(int).T
    colours = np.zeros((len(at), 3), np.uint8)
    seen = pixels[row, column]
    colours[is_seen] = seen[:, ::-1] if pixels.ndim == 3 else seen[:, None]
    return colours, is_seen


def _is_hidden(at: Array, depth_m: Array, lens: Intrinsics) -> NDArray[np.bool_]:
    """Compare each point's depth with the nearest one in its cell of the image and the cells around."""
    cell_px = max(lens.width_px / _CELLS, 1.0)
    column, row = np.floor((at + 0.5) / cell_px).astype(int).T
    nearest_m = np.full((row.max(initial=0) + 1, column.max(initial=0) + 1), 1e9, np.float32)
    np.minimum.at(nearest_m, (row, column), depth_m.astype(np.float32))
    around_m = cv2.erode(nearest_m, np.ones((3, 3), np.uint8))
    return np.asarray(depth_m > (1 + _DEEPER_SHARE) * around_m[row, column] + _DEEPER_M)
