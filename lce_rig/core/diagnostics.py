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
    n_alternative_poses: float = _NONE  # captures in which the consensus took the image's other pose
    paper_mee_m: float = _NONE  # mean distance of ring ends as the paper's code counts it
    held_out_m: float = _NONE  # mean over captures of their rms residual where they were not fitted
    # Of Algorithm 1's residuals, in units of 1 / (10 mm)^2; and rms of these residuals over captures.
    plane_weight: float = _NONE
    edge_weight: float = _NONE
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
    algorithm_1_offset_deg: float = _NONE  # how far the joint estimate lies from Algorithm 1's
    algorithm_1_offset_m: float = _NONE
    covariance_inflation: float = _NONE  # of the joint estimate's covariance, from leave-one-out results
    range_offset_m: float = _NONE  # mean over lasers of their range errors
    laser_spread_m: float = _NONE  # standard deviation of these
    lens_lateral_m: float = _NONE  # displacement of the LiDAR's lens
    lens_vertical_m_per_rad: float = _NONE
    camera_scale: float = _NONE  # of the camera's distances
    bow_width_m: float = _NONE  # height of the plate's middle over its ends, along its width
    bow_height_m: float = _NONE  # and along its height
    noise_range_m: float = _NONE  # of ranges
    noise_ring_m: float = _NONE  # of a ring in one capture
    noise_ring_end_mrad: float = _NONE  # of ring ends, along azimuth
    ring_ends_lost: float = _NONE  # share 0..1
    noise_edge_shift_m: float = _NONE  # of the edge shift from one capture to the next
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
