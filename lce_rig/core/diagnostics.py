"""Figures that say how an extrinsic came about, beside its covariance and residuals."""

import math
from dataclasses import asdict, dataclass

_NONE = math.nan


@dataclass(frozen=True)
class Diagnostics:
    """What a method and the checks on its result say; NaN where they say nothing.

    result.json keeps each under its name here.
    """

    n_placements: float = _NONE  # different placements of the board among the captures used
    held_out_m: float = _NONE  # mean over captures of their rms residual where they were not fitted
    # Of Algorithm 1's residuals, rms over captures.
    fit_plane_rms_m: float = _NONE
    fit_edge_rms_m: float = _NONE
    # Parts of the standard deviations: from the scatter between captures, from errors common to all of them.
    sigma_scatter_rotation_deg: float = _NONE
    sigma_scatter_translation_m: float = _NONE
    sigma_systematic_rotation_deg: float = _NONE
    sigma_systematic_translation_m: float = _NONE
    edge_shift_m: float = _NONE  # by how much ring ends lie beyond the board's edges
    edge_shift_sigma_m: float = _NONE
    # Additions to that by the background behind the board.
    edge_shift_echo_m: float = _NONE
    edge_shift_blended_m: float = _NONE
    edge_shift_blended_echo_m: float = _NONE
    covariance_inflation: float = _NONE  # of the joint estimate's covariance, from leave-one-out results
    range_offset_m: float = _NONE  # mean over lasers of their range errors
    laser_spread_m: float = _NONE  # standard deviation of these
    lens_vertical_m_per_rad: float = _NONE  # displacement of the LiDAR's lens
    camera_scale: float = _NONE  # of the camera's distances
    noise_range_m: float = _NONE  # of ranges
    # Of the board's pose by the camera, beyond its corners' noise.
    noise_tilt_deg: float = _NONE
    noise_spin_deg: float = _NONE
    noise_depth_m: float = _NONE
    noise_across_m: float = _NONE
    alone_sigma_rotation_deg: float = _NONE  # standard deviations without the other cameras
    alone_sigma_translation_m: float = _NONE
    channels_rotation_deg: float = _NONE  # between the extrinsics of two channels of the camera
    channels_translation_m: float = _NONE

    def figures(self) -> dict[str, float]:
        """List the figures that are not NaN by name, sorted."""
        return {name: value for name, value in sorted(asdict(self).items()) if not math.isnan(value)}
