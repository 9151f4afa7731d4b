"""Uncertainty of a solution: covariance, its check by leaving placements out, and errors of the profile."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lce_rig.calibrate.algorithm_1.algorithm import Algorithm1
from lce_rig.calibrate.likelihood.fit import JointEstimate
from lce_rig.calibrate.likelihood.layout import OWN, SHIFTS
from lce_rig.calibrate.likelihood.levels import Levels
from lce_rig.calibrate.likelihood.model import assemble, linearise
from lce_rig.calibrate.likelihood.rays import interior, stack_scans
from lce_rig.calibrate.options import EstimateSettings
from lce_rig.calibrate.quadratics import jackknife_scatter, symmetric_inverse
from lce_rig.calibrate.result import CalibrationEstimate, Start, report, with_parts
from lce_rig.calibrate.systematic import profile_sensitivities, ring_sensitivities, systematic_covariances
from lce_rig.calibrate.tolerances import Variant, sensitivities_of, vary
from lce_rig.core.board import Board
from lce_rig.core.calibration import Diagnostics
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation

# Number of its standard deviations by which the ratio of covariances must exceed 1 to be significant.
_SURE = 2.0


def by_scatter(start: Algorithm1, board: Board, settings: EstimateSettings) -> CalibrationEstimate:
    """Report Algorithm 1's solution: covariance from the scatter of captures, and from the LiDAR's errors.

    Args:
        start: the solution.
        board: its specification.
        settings: priors and tolerances.
    """
    scatter = start.cost.jackknife_covariance()
    systematic = np.zeros_like(scatter)
    laser_m, offset_m = settings.laser_bias_sigma_m, settings.range_offset_sigma_m
    if laser_m or offset_m:
        lasers, offset = systematic_covariances(ring_sensitivities(start, board), laser_m, offset_m)
        systematic = lasers + offset
    cov = scatter + systematic
    figures = replace(start.diagnostics, edge_shift_sigma_m=float(np.sqrt(cov[6, 6])))
    figures = with_parts(figures, scatter, systematic)
    known = settings.tolerances
    return replace(
        report(start, start.T_cam_lidar, cov[:6, :6], board, figures),
        fitted={observation.capture: observation for observation in start.fitted},
        sensitivities=() if known is None else profile_sensitivities(start, board, known, settings.lens),
        lens=settings.lens,
    )


def by_likelihood(start: Start, joint: JointEstimate, board: Board, camera: int = 0) -> CalibrationEstimate:
    """Report the joint estimate of a camera, without errors of its lens and the board.

    Certificate, outliers and held-out residuals are those of Algorithm 1, from whose solution it starts.

    Args:
        start: Algorithm 1's solution.
        joint: of F captures.
        board: its specification.
        camera: its number.
    """
    moves = joint.cost.moves() @ joint.to_extrinsics[camera].T
    n_placements = len(np.unique(joint.placement[joint.terms.images[camera].capture]))
    cov, inflation = widen(joint.cov[camera], jackknife_scatter(moves), n_placements)
    figures = _add_figures(start.diagnostics, joint, camera, inflation)
    estimate = report(start, joint.T_cam_lidar[camera], cov, board, figures)
    # The cost in the extrinsics alone, the camera's own first; constant errors are held fixed.
    n_cameras = len(joint.T_cam_lidar)
    order = [camera, *(c for c in range(n_cameras) if c != camera)]
    own = np.concatenate([joint.state.layout.camera(c) for c in order])
    # Subsets of captures that another camera did not see leave its extrinsics undetermined: 1 m, 1 rad.
    prior = np.eye(len(own)) if n_cameras > 1 else np.zeros((6, 6))
    cost = replace(joint.cost.of(own), prior=prior, prior_gradient=np.zeros(len(own)))
    return replace(estimate, method="ml", cost=cost, turns=_turns(joint, camera))


def with_profile(
    estimate: CalibrationEstimate, joint: JointEstimate, board: Board, settings: EstimateSettings
) -> CalibrationEstimate:
    """Add the effects of the errors of lens and board to the estimate of one camera."""
    if settings.tolerances is None:
        return estimate
    used = list(estimate.observations.values())
    variants = vary(used, board, settings.lens, bends_scans=False)
    sensitivities = sensitivities_of(
        variants, _moves_under(joint, used, variants, board), settings.tolerances
    )
    return replace(estimate, lens=settings.lens, sensitivities=sensitivities)


def _turns(joint: JointEstimate, camera: int) -> Array:
    """Measure the turn about its line of sight of each board that a camera sees: `CalibrationEstimate.turns`.

    The noise of such turns, as estimated, contains those of a sensor that moves to and fro, and captures of
    either mounting lose weight: the usual noise is assumed, and full weight.
    """
    images, layout = joint.terms.images[camera], joint.state.layout
    levels = replace(joint.levels, spin_rad=Levels().spin_rad)
    terms = replace(joint.terms, trust=np.ones_like(joint.terms.trust))
    cost = assemble(terms, levels, joint.priors).cost.of(layout.camera(camera))
    # A board may leave a direction undetermined: 1 m, 1 rad.
    cov = np.linalg.inv(cost.hessians[images.capture] + np.eye(6))
    own = -(cov @ cost.gradients[images.capture, :, None])[:, 3:, 0]
    sight = images.T_cam_board[:, :3, 3] / np.linalg.norm(images.T_cam_board[:, :3, 3], axis=1, keepdims=True)
    variance = np.einsum("fi,fij,fj->f", sight, cov[:, 3:, 3:], sight)
    return np.array([np.sum(sight * own, axis=1), np.sqrt(variance)])


def _add_figures(start: Diagnostics, joint: JointEstimate, camera: int, inflation: float) -> Diagnostics:
    """Replace the start's constant errors, noise levels and covariance parts by those of a joint estimate."""
    levels, state, J = joint.levels, joint.state, joint.to_extrinsics[camera]
    shifts = dict(zip(SHIFTS, state.shifts.tolist(), strict=True))
    figures = replace(
        start,
        covariance_inflation=inflation,
        edge_shift_m=shifts["d_0"],
        edge_shift_sigma_m=float(np.sqrt(np.diag(joint.cov_z)[state.layout.z["shifts"]][0])),
        edge_shift_echo_m=shifts["d_1"],
        edge_shift_blended_m=shifts["d_2"],
        edge_shift_blended_echo_m=shifts["d_3"],
        range_offset_m=float(np.mean(state.lasers[0])),
        laser_spread_m=float(np.std(state.lasers[0])),
        lens_vertical_m_per_rad=float(state.fields[1]),
        camera_scale=1.0 - float(state.scale[camera]),
        noise_range_m=levels.range_m,
        noise_tilt_deg=float(np.degrees(levels.tilt_rad)),
        noise_spin_deg=float(np.degrees(levels.spin_rad)),
        noise_depth_m=levels.depth_m,
        noise_across_m=levels.across_m,
    )
    scatter, constants = joint.covariances
    return with_parts(figures, J @ scatter @ J.T, J @ constants @ J.T)


