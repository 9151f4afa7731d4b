"""Uncertainty of a solution: covariance, its leave-one-out check, and errors of the profile."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.algorithm_1.algorithm import Algorithm1
from lce_rig.calibrate.likelihood.fit import JointEstimate
from lce_rig.calibrate.likelihood.images import stack_images
from lce_rig.calibrate.likelihood.layout import SHIFTS, State
from lce_rig.calibrate.likelihood.levels import Levels
from lce_rig.calibrate.likelihood.rays import correct_points
from lce_rig.calibrate.options import EstimateSettings, Source, Tolerances
from lce_rig.calibrate.plane_and_ends import (
    differentiate,
    end_rows,
    extract_features,
    plane_residuals,
)
from lce_rig.calibrate.quadratics import jackknife_scatter, symmetric_inverse
from lce_rig.calibrate.result import (
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
from lce_rig.core.geometry import Array, invert, transform

# Significance threshold of (ratio of covariances - 1), in its standard deviations.
_SURE = 2.0


def by_scatter(
    start: Algorithm1, joint: JointEstimate, board: Board, settings: EstimateSettings
) -> CalibrationEstimate:
    """Report Algorithm 1's solution, with the covariance from the captures' scatter and the LiDAR's errors.

    Args:
        start: the solution.
        joint: estimate from it, of which the boards' turns are reported.
        board: the board's specification.
        settings: priors and tolerances.
    """
    scatter = start.cost.jackknife_covariance()
    by_lasers, by_bow, by_plate = moves_by_scans(start, board)
    lasers, offset = systematic_covariances(
        by_lasers.T, settings.laser_bias_sigma_m, settings.range_offset_sigma_m
    )
    systematic = lasers + offset
    cov = scatter + systematic
    figures = replace(start.diagnostics, edge_shift_sigma_m=float(np.sqrt(cov[6, 6])))
    figures = with_parts(figures, scatter, systematic)
    estimate = report(start, start.T_cam_lidar, cov[:6, :6], board, figures)
    sensitivities: tuple[Sensitivity, ...] = ()
    cov_with_lens = np.zeros((6, 0))
    if settings.tolerances is not None:
        sensitivities, cov_with_lens = _sensitivities(
            start,
            board,
            settings.tolerances,
            settings.lens,
            {"plate_size": by_plate[:, :6], "board_bow": by_bow[:, :6]},
        )
    return replace(
        estimate,
        fitted={observation.capture: observation for observation in start.fitted},
        sensitivities=sensitivities,
        lens=settings.lens,
        cov_with_lens=cov_with_lens,
        joint=(joint, 0),
    )


def moves_by_scans(start: Algorithm1, board: Board) -> tuple[Array, Array, Array]:
    """Differentiate the solution by constant errors of scans and plate, with one Newton step.

    With half gradient g and half Hessian H of the cost, both at the solution, an error b moves the minimum by

        s b = -H^-1 sum_k dg_k/db b                                                                      (1)

    Ranges that err lift the plane that is fitted to a board's points, by a + b x + c y fitted to their errors
    along its normal. Points lie on that plane, ring ends where their rays meet it. To first order an offset
    common to all rings moves the minimum by the sum of those of each.

    Args:
        start: the solution; its association is held.
        board: the board's specification.

    Returns:
        Tangents (translation m, rotation rad, edge shift m) per m of an error: (L, 7) by the range offset of
        each ring seen; (2, 7) by the height of the plate's middle over its ends, along its width and its
        height; (2, 7) by the plate's width and height, as the profile says them.
    """
    rings = np.unique(np.concatenate([o.lidar.ring for o in start.fitted]))
    T, weights, keep = start.T_cam_lidar, start.problem.weights, start.problem.keep
    L, changes = len(rings), np.zeros((len(rings) + 4, 7))
    for k, observation in enumerate(start.fitted):
        f, lidar = extract_features(observation, board), observation.lidar
        normal, T_board_lidar = lidar.plane[:3], invert(lidar.T_lidar_board)
        on_plate = _one_x_y(T_board_lidar, lidar.points)
        rays = lidar.points / np.linalg.norm(lidar.points, axis=1, keepdims=True)
        rises = [(rays @ normal)[:, None] * (lidar.ring[:, None] == rings)]
        rises.append(1 - (on_plate[:, 1:] / (board.width_m / 2, board.height_m / 2)) ** 2)
        lifted = np.linalg.lstsq(on_plate, np.hstack(rises), rcond=None)[0]
        points = f.plane_points if keep is None else f.plane_points[keep[k]]
        J = np.zeros((len(points), 7))
        J[:, :6] = differentiate(f.normal, points @ T[:3, :3].T)
        by_lift = -weights.plane / max(len(points), 1) * J.T @ _one_x_y(T_board_lidar, points)
        _, J_end, edge = end_rows(f, T)
        J_end *= weights.edge / max(len(edge), 1)
        outwards = np.sum(f.edge_normals[edge] * (f.edge_points @ T[:3, :3].T), axis=1)
        sideways = (outwards / (f.edge_points @ normal))[:, None]
        by_lift -= J_end.T @ (sideways * _one_x_y(T_board_lidar, f.edge_points))
        changes[: L + 2] += (by_lift @ lifted).T
        # Each edge of a wider plate lies farther out by half the difference.
        changes[L + 2 :] += np.abs(board.edges()[1][edge, :2]).T @ J_end / 2
    moves = -changes @ symmetric_inverse(start.cost.information)
    return moves[:L], moves[L : L + 2], moves[L + 2 :]


def _one_x_y(T_board_lidar: Array, points: Array) -> Array:
    """Return the rows [1, x, y] of the LiDAR's points (N, 3) on the board: (N, 3)."""
    return np.column_stack([np.ones(len(points)), transform(T_board_lidar, points)[:, :2]])


