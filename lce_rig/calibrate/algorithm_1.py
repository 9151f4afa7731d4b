"""Algorithm 1: features -> planes -> ring ends by background -> outliers and weights -> draws -> solution.

References:
    Jiao et al., "LCE-Calib: Automatic LiDAR-Frame/Event Camera Extrinsic Calibration With a Globally Optimal
    Solution", IEEE/ASME Transactions on Mechatronics, 2023. Unlike there, candidates are judged on captures
    they were not fitted to, draws are seeded, and each solution carries a certificate.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.background import estimate_shifts, move_ends
from lce_rig.calibrate.draws import Draws, draw_subsets
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.initial import drop_uncertain, solve_planes
from lce_rig.calibrate.metrics import error_to_reference
from lce_rig.calibrate.observability import require_observable
from lce_rig.calibrate.options import Algorithm1Parts, EstimateSettings
from lce_rig.calibrate.outliers import reject_outliers
from lce_rig.calibrate.report import name_sigmas, report_estimate
from lce_rig.calibrate.systematic import ring_sensitivities
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import Certificate, Observation
from lce_rig.residuals.features import CaptureFeatures, extract_features
from lce_rig.residuals.moments import Problem, Solutions, Weights
from lce_rig.residuals.placements import group_placements
from lce_rig.residuals.plane_and_ends import PLANE_FREEDOMS
from lce_rig.solvers.covariance import systematic_covariances

# Residuals that captures are first weighed by; weights are reported in units of it.
NOMINAL_SIGMA_M = 0.01
# Names of what `estimate_shifts` finds.
_SHIFTS = ("edge_shift_echo_m", "edge_shift_blended_m", "edge_shift_blended_echo_m")


def calibrate_by_algorithm_1(
    observations: Sequence[Observation],
    board: Board,
    options: EstimateSettings,
    progress: Callable[[int, int], None] | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from boards whose pairing is settled.

    Args:
        observations: one a capture.
        board: its specification.
        options: switches of the algorithm.
        progress: called with (subsets done, subsets in all).

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    parts = options.parts
    features = [extract_features(observation, board, parts.features) for observation in observations]
    problem, T_planes = _start(features, board, _weights(parts, features, NOMINAL_SIGMA_M, NOMINAL_SIGMA_M))
    fitted, shifts = list(observations), dict.fromkeys(_SHIFTS, 0.0)
    if problem.n_shift:
        shifts_m = estimate_shifts(observations, features, T_planes, board)
        if shifts_m.any():
            fitted = move_ends(observations, features, T_planes, board, shifts_m)
            features = [extract_features(observation, board, parts.features) for observation in fitted]
            problem = Problem(features, board, problem.weights)
        shifts = dict(zip(_SHIFTS, shifts_m.tolist(), strict=True))

    outliers, sigmas = reject_outliers(features, problem, T_planes, parts)
    observations, fitted = (
        [observation for observation in each if observation.capture not in outliers]
        for each in (observations, fitted)
    )
    features = [f for f in features if f.capture not in outliers]
    keep = drop_uncertain(features, T_planes) if parts.use_uncertainty else None
    problem, T_planes = _start(features, board, _weights(parts, features, *sigmas), keep)

    draws = draw_subsets(problem, T_planes, options.n_draws, parts.n_rounds, options.seed, progress)
    # Draws judge the solution and do not choose it: all begin at the same place.
    solution = problem.solve(np.ones((1, problem.n_captures)), T_planes, parts.n_rounds)
    covariances = _covariances(fitted, board, options, problem, solution)
    held_out = np.full(len(features), np.nan) if draws is None else draws.capture_held_out_m
    certificates, cov = solution.certificates, covariances[0] + covariances[1]
    return report_estimate(
        solution.T[0],
        cov[:6, :6],
        observations,
        features,
        board,
        fitted=fitted,
        certificate=Certificate(bool(certificates.is_optimal[0]), float(certificates.relative_gap[0])),
        held_out_m=held_out,
        refused=outliers,
        diagnostics={**_diagnostics(problem, solution, covariances, draws), **shifts},
    )


def _start(
    features: Sequence[CaptureFeatures],
    board: Board,
    weights: Weights,
    keep: Sequence[NDArray[np.bool_]] | None = None,
) -> tuple[Problem, Array]:
    """Solve for T_cam_lidar (4, 4) from the planes alone; also the problem that goes on from there.

    Raises:
        NotEnoughDataError: the planes leave a direction undetermined, which is named.
    """
    problem = Problem(features, board, weights, keep)
    T_planes = solve_planes(features, problem)
    require_observable(features, problem, T_planes)
    return problem, T_planes


def _weights(
    parts: Algorithm1Parts, features: Sequence[CaptureFeatures], plane_sigma_m: float, edge_sigma_m: float
) -> Weights:
    """Weigh by likelihood.

    The camera's and the LiDAR's plane differ in three ways, by an offset and two tilts, however many points
    the LiDAR's has; its ring ends err independently, by where their rays happen to fall. A capture's mean
    squares therefore count 3 / sigma_plane^2 and M / sigma_edge^2, with M ring ends.
    """
    n_ends = float(np.mean([len(f.edge_points) for f in features]))
    return Weights(
        plane=PLANE_FREEDOMS / plane_sigma_m**2 if parts.use_planes else 0.0,
        edge=n_ends / edge_sigma_m**2 if parts.use_ends else 0.0,
        shift_prior=parts.edge_shift_precision,
    )


def _covariances(
    observations: Sequence[Observation],
    board: Board,
    options: EstimateSettings,
    problem: Problem,
    solution: Solutions,
) -> tuple[Array, Array]:
    """Estimate the covariances (6 + k, 6 + k) of the solution, edge shift last.

    Returns:
        What the scatter between captures shows, and what the LiDAR's errors common to them add.
    """
    x, edge_ids = solution.x[0], solution.edge_ids[0]
    cost = problem.quadratics(x, edge_ids, group_placements(observations))
    scatter = cost.jackknife_covariance()
    laser_m, offset_m = options.laser_bias_sigma_m, options.range_offset_sigma_m
    if laser_m == 0 and offset_m == 0:
        return scatter, np.zeros_like(scatter)
    sensitivities = ring_sensitivities(
        observations, board, options.parts.features, problem, x, edge_ids, cost.information
    )
    lasers, offset = systematic_covariances(sensitivities, laser_m, offset_m)
    return scatter, lasers + offset


def _diagnostics(
    problem: Problem,
    solution: Solutions,
    covariances: tuple[Array, Array],
    draws: Draws | None,
) -> dict[str, float]:
    plane, edge = problem.errors(solution.x)
    figures = {
        "plane_weight": problem.weights.plane * NOMINAL_SIGMA_M**2,
        "edge_weight": problem.weights.edge * NOMINAL_SIGMA_M**2,
        "fit_plane_rms_m": float(np.sqrt(np.mean(plane**2))),
        "fit_edge_rms_m": float(np.sqrt(np.mean(edge**2))),
    }
    for name, cov in zip(("scatter", "systematic"), covariances, strict=True):
        figures |= name_sigmas(name, cov)
    if problem.n_shift:
        figures["edge_shift_m"] = float(solution.linear[0, 3])
        figures["edge_shift_sigma_m"] = float(np.sqrt(covariances[0][6, 6] + covariances[1][6, 6]))
    if draws is not None:
        offset = error_to_reference(draws.T_mean[draws.best], solution.T[0])
        figures |= {
            "best_subset_size": float(draws.sizes[draws.best]),
            "n_solved": float(draws.n_solved),
            "certified_share": draws.certified_share,
            "draw_mean_offset_deg": offset[0],
            "draw_mean_offset_m": offset[1],
            "draw_spread_rotation_deg": float(np.degrees(draws.spread_rotation_rad[draws.best])),
            "draw_spread_translation_m": float(draws.spread_translation_m[draws.best]),
        }
    return figures