def _moves_under(
    joint: JointEstimate, used: Sequence[Observation], variants: Sequence[Variant], board: Board
) -> Array:
    """Compute how far errors of the profile move one camera's extrinsics, to first order.

    Args:
        joint: of one camera.
        used: the F observations, in the order of `variants`.
        variants: V of what would have been observed.
        board: as the profile says.

    Returns:
        (V, 6) tangents (translation m, rotation rad).
    """
    terms, own_steps = joint.terms, joint.reduced.own_steps
    G = joint.state.layout.z.size
    changes = np.zeros((len(variants), G))
    of_images = [k for k, variant in enumerate(variants) if variant.board == board]
    moves = np.array([variants[k].pose_moves for k in of_images])
    # The gradients by [y, z] move by J^T C^-1 times how far the images' poses do.
    images, rows, place = terms.images[0], terms.image_rows[0], joint.state.layout.image_row(0)[:-1]
    weighted = -np.linalg.solve(images.total_cov(joint.levels), np.moveaxis(moves, 0, -1))
    gradients = np.zeros((len(terms.trust), OWN.size + G, len(moves)))
    gradients[images.capture[:, None], place] = np.swapaxes(rows[:, :, :-1], 1, 2) @ weighted
    gradients *= terms.trust[:, None, None]
    by_own, by_common = gradients[:, : OWN.size], gradients[:, OWN.size :]
    changes[of_images] = np.sum(by_common - np.swapaxes(own_steps[:, :, :G], 1, 2) @ by_own, axis=0).T
    lidars = [o.lidar for o in sorted(used, key=lambda o: o.capture)]
    for k, variant in enumerate(variants):
        if variant.board != board:
            scans = stack_scans([interior(lidar, variant.board) for lidar in lidars], variant.board)
            assumed = linearise(scans, terms.images, variant.board, joint.state, terms.trust)
            moved = assemble(assumed, joint.levels, joint.priors).cost
            changes[k] = (moved.gradients - joint.cost.gradients).sum(axis=0)
    return np.asarray(-(joint.to_extrinsics[0] @ np.linalg.solve(joint.cost.information, changes.T)).T)


def widen(cov: Array, spread: Array, n_placements: int) -> tuple[Array, float]:
    """Multiply a covariance (6, 6) where the spread (6, 6) over placements significantly exceeds it.

    The spread of the optimum without each placement (`lce_rig.calibrate.quadratics`) is independent of the
    noise model. If it exceeds the model's covariance, there are errors that the model lacks.

    Returns:
        The covariance and the factor, 1 if they agree.
    """
    ratio = float(np.trace(symmetric_inverse(cov) @ spread)) / len(cov)
    # A mean of 6 chi squares over n - 1 freedoms each.
    chance = np.sqrt(2 / (len(cov) * max(n_placements - 1, 1)))
    factor = ratio if ratio > 1 + _SURE * chance else 1.0
    return factor * cov, factor
