"""The effect of the extrinsics' uncertainty on a point measured by the LiDAR, in pixels and centimetres.

A point p = R q + t in the camera frame moves with the extrinsics by [I, -(p - t)^] times their tangent, as a
rotation moves it about the LiDAR's origin.
"""

from collections.abc import Sequence

import numpy as np

from lce_rig.core.calibration import PointUncertainty
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, skew

DISTANCES_M = (5.0, 10.0, 20.0)
# Beyond some radius the distortion is undefined; corners are moved to that radius.
_INWARDS = np.linspace(0.0, 1.0, 41)[:-1]
_STEP_M = 1e-4


def point_uncertainties(
    T_cam_lidar: Array, cov: Array, lens: Intrinsics, distances_m: Sequence[float] = DISTANCES_M
) -> tuple[PointUncertainty, ...]:
    """Propagate a covariance to points in the middle and in the corners of the image.

    Args:
        T_cam_lidar: (4, 4).
        cov: (6, 6) tangent (translation m, rotation rad).
        lens: of the camera.
        distances_m: of the points.

    Returns:
        One for each distance, with the worst of the four corners.
    """
    middle = [(lens.width_px - 1) / 2, (lens.height_px - 1) / 2]
    rays = lens.unproject(np.concatenate([[middle], outermost_pixels(lens)]))
    found = []
    for distance_m in distances_m:
        sigmas = [_sigmas(distance_m * ray, T_cam_lidar[:3, 3], cov, lens) for ray in rays]
        corner_px, corner_m = np.max(sigmas[1:], axis=0)
        found.append(PointUncertainty(distance_m, *sigmas[0], float(corner_px), float(corner_m)))
    return tuple(found)


def outermost_pixels(lens: Intrinsics) -> Array:
    """Find the image's corners (4, 2), or where the lens ends on the way to them from the middle."""
    w, h = lens.width_px - 1.0, lens.height_px - 1.0
    middle = np.array([w / 2, h / 2])
    corners = []
    for corner in np.array([[0, 0], [w, 0], [0, h], [w, h]]):
        on_the_way = corner + _INWARDS[:, None] * (middle - corner)
        is_drawn = np.isfinite(lens.unproject(on_the_way)).all(axis=1)
        corners.append(on_the_way[int(np.argmax(is_drawn))])
    return np.array(corners)


def _sigmas(point: Array, t: Array, cov: Array, lens: Intrinsics) -> tuple[float, float]:
    """Compute the expected size of a point's error in the image, px, and in space, m."""
    by_tangent = np.concatenate([np.eye(3), -skew(point - t)], axis=1)
    cov_point = by_tangent @ cov @ by_tangent.T
    steps = _STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
    pixels, _ = lens.project(point + steps)
    by_point = (pixels[:3] - pixels[3:]).T / (2 * _STEP_M)
    cov_px = by_point @ cov_point @ by_point.T
    return float(np.sqrt(np.trace(cov_px))), float(np.sqrt(np.trace(cov_point)))
