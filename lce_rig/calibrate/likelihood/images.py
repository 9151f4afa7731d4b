"""Residuals between board poses in images and T_cam_lidar T_lidar_board.

Corners enter by their fitted pose and its covariance, which hold their information to first order. Besides
their noise, an image's pose has errors that its corners share: the lens model's misfit in that part of the
image, the pattern, the board's bend, its motion. The covariance of these errors is

    Q = sigma_tilt^2 about axes in the board's plane, sigma_spin^2 about its normal,
        sigma_depth^2 along the line of sight, sigma_across^2 across it                                   (1)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.layout import Indices, image_columns
from lce_rig.calibrate.likelihood.levels import OF_IMAGES, Levels
from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.core.geometry import Array, difference, skew
from lce_rig.core.results import BoardPose, ImageBoard


@dataclass(frozen=True, eq=False)
class StackedImages:
    """One camera's board poses in P captures.

    Attributes:
        capture: (P,) index of the stacked capture.
        T_cam_board: (P, 4, 4).
        cov: (P, 6, 6) covariance of the tangent of T_cam_board by corner noise.
        shapes: (P, 6, 6) each, derivative of Q by the square of each of the levels `OF_IMAGES`.
        errors: (P, 6, 3 + n) tangents by which T_cam_board moves per unit of each constant error: squares,
            pattern and the n of the lens, as `layout.BOARD` and optics.
        of_lens: (n, P) errors of the intrinsics per unit of the errors of the lens.
        turns: (3, n) rotations of the camera that project like these.
    """

    capture: Indices
    T_cam_board: Array
    cov: Array
    shapes: Mapping[str, Array]
    errors: Array
    of_lens: Array
    turns: Array

    def total_cov(self, levels: Levels) -> Array:
        """Add Q to the corners' covariance: (P, 6, 6)."""
        Q = np.zeros_like(self.cov)
        for name, shape in self.shapes.items():
            Q += getattr(levels, name) ** 2 * shape
        return self.cov + Q

    def select(self, keep: NDArray[np.bool_]) -> "StackedImages":
        """Keep some images (P,)."""
        shapes = {name: shape[keep] for name, shape in self.shapes.items()}
        of_images = {name: getattr(self, name)[keep] for name in ("capture", "T_cam_board", "cov", "errors")}
        return replace(self, shapes=shapes, **of_images)

    def with_larger_errors(self, ratios: Mapping[str, float]) -> "StackedImages":
        """Scale the images' errors beyond corner noise relative to the levels."""
        shapes = {name: ratios[name] ** 2 * shape for name, shape in self.shapes.items()}
        return replace(self, shapes=shapes)


def stack_images(
    capture: Indices,
    images: Sequence[BoardPose],
    pattern_offset_m: tuple[float, float] = (0.0, 0.0),
    lens: SessionLens | None = None,
) -> StackedImages:
    """Stack the images of one camera.

    Args:
        capture: (P,) index of each one's stacked capture.
        images: P boards in images; or poses by the first of two LiDARs, without a lens.
        pattern_offset_m: standard deviation of the pattern's centre from the plate's.
        lens: lens whose errors are unknowns; None for an exact lens.
    """
    T = np.array([image.T_cam_board for image in images])
    cov = np.array([image.cov for image in images])
    shapes = {name: np.zeros((len(T), 6, 6)) for name in OF_IMAGES}
    R, t, normal = T[:, :3, :3], T[:, :3, 3], T[:, :3, 2]
    sight = t / np.linalg.norm(t, axis=1, keepdims=True)
    about, along = (v[:, :, None] * v[:, None, :] for v in (normal, sight))
    shapes["tilt_rad"][:, 3:, 3:], shapes["spin_rad"][:, 3:, 3:] = np.eye(3) - about, about
    shapes["depth_m"][:, :3, :3], shapes["across_m"][:, :3, :3] = along, np.eye(3) - along
    errors = np.zeros((len(T), 6, 3))
    # Squares that are larger by a fraction move the pattern's centre away by the same fraction.
    errors[:, :3, 0] = t + R @ [*pattern_offset_m, 0.0]
    errors[:, :3, 1:] = -R[:, :, :2]
    of_lens, turns = np.zeros((0, 0)), np.zeros((3, 0))
    if lens is not None:
        moves, of_lens, turns = lens.errors([each for each in images if isinstance(each, ImageBoard)])
        errors = np.concatenate([errors, moves], axis=2)
    return StackedImages(capture, T, cov, shapes, errors, of_lens, turns)


def image_rows(images: StackedImages, T_cam_lidar: Array, T_lidar_board: Array, errors: Array) -> Array:
    """Linearise the tangent from T_cam_board, with constant errors, to T_cam_lidar T_lidar_board.

    Args:
        images: P of one camera.
        T_cam_lidar: (4, 4).
        T_lidar_board: (F, 4, 4).
        errors: (3 + n,) values of the constant errors.

    Returns:
        (P, 6, c) in columns of `image_columns`.
    """
    Y = T_lidar_board[images.capture]
    R = T_cam_lidar[:3, :3]
    columns = image_columns(images.turns.shape[1])
    rows = np.zeros((len(Y), 6, columns.size))
    by_camera = rows[:, :, columns["camera"]]
    by_camera[:] = np.eye(6)
    by_camera[:, :3, 3:] = -skew(Y[:, :3, 3] @ R.T)
    rows[:, :, columns["pose"]] = np.kron(np.eye(2), R)
    rows[:, :, columns.span("squares", "optics")] = -images.errors
    rows[:, :, -1] = difference(T_cam_lidar @ Y, images.T_cam_board) - images.errors @ errors
    return rows
