"""Thresholds of a profile; each has a default."""

from typing import Annotated

from pydantic import Field

from lce_rig.core.geometry import PoseDifference
from lce_rig.rig.settings import NotNegative, Positive, Settings

Fraction = Annotated[float, Field(ge=0, le=1)]


class QualitySettings(Settings):
    """Limits for using a capture and for passing a result.

    Attributes:
        min_square_px: least side of a square in the image; below it, corners blur into each other.
        min_border_px: least distance of a corner from the image's border.
        max_tilt_deg: largest angle between the board's normal and the line of sight.
        max_reprojection_px: largest rms corner residual.
        min_rings: least number of LiDAR rings on the board.
        min_points: least number of LiDAR points on the board.
        max_thickness_m: largest rms of the board's points about their plane, without the scan's noise.
        max_size_error: largest deviation of the board's size in the LiDAR from the profile, as a fraction.
        max_edge_rms_m: largest rms distance of ring ends from the board's edges.
        min_distance_m: nearest board.
        max_distance_m: farthest board.
        max_motion_m: largest motion of a board that counts as still.
        min_events_px: fewest events on the board in 1 s, per pixel.
        min_event_contrast: least difference of black and white in an image reconstructed from events, grey
            values.
        min_event_sharpness: fewest edge widths per square of such an image.
        max_board_speed_mps: fastest board that events may show.
        max_turn_deg_s: fastest rotation of such a board.
        max_smear_m: largest motion of such a board during its scan.
        min_captures: minimum number of captures for a calibration.
        min_detected_fraction: a smaller fraction of captures with the board found is marginal.
        max_mpe_m: largest mean distance of LiDAR points from the camera's board plane.
        max_mee_m: largest mean distance of ring ends from the board's edges.
    """

    min_square_px: Positive = 3.0
    min_border_px: NotNegative = 1.0
    max_tilt_deg: Annotated[float, Field(gt=0, lt=90)] = 70.0
    max_reprojection_px: Positive = 1.0
    min_rings: Annotated[int, Field(ge=2, le=128)] = 4
    min_points: Annotated[int, Field(ge=6, le=1_000_000)] = 40
    max_thickness_m: Positive = 0.012
    max_size_error: Fraction = 0.15
    max_edge_rms_m: Positive = 0.06
    min_distance_m: NotNegative = 0.8
    max_distance_m: Positive = 6.0
    max_motion_m: Positive = 0.01
    min_events_px: NotNegative = 1.0
    min_event_contrast: NotNegative = 20.0
    min_event_sharpness: NotNegative = 1.5
    max_board_speed_mps: Positive = 0.5
    max_turn_deg_s: Positive = 60.0
    max_smear_m: Positive = 0.01
    min_captures: Annotated[int, Field(ge=3, le=10_000)] = 6
    min_detected_fraction: Fraction = 0.5
    max_mpe_m: Positive = 0.03
    max_mee_m: Positive = 0.04


class CalibrationSettings(Settings):
    """Target standard deviations.

    Attributes:
        target_sigma_deg: standard deviation of the rotation to reach; above it a result is marginal.
        target_sigma_m: standard deviation of the translation to reach; above it a result is marginal.
    """

    target_sigma_deg: Positive = 0.2
    target_sigma_m: Positive = 0.01

    def in_targets(self, rotation_deg: float, translation_m: float) -> float:
        """Measure an error or a difference in units of the targets; the larger of the two counts."""
        return max(rotation_deg / self.target_sigma_deg, translation_m / self.target_sigma_m)

    def excess(self, difference: PoseDifference) -> float:
        """Measure a difference of two poses in units of the targets; 0 where chance explains it."""
        return self.in_targets(**difference.sizes) if difference.is_significant else 0.0
