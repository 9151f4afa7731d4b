"""What a camera and a LiDAR measure of a board, and how well, as far as guidance must know beforehand."""

from dataclasses import dataclass, field, replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data_sheets import DATA_SHEETS
from lce_rig.core.errors import ProfileError
from lce_rig.core.geometry import Array, transform
from lce_rig.rig import QualitySettings, Rig

#: How many captures' residuals the assumed errors are worth.
PRIOR_CAPTURES = 5
#: Rms distance of a board's points from its middle line: what a tilt moves them by.
BOARD_LEVER_M = 0.2
_POINTS_PER_EDGE = 12


@dataclass(frozen=True)
class ErrorModel:
    """Standard deviations of the measurements.

    Errors of corners, ranges and ring ends average out over the many points of a capture. Errors common to
    all its points do not: an imperfect lens model, a bowed board, an unsteady hand, an arm behind one edge.
    Pose errors are stated as if they were the camera's.

    Attributes:
        corner_px: of a corner, per coordinate.
        range_m: of a range, from shot to shot.
        ring_end_m: of a ring's end across the board's edge, beyond the spacing of its points.
        side_m: of all ring ends on one edge of the plate in one capture, drawn by things behind it.
        tilt_rad: of the board's pose about its three axes, common to a capture.
        depth_m: of the board's place along its normal, common to a capture.
        laser_bias_m: of the lasers' constant range errors about their mean.
        range_offset_m: of that mean.
        plane_m, edge_m: typical residuals of a capture, by which the solver weighs planes against edges.
        edge_shift_m: of the distance by which ring ends lie beyond the plate, a priori.
    """

    corner_px: float = 0.05
    range_m: float = 0.010
    ring_end_m: float = 0.004
    side_m: float = 0.003
    tilt_rad: float = 0.001
    depth_m: float = 0.001
    laser_bias_m: float = 0.008
    range_offset_m: float = 0.005
    plane_m: float = 0.0035
    edge_m: float = 0.005
    edge_shift_m: float = 0.015

    def learned(self, plane_rms_m: float, edge_rms_m: float, n_captures: int) -> "ErrorModel":
        """Adapt to the residuals that captures of this rig left.

        Where planes fit worse than expected, the poses of boards err more; where ring ends do, all their
        errors grow alike. What is assumed here counts like `PRIOR_CAPTURES`.

        Args:
            plane_rms_m, edge_rms_m: of the calibration so far ("fit_plane_rms_m", "fit_edge_rms_m").
            n_captures: behind it.
        """
        share = n_captures / (n_captures + PRIOR_CAPTURES)
        plane_m = float(np.sqrt((1 - share) * self.plane_m**2 + share * plane_rms_m**2))
        edge_m = float(np.sqrt((1 - share) * self.edge_m**2 + share * edge_rms_m**2))
        excess = max(plane_m**2 - self.plane_m**2, 0.0) / 2
        growth = edge_m / self.edge_m
        return replace(
            self,
            ring_end_m=growth * self.ring_end_m,
            side_m=growth * self.side_m,
            tilt_rad=float(np.sqrt(self.tilt_rad**2 + excess / BOARD_LEVER_M**2)),
            depth_m=float(np.sqrt(self.depth_m**2 + excess)),
            plane_m=plane_m,
            edge_m=edge_m,
        )


@dataclass(frozen=True, eq=False)
class SensorModel:
    """A camera and a LiDAR that look at one board.

    Attributes:
        board: the board.
        lens: the camera.
        elevations_rad: (L,) of the LiDAR's rings, from the lowest.
        azimuth_step_rad: angle between neighbouring firings of one ring.
        limits: the profile's, on what a capture must show.
        target_sigma_rad, target_sigma_m: how well the extrinsic is to be known.
        errors: how both measure.
    """

    board: Board
    lens: Intrinsics
    elevations_rad: Array
    azimuth_step_rad: float
    limits: QualitySettings
    target_sigma_rad: float
    target_sigma_m: float
    errors: ErrorModel = field(default_factory=ErrorModel)


def model_sensors(rig: Rig, camera: str, lidar: str) -> SensorModel:
    """Build the model of a pair of sensors from a profile.

    Raises:
        ProfileError: the beams of the LiDAR's model are not known.
    """
    settings = rig.lidars[lidar]
    sheet = settings.data_sheet()
    if sheet is None:
        names = ", ".join(sheet.name for sheet in DATA_SHEETS)
        raise ProfileError(
            f"lidars.{lidar}.model: no guidance for {settings.model}, its beams are not known",
            f"set elevations_deg, collect without guidance, or use one of {names}",
        )
    return SensorModel(
        board=rig.board.to_board(),
        lens=rig.cameras[camera].to_intrinsics(),
        elevations_rad=sheet.rings_rad,
        azimuth_step_rad=sheet.step_rad(settings.rate_hz),
        limits=rig.quality,
        target_sigma_rad=float(np.radians(rig.calibration.target_sigma_deg)),
        target_sigma_m=rig.calibration.target_sigma_m,
        errors=ErrorModel(
            range_m=sheet.range_sigma_m,
            laser_bias_m=settings.laser_bias_sigma_m,
            range_offset_m=settings.range_offset_sigma_m,
        ),
    )


def outline_px(model: SensorModel, T_cam_board: Array) -> Array:
    """Project the plate's border at T_cam_board (4, 4) as a closed polygon; distortion bends its edges.

    Returns:
        (N, 2) px, the last point the first; NaN where a point is outside the lens's field of view.
    """
    corners = model.board.outline()
    share = np.arange(_POINTS_PER_EDGE)[:, None] / _POINTS_PER_EDGE
    edges = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    border = np.concatenate([*edges, corners[:1]])
    pixels, _ = model.lens.project(transform(T_cam_board, border))
    return pixels
