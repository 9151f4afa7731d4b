"""The joint estimate as a method of calibration: Algorithm 1 gives the start, the likelihood the optimum."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.algorithm_1.algorithm import calibrate_by_algorithm_1
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.features import extract_features
from lce_rig.calibrate.likelihood.along_rays import N_SHIFTS, SHIFTS
from lce_rig.calibrate.likelihood.levels import what_is_known
from lce_rig.calibrate.likelihood.lidar_errors import lidar_of
from lce_rig.calibrate.likelihood.refine import JointEstimate, inflate, moves_under, refine
from lce_rig.calibrate.likelihood.system import PER_CAMERA
from lce_rig.calibrate.metrics import error_to_reference
from lce_rig.calibrate.options import EstimateSettings
from lce_rig.calibrate.placements import group_placements
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.calibrate.report import report_estimate, with_parts
from lce_rig.calibrate.tolerances import Sensitivity, sensitivities_of, vary
from lce_rig.core.board import Board
from lce_rig.core.diagnostics import Diagnostics
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation


def calibrate_by_likelihood(
    observations: Sequence[Observation],
    board: Board,
    options: EstimateSettings,
    progress: Callable[[int, int], None] | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from matched boards.

    Outliers, certificate and held-out residuals are those of Algorithm 1, from whose solution the joint
    estimate starts.

    Args:
        observations: one per capture.
        board: its specification.
        options: switches of Algorithm 1, and priors of the LiDAR's range errors.
        progress: called with (subsets done, subsets in all).

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    # Of the start, the covariance is not used.
    start = calibrate_by_algorithm_1(observations, board, options.without_constant_errors(), progress)
    used = [observation for observation in observations if observation.capture in start.used]
    priors, usual = what_is_known(options)
    joint = refine([used], board, [start.T_cam_lidar], priors, usual)
    placement = group_placements(used)
    cov, inflation = inflate(joint, placement)
    offset_deg, offset_m = error_to_reference(joint.T_cam_lidar[0], start.T_cam_lidar)
    figures = replace(
        add_figures(start.diagnostics, joint, 0, inflation),
        algorithm_1_offset_deg=offset_deg,
        algorithm_1_offset_m=offset_m,
    )
    estimate = describe(joint, 0, cov, start, used, board, options, figures)
    found: tuple[Sensitivity, ...] = ()
    if options.tolerances is not None:
        variants = vary(used, board, options.tolerances)
        moves = moves_under(joint, used, variants, board)
        found = sensitivities_of(variants, moves, options.tolerances)
    return replace(estimate, cost=expand_joint(joint, 0, placement), sensitivities=found)


def describe(
    joint: JointEstimate,
    camera: int,
    cov: Array,
    start: CalibrationEstimate,
    used: Sequence[Observation],
    board: Board,
    options: EstimateSettings,
    figures: Diagnostics,
) -> CalibrationEstimate:
    """Report one camera's extrinsics of a joint estimate.

    Args:
        joint: of one or several cameras.
        camera: its number there.
        cov: (6, 6) of its extrinsics.
        start: Algorithm 1's estimate, or one based on it: certificate, held-out residuals, refusals.
        used: the camera's observations, those that the start used.
        board: the board.
        options: switches of the features.
        figures: diagnostics.
    """
    features = [extract_features(observation, board, options.parts.features) for observation in used]
    estimate = report_estimate(
        joint.T_cam_lidar[camera],
        cov,
        used,
        features,
        board,
        certificate=start.certificate,
        held_out_m=np.array([residual.held_out_m for residual in start.residuals]),
        refused=start.refused,
        diagnostics=figures,
    )
    return replace(estimate, lidar=lidar_of(joint))


def expand_joint(joint: JointEstimate, camera: int, placement: NDArray[np.intp]) -> Quadratics:
    """Expand the cost about a joint estimate, in the extrinsics alone, the camera's own first.

    Constant errors are held fixed.

    Args:
        joint: of F captures.
        camera: its number.
        placement: (F,) number of each capture's placement.
    """
    n_cameras = len(joint.T_cam_lidar)
    order = [camera, *(c for c in range(n_cameras) if c != camera)]
    mine = np.concatenate([np.arange(6) + PER_CAMERA * c for c in order])
    # Subsets of captures that another camera did not see leave its extrinsics undetermined: 1 m, 1 rad.
    prior = np.eye(len(mine)) if n_cameras > 1 else np.zeros((6, 6))
    return replace(joint.cost.of(mine), prior=prior, prior_gradient=np.zeros(len(mine)), placement=placement)


def add_figures(start: Diagnostics, joint: JointEstimate, camera: int, inflation: float) -> Diagnostics:
    """Replace the start's constant errors, noise levels and covariance parts by those of a joint estimate."""
    levels, J = joint.levels, joint.to_extrinsics[camera]
    shifts = dict(zip(SHIFTS, joint.shifts.tolist(), strict=True))
    figures = replace(
        start,
        covariance_inflation=inflation,
        edge_shift_m=shifts["d_0"],
        edge_shift_sigma_m=float(joint.constants_sigma[-N_SHIFTS]),
        edge_shift_echo_m=shifts["d_1"],
        edge_shift_blended_m=shifts["d_2"],
        edge_shift_blended_echo_m=shifts["d_3"],
        range_offset_m=float(np.mean(joint.lasers[0])),
        laser_spread_m=float(np.std(joint.lasers[0])),
        lens_lateral_m=float(joint.fields[0]),
        lens_vertical_m_per_rad=float(joint.fields[1]),
        bow_width_m=float(joint.fields[-2]),
        bow_height_m=float(joint.fields[-1]),
        camera_scale=1.0 - float(joint.scale[camera]),
        noise_range_m=levels.range_m,
        noise_ring_m=levels.ring_m,
        noise_ring_end_mrad=1e3 * levels.edge_rad,
        ring_ends_lost=levels.lost_share,
        noise_edge_shift_m=levels.own_shift_m,
        noise_tilt_deg=float(np.degrees(levels.tilt_rad)),
        noise_spin_deg=float(np.degrees(levels.spin_rad)),
        noise_depth_m=levels.depth_m,
        noise_across_m=levels.across_m,
    )
    return with_parts(figures, J @ joint.cov_scatter @ J.T, J @ joint.cov_constants @ J.T)
