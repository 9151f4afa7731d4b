"""Uncertainty of a solution: covariance, its leave-one-out check, and errors of the profile."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.fit import JointEstimate
from lce_rig.calibrate.likelihood.layout import SHIFTS, State
from lce_rig.calibrate.likelihood.levels import Levels
from lce_rig.calibrate.likelihood.rays import correct_points
from lce_rig.calibrate.plane_and_ends import extract_features, plane_residuals
from lce_rig.calibrate.quadratics import jackknife_scatter, symmetric_inverse
from lce_rig.calibrate.result import (
    BY_ALGORITHM_1,
    SIGMAS_OF_PARTS,
    CalibrationEstimate,
    Sensitivity,
    Start,
    report,
    squares_scale,
    with_parts,
    with_squares,
)
from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.core.board import Board
from lce_rig.core.calibration import Diagnostics
from lce_rig.core.geometry import Array, difference

# Significance threshold of (ratio of covariances - 1), in its standard deviations.
_SURE = 2.0


def by_algorithm_1(
    start: Start, joint: JointEstimate, board: Board, lens: SessionLens | None
) -> CalibrationEstimate:
    """Report Algorithm 1's solution: its error is at most the likelihood's and the difference of both.

    Args:
        start: the solution.
        joint: estimate from it.
        board: its specification.
        lens: lens of the camera; None if exact.
    """
    likely = by_likelihood(start, joint, board, lens)
    apart = difference(start.T_cam_lidar, likely.T_cam_lidar)
    own, theirs = start.diagnostics, likely.diagnostics
    shift_apart_m = own.edge_shift_m - theirs.edge_shift_m
    figures = replace(
        own,
        **{name: getattr(theirs, name) for name in SIGMAS_OF_PARTS},
        edge_shift_sigma_m=math.hypot(theirs.edge_shift_sigma_m, shift_apart_m),
    )
    estimate = report(start, start.T_cam_lidar, likely.cov, board, figures)
    return replace(
        likely,
        T_cam_lidar=estimate.T_cam_lidar,
        residuals=estimate.residuals,
        diagnostics=estimate.diagnostics,
        method="paper",
        sensitivities=(*likely.sensitivities, Sensitivity(BY_ALGORITHM_1, 1.0, apart[None])),
    )


def by_likelihood(
    start: Start, joint: JointEstimate, board: Board, lens: SessionLens | None, camera: int = 0
) -> CalibrationEstimate:
    """Report the joint estimate of a camera.

    Certificate, outliers and held-out residuals are those of Algorithm 1, from whose solution it starts.

    Args:
        start: Algorithm 1's solution.
        joint: joint estimate of F captures.
        board: the board's specification.
        lens: intrinsics of the camera; None if exact.
        camera: index of the camera.
    """
    moves = joint.cost.moves() @ joint.to_extrinsics[camera].T
    n_placements = len(np.unique(joint.placement[joint.terms.images[camera].capture]))
    J = joint.to_extrinsics[camera]
    scatter, constants = (J @ each @ J.T for each in joint.covariances)
    cov, inflation = widen(scatter + constants, jackknife_scatter(moves), n_placements)
    shift = joint.state.layout.z["shifts"].start
    shift_sigma_m = float(np.sqrt(joint.cov_z[shift, shift]))
    figures = with_errors(start.diagnostics, joint.levels, joint.state, shift_sigma_m, inflation)
    figures = with_parts(figures, scatter, constants)
    estimate = report(start, joint.T_cam_lidar[camera], cov, board, figures)
    return replace(
        with_corrected_planes(estimate, board, joint.terms.scans.rings, joint.state),
        method="ml",
        sensitivities=tuple(Sensitivity(name, 1.0, (J @ moves).T) for name, moves in joint.moves.items()),
        lens=lens,
        cov_with_lens=joint.cov_with_lens(camera),
        joint=(joint, camera),
    )


def with_errors(
    start: Diagnostics, levels: Levels, state: State, edge_shift_sigma_m: float, inflation: float
) -> Diagnostics:
    """Replace the start's constant errors and noise levels by those of a joint estimate.

    Args:
        start: figures of Algorithm 1.
        levels: noise levels.
        state: state of the LiDAR; with cameras, also of the squares.
        edge_shift_sigma_m: standard deviation of the edge shift.
        inflation: inflation factor of the covariance.
    """
    shifts = dict(zip(SHIFTS, state.shifts.tolist(), strict=True))
    return replace(
        start,
        covariance_inflation=inflation,
        edge_shift_m=shifts["d_0"],
        edge_shift_sigma_m=edge_shift_sigma_m,
        edge_shift_echo_m=shifts["d_1"],
        edge_shift_blended_m=shifts["d_2"],
        edge_shift_blended_echo_m=shifts["d_3"],
        range_offset_m=float(np.mean(state.lasers[0])),
        laser_spread_m=float(np.std(state.lasers[0])),
        lens_vertical_m_per_rad=float(state.fields[1]),
        camera_scale=1.0 - state.squares if state.layout.n_cameras else start.camera_scale,
        noise_range_m=levels.range_m,
        noise_tilt_deg=float(np.degrees(levels.tilt_rad)),
        noise_spin_deg=float(np.degrees(levels.spin_rad)),
        noise_depth_m=levels.depth_m,
        noise_across_m=levels.across_m,
    )


def with_corrected_planes(
    estimate: CalibrationEstimate, board: Board, rings: NDArray[np.int16], state: State
) -> CalibrationEstimate:
    """Add the mean plane error of the points after correction of the LiDAR's estimated constant errors.

    Args:
        estimate: estimate of a camera and a LiDAR.
        board: the board's size.
        rings: (L,) ring numbers of the state's lasers.
        state: the errors.
    """
    scale, means_m = squares_scale(estimate.diagnostics), []
    for observation in estimate.observations.values():
        features = extract_features(with_squares(observation, scale), board, half_step=False)
        points = correct_points(observation.lidar, board, rings, state)
        means_m.append(np.abs(plane_residuals(features, estimate.T_cam_lidar, points)).mean())
    figures = replace(estimate.diagnostics, mpe_corrected_m=float(np.mean(means_m)))
    return replace(estimate, diagnostics=figures)


def without_lidar(figures: Diagnostics) -> Diagnostics:
    """Remove the figures of a LiDAR, its errors and its ring ends."""
    names = ("edge_shift", "range_offset", "laser_spread", "lens_vertical", "noise_range", "sigma_systematic")
    unknown = {name: math.nan for name in figures.figures() if name.startswith(names)}
    return replace(figures, **unknown)


def widen(cov: Array, spread: Array, n_placements: int) -> tuple[Array, float]:
    """Scale a covariance (6, 6) up where the scatter (6, 6) between placements significantly exceeds it.

    The spread of the optimum without each placement (`lce_rig.calibrate.quadratics`) is independent of the
    noise model. If it exceeds the model's covariance, there are errors that the model lacks.

    Returns:
        The covariance and the factor, 1 if they agree.
    """
    ratio = float(np.trace(symmetric_inverse(cov) @ spread)) / len(cov)
    # Standard deviation of a mean of 6 chi-squared values with n - 1 degrees of freedom each.
    chance = np.sqrt(2 / (len(cov) * max(n_placements - 1, 1)))
    factor = ratio if ratio > 1 + _SURE * chance else 1.0
    return factor * cov, factor