def _moves_by_poses(start: Algorithm1, moves: Array) -> Array:
    """Propagate shifts of the boards' poses in the images (n, F, 6) to the solution: (n, 6).

    A board that moves by (d, phi) looks to the LiDAR as if the extrinsics moved by
    (-d - phi x (t - c), -phi), c the board's place.
    """
    levers = start.T_cam_lidar[:3, 3] - [o.pose.T_cam_board[:3, 3] for o in start.fitted]
    shifts = -moves[:, :, :3] - np.cross(moves[:, :, 3:], levers)
    alike = np.concatenate([shifts, -moves[:, :, 3:]], axis=2)
    changes = np.einsum("kij,nkj->ni", start.cost.hessians[:, :, :6], alike)
    return np.asarray(-changes @ symmetric_inverse(start.cost.information)[:, :6])


def _sensitivities(
    start: Algorithm1,
    board: Board,
    known: Tolerances,
    lens: SessionLens | None,
    of_scans: Mapping[Source, Array],
) -> tuple[tuple[Sensitivity, ...], Array]:
    """Collect the shifts of Algorithm 1's solution by errors of lens and board.

    Args:
        start: the solution.
        board: the board of the profile.
        known: standard deviations of the errors.
        lens: the session's lens; None ignores its errors.
        of_scans: by source the moves (n, 6) of the result by other errors.

    Returns:
        The moves, and the cross-covariance (6, P) of extrinsics and intrinsics.
    """
    boards = [observation.image for observation in start.fitted]
    images = stack_images(np.arange(len(boards)), boards, board.pattern_offset_m, lens)
    by_error = _moves_by_poses(start, np.moveaxis(images.errors, -1, 0))
    # The extrinsics are used with the intrinsics of the same result: the joint effect of both errors counts.
    by_lens = by_error[3:] + np.pad(images.turns.T, ((0, 0), (3, 0)))
    moves: dict[Source, Array] = {"square_size": by_error[:1], "pattern_offset": by_error[1:3]}
    if lens is not None:
        moves["intrinsics"] = by_lens
    moves |= of_scans
    found = tuple(Sensitivity(source, known.sigma(source), each) for source, each in moves.items())
    return found, by_lens.T @ images.of_lens


def systematic_covariances(
    sensitivities: Array, sigma_each: float, sigma_common: float
) -> tuple[Array, Array]:
    """Propagate errors common to all groups, which the scatter between groups does not contain.

    Source r is off by e + e_r, with e the mean error of all L sources and e_r its own deviation from it, and
    moves the estimate by s_r for each unit. Independent deviations less their mean leave

        cov = sigma_each^2 sum_r (s_r - s) (s_r - s)^T + sigma_common^2 L^2 s s^T,   s = sum_r s_r / L

    Args:
        sensitivities: (..., p, L) s_r in columns.
        sigma_each: standard deviation of e_r, before their mean is subtracted.
        sigma_common: standard deviation of e.

    Returns:
        Its two terms (..., p, p).
    """
    common = sensitivities.sum(axis=-1, keepdims=True)
    each = sensitivities - sensitivities.mean(axis=-1, keepdims=True)
    of_each = sigma_each**2 * each @ np.swapaxes(each, -1, -2)
    return of_each, sigma_common**2 * common @ np.swapaxes(common, -1, -2)


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
