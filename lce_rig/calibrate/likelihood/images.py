"""Residuals of board poses in images from T_cam_lidar T_lidar_board.

Corners enter by their fitted pose and its covariance, which hold their information to first order. Besides
their noise, an image's pose has errors that its corners share: the lens model's misfit in that part of the
image, the pattern, the board's bend, its motion. The covariance of these errors is

    Q = sigma_tilt^2 about axes in the board's plane, sigma_spin^2 about its normal,
        sigma_depth^2 along the line of sight, sigma_across^2 across it                                   (1)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate.likelihood.layout import IMAGE, Indices
from lce_rig.calibrate.likelihood.levels import OF_IMAGES, Levels
from lce_rig.core.geometry import Array, difference, skew
from lce_rig.core.results import ImageBoard


@dataclass(frozen=True, eq=False)
class StackedImages:
    """One camera's board poses in P captures.

    Attributes:
        capture: (P,) which of the stacked captures.
        T_cam_board: (P, 4, 4).
        cov: (P, 6, 6) of the corners' noise, tangent of T_cam_board.
        shapes: (P, 6, 6) each, derivative of Q by the square of each of the levels `OF_IMAGES`.
    """

    capture: Indices
    T_cam_board: Array
    cov: Array
    shapes: Mapping[str, Array]

    def total_cov(self, levels: Levels) -> Array:
        """Add Q to the corners' covariance: (P, 6, 6)."""
        Q = np.zeros_like(self.cov)
        for name, shape in self.shapes.items():
            Q += getattr(levels, name) ** 2 * shape
        return self.cov + Q

    def with_larger_errors(self, ratios: Mapping[str, float]) -> "StackedImages":
        """Scale the images' errors beyond corner noise relative to the levels."""
        shapes = {name: ratios[name] ** 2 * shape for name, shape in self.shapes.items()}
        return replace(self, shapes=shapes)


def stack_images(capture: Indices, images: Sequence[ImageBoard]) -> StackedImages:
    """Stack the images of one camera.

    Args:
        capture: (P,) which of the stacked captures they belong to.
        images: P of them.
    """
    T = np.array([image.T_cam_board for image in images])
    cov = np.array([image.cov for image in images])
    shapes = {name: np.zeros((len(T), 6, 6)) for name in OF_IMAGES}
    normal, sight = T[:, :3, 2], T[:, :3, 3] / np.linalg.norm(T[:, :3, 3], axis=1, keepdims=True)
    about, along = (v[:, :, None] * v[:, None, :] for v in (normal, sight))
    shapes["tilt_rad"][:, 3:, 3:], shapes["spin_rad"][:, 3:, 3:] = np.eye(3) - about, about
    shapes["depth_m"][:, :3, :3], shapes["across_m"][:, :3, :3] = along, np.eye(3) - along
    return StackedImages(capture, T, cov, shapes)


def image_rows(images: StackedImages, T_cam_lidar: Array, T_lidar_board: Array, scale: float) -> Array:
    """Linearise the tangent from T_cam_board to T_cam_lidar T_lidar_board.

    Returns:
        (P, 6, 14) in columns of `IMAGE`. A scale s stretches what the camera measures to t_cam_board (1 + s):
        squares or a focal length that the profile has wrong.
    """
    Y = T_lidar_board[images.capture]
    R = T_cam_lidar[:3, :3]
    rows = np.zeros((len(Y), 6, IMAGE.size))
    by_camera, by_scale = (rows[:, :, IMAGE[name]] for name in ("camera", "scale"))
    by_camera[:] = np.eye(6)
    by_camera[:, :3, 3:] = -skew(Y[:, :3, 3] @ R.T)
    rows[:, :, IMAGE["pose"]] = np.kron(np.eye(2), R)
    by_scale[:, :3, 0] = -images.T_cam_board[:, :3, 3]
    rows[:, :, -1] = difference(T_cam_lidar @ Y, images.T_cam_board) + scale * by_scale[..., 0]
    return rows
