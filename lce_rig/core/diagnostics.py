"""Figures that say how an extrinsic came about, beside its covariance and residuals."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

_NONE = math.nan


@dataclass(frozen=True)
class Diagnostics:
    """What a method and the checks on its result say; NaN where they say nothing.

    result.json keeps each under its name here.

    Attributes:
        n_placements: different placements of the board among the captures used.
        n_alternative_poses: captures in which the consensus took the image's other pose.
        paper_mee_m: mean distance of ring ends as the paper's code counts it.
        held_out_m: mean over captures of their rms residual where they were not fitted.
        plane_weight, edge_weight: of Algorithm 1's residuals, in units of 1 / (10 mm)^2.
        fit_plane_rms_m, fit_edge_rms_m: rms over captures of the residuals that Algorithm 1 minimises.
        sigma_scatter_rotation_deg, sigma_scatter_translation_m: the part of the standard deviations that the
            scatter between captures shows.
        sigma_systematic_rotation_deg, sigma_systematic_translation_m: the part that errors common to all
            captures add.
        edge_shift_m, edge_shift_sigma_m: by how much ring ends lie beyond the board's edges.
        edge_shift_echo_m, edge_shift_blended_m, edge_shift_blended_echo_m: additions to that by the
            background behind the board.
        best_subset_size: captures in the subsets of Algorithm 1 that fit held-out captures best.
        n_solved: subsets that were solved.
        certified_share: share 0..1 of them that are proven to be global minima.
        draw_mean_offset_deg, draw_mean_offset_m: how far the mean of the best subsets lies from the result.
        draw_spread_rotation_deg, draw_spread_translation_m: how far these subsets lie from their mean, rms.
        algorithm_1_offset_deg, algorithm_1_offset_m: how far the joint estimate lies from Algorithm 1's.
        covariance_inflation: factor on the joint estimate's covariance, from leave-one-out results.
        range_offset_m, laser_spread_m: mean and standard deviation over lasers of their range errors.
        lens_lateral_m, lens_vertical_m_per_rad: displacement of the LiDAR's lens.
        camera_scale: of the camera's distances.
        bow_width_m, bow_height_m: height of the plate's middle over its ends, along its width and its height.
        noise_range_m: of ranges; noise_ring_m: of a ring in one capture.
        noise_ring_end_mrad: of ring ends, along azimuth.
        ring_ends_lost: share 0..1.
        noise_edge_shift_m: of the edge shift from one capture to the next.
        noise_tilt_deg, noise_spin_deg, noise_depth_m, noise_across_m: of the board's pose by the camera,
            beyond its corners' noise.
        alone_sigma_rotation_deg, alone_sigma_translation_m: standard deviations without the other cameras.
        sigma_widened: factor on the standard deviations, from resampling.
        channels_rotation_deg, channels_translation_m: between the extrinsics of two channels of the camera.
    """

    n_placements: float = _NONE
    n_alternative_poses: float = _NONE
    paper_mee_m: float = _NONE
    held_out_m: float = _NONE
    plane_weight: float = _NONE
    edge_weight: float = _NONE
    fit_plane_rms_m: float = _NONE
    fit_edge_rms_m: float = _NONE
    sigma_scatter_rotation_deg: float = _NONE
    sigma_scatter_translation_m: float = _NONE
    sigma_systematic_rotation_deg: float = _NONE
    sigma_systematic_translation_m: float = _NONE
    edge_shift_m: float = _NONE
    edge_shift_sigma_m: float = _NONE
    edge_shift_echo_m: float = _NONE
    edge_shift_blended_m: float = _NONE
    edge_shift_blended_echo_m: float = _NONE
    best_subset_size: float = _NONE
    n_solved: float = _NONE
    certified_share: float = _NONE
    draw_mean_offset_deg: float = _NONE
    draw_mean_offset_m: float = _NONE
    draw_spread_rotation_deg: float = _NONE
    draw_spread_translation_m: float = _NONE
    algorithm_1_offset_deg: float = _NONE
    algorithm_1_offset_m: float = _NONE
    covariance_inflation: float = _NONE
    range_offset_m: float = _NONE
    laser_spread_m: float = _NONE
    lens_lateral_m: float = _NONE
    lens_vertical_m_per_rad: float = _NONE
    camera_scale: float = _NONE
    bow_width_m: float = _NONE
    bow_height_m: float = _NONE
    noise_range_m: float = _NONE
    noise_ring_m: float = _NONE
    noise_ring_end_mrad: float = _NONE
    ring_ends_lost: float = _NONE
    noise_edge_shift_m: float = _NONE
    noise_tilt_deg: float = _NONE
    noise_spin_deg: float = _NONE
    noise_depth_m: float = _NONE
    noise_across_m: float = _NONE
    alone_sigma_rotation_deg: float = _NONE
    alone_sigma_translation_m: float = _NONE
    sigma_widened: float = _NONE
    channels_rotation_deg: float = _NONE
    channels_translation_m: float = _NONE

    def figures(self) -> dict[str, float]:
        """List the figures that are not NaN by name, sorted."""
        return {name: value for name, value in sorted(asdict(self).items()) if not math.isnan(value)}

    @classmethod
    def of(cls, figures: Mapping[str, float | None]) -> "Diagnostics":
        """Read figures by name; names that are none of these, of other versions, are ignored."""
        known = {field.name for field in fields(cls)}
        return cls(**{name: value for name, value in figures.items() if name in known and value is not None})


NO_DIAGNOSTICS = Diagnostics()
