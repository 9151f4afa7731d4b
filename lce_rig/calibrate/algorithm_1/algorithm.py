"""Algorithm 1: features -> planes -> ring ends by background -> outliers and weights -> draws -> solution.

References:
    Jiao et al., "LCE-Calib: Automatic LiDAR-Frame/Event Camera Extrinsic Calibration With a Globally Optimal
    Solution", IEEE/ASME Transactions on Mechatronics, 2023. Unlike there, candidates are judged on captures
    they were not fitted to, draws are seeded, and each solution carries a certificate.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.algorithm_1.background import estimate_shifts, move_ends
from lce_rig.calibrate.algorithm_1.certificate import solve_globally
from lce_rig.calibrate.algorithm_1.moments import Problem, Solutions, Weights
from lce_rig.calibrate.algorithm_1.registration import (
    eliminate_linear,
    linear_unknowns,
    rotation_from_directions,
)
from lce_rig.calibrate.covariance import systematic_covariances
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.features import CaptureFeatures, extract_features
from lce_rig.calibrate.metrics import error_to_reference
from lce_rig.calibrate.observability import require_observable
from lce_rig.calibrate.options import Algorithm1Parts, EstimateSettings
from lce_rig.calibrate.placements import group_placements
from lce_rig.calibrate.plane_and_ends import PLANE_FREEDOMS
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.calibrate.report import report_estimate, with_parts
from lce_rig.calibrate.systematic import profile_sensitivities, ring_sensitivities
from lce_rig.core.board import Board
from lce_rig.core.calibration import Certificate
from lce_rig.core.diagnostics import Diagnostics
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, pose, project_to_so3
from lce_rig.core.results import Observation

# First phase of Algorithm 1: extrinsics from the boards' planes alone.

KEPT_SHARE = 0.9


def solve_planes(features: Sequence[CaptureFeatures], problem: Problem) -> Array:
    """Solve point-to-plane over all captures: T_cam_lidar (4, 4).

    The start rotates the LiDAR's normals onto the camera's. If its minimum is not certified, the global one
    is searched from everywhere.
    """
    R_start = rotation_from_directions(
        np.array([f.normal for f in features]), np.array([f.lidar_normal for f in features])
    )
    n_ends = len(problem.edge_capture)
    everything = np.ones((1, problem.n_captures))
    no_edges = Weights(1.0, 0.0, problem.weights.shift_prior)
    M = problem.moments(everything, np.zeros((1, n_ends), dtype=np.int8), no_edges)
    Q, L = eliminate_linear(M)
    R, _ = solve_globally(Q, R_start[None])
    return pose(R[0], linear_unknowns(L, R)[0, :3])


def drop_uncertain(features: Sequence[CaptureFeatures], T_cam_lidar: Array) -> list[NDArray[np.bool_]]:
    """Mask the tenth of all plane terms with the largest propagated variance.

    The distance n . (R p + t) + d of a point inherits sigma^2 = (R p + t)^T cov_n (R p + t) from the camera's
    normal. No capture loses more than half of its points, so that the filter does not reject whole captures.

    Args:
        features: of all captures.
        T_cam_lidar: (4, 4) estimate.

    Returns:
        Per capture a mask of the points kept.
    """
    variances = []
    for f in features:
        points_cam = f.plane_points @ T_cam_lidar[:3, :3].T + T_cam_lidar[:3, 3]
        variances.append(np.einsum("ni,ij,nj->n", points_cam, f.cov_normal, points_cam))
    limit = np.quantile(np.concatenate(variances), KEPT_SHARE)
    return [v <= max(limit, np.median(v)) for v in variances]


# Captures that disagree with the others' prediction, and the size of the errors of those that agree.

_DEVIATIONS = 6.0
_TIMES_MEDIAN = 3.0
# A disagreement below this can be noise, however well the other captures agree.
_FLOOR_M = 0.02
_MAX_SHARE = 0.25
# More captures are predicted in folds of several, and as many are refused at once: the cost stays linear.
_MAX_FOLDS = 60
_SIGMA_FLOOR_M = 0.001


def reject_outliers(
    features: Sequence[CaptureFeatures], problem: Problem, T_start: Array, parts: Algorithm1Parts
) -> tuple[dict[str, Refusal], tuple[float, float]]:
    """Refuse captures whose plane or edges are far from the other captures' prediction, worst first.

    Args:
        features: of the captures in `problem`.
        problem: their moments, weighted alike.
        T_start: (4, 4) planar initialisation.
        parts: of Algorithm 1; `reject_outliers` switches the refusal on or off.

    Returns:
        The refusals by capture; and the typical predicted plane and edge error of the captures kept, m.
    """
    kept = np.arange(problem.n_captures)
    refusals: dict[str, Refusal] = {}
    while True:
        # Each capture is predicted without its fold; of few captures, each is a fold.
        fold = np.arange(len(kept)) % _MAX_FOLDS
        selection = np.zeros((fold.max() + 1, problem.n_captures))
        selection[:, kept] = fold != np.arange(len(selection))[:, None]
        solutions = problem.solve(selection, T_start, parts.n_rounds)
        plane, edge = (error[fold, kept] for error in problem.errors(solutions.x))
        excess = np.maximum(_excess(plane), _excess(edge))
        at_once = -(-len(kept) // _MAX_FOLDS)
        worst = [int(k) for k in np.argsort(-excess, kind="stable")[:at_once] if excess[k] > 1]
        n_refused = problem.n_captures - len(kept)
        is_done = not parts.reject_outliers or not worst or len(kept) <= 4
        if is_done or n_refused >= _MAX_SHARE * problem.n_captures:
            return refusals, (_typical(plane), _typical(edge))
        refusals |= {features[kept[k]].capture: _refusal(plane, edge, k) for k in worst}
        kept = np.delete(kept, worst)


def _excess(errors: Array) -> Array:
    """Divide errors (F,) by the largest that still counts as noise."""
    median = float(np.median(errors))
    deviation = 1.4826 * float(np.median(np.abs(errors - median)))
    limit = max(median + _DEVIATIONS * deviation, _TIMES_MEDIAN * median, _FLOOR_M)
    return errors / limit


def _typical(errors: Array) -> float:
    return max(float(np.median(errors)), _SIGMA_FLOOR_M)


def _refusal(plane: Array, edge: Array, k: int) -> Refusal:
    return Refusal(
        "calibrate.outlier",
        figures={
            "plane_m": float(plane[k]),
            "edges_m": float(edge[k]),
            "plane_median_m": float(np.median(plane)),
            "edges_median_m": float(np.median(edge)),
        },
    )


# Second phase of Algorithm 1: many refinements on random subsets, judged on held-out captures.

MIN_SUBSET = 3
# Of more captures, sizes are drawn at equal distances.
_MAX_SIZES = 40
# Subsets at once, and ring ends in all of them, which bounds the memory.
_CHUNK, _CHUNK_ENDS = 1000, 2_000_000


@dataclass(frozen=True, eq=False)
class Draws:
    """Results of the subsets of each size M.

    Attributes:
        sizes: (S,) M.
        T_mean: (S, 4, 4) mean of the candidates of each size.
        held_out_m: (S,) mean over captures of their error in candidates that did not use them.
        capture_held_out_m: (F,) the same per capture, at the best size.
        best: index of the size with the least held-out error.
        n_solved: problems solved, over all rounds.
        certified_share: share of the candidates with a certificate.
        spread_rotation_rad, spread_translation_m: (S,) rms of the candidates about their mean.
    """

    sizes: NDArray[np.int_]
    T_mean: Array
    held_out_m: Array
    capture_held_out_m: Array
    best: int
    n_solved: int
    certified_share: float
    spread_rotation_rad: Array
    spread_translation_m: Array


def draw_subsets(
    problem: Problem,
    T_start: Array,
    n_draws: int,
    n_rounds: int,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Draws | None:
    """Solve `n_draws` random subsets of each size 3..F-1, of many captures of 40 sizes.

    Each candidate is judged on the captures it was not fitted to, as fitted noise would bias the judgement.
    Every capture counts equally, however often it was held out.

    Args:
        problem: F captures.
        T_start: (4, 4) planar initialisation.
        n_draws: I.
        n_rounds: of re-association.
        seed: of the draws.
        progress: called with (subsets done, subsets in all).

    Returns:
        The draws; None without any, or if fewer than four captures leave none held out.
    """
    n = problem.n_captures
    sizes = np.arange(MIN_SUBSET, n)
    if len(sizes) > _MAX_SIZES:
        sizes = np.linspace(MIN_SUBSET, n - 1, _MAX_SIZES).astype(np.int_)
    if len(sizes) == 0 or n_draws == 0:
        return None
    rng = np.random.default_rng(seed)
    order = np.argsort(rng.random((len(sizes) * n_draws, n)), axis=1)
    # A capture takes part if its rank in the shuffled order is below the subset's size.
    selection = (order < np.repeat(sizes, n_draws)[:, None]).astype(np.float64)
    T, errors, certified = [], [], []
    chunk = max(min(_CHUNK, _CHUNK_ENDS // max(len(problem.edge_capture), 1)), 1)
    for start in range(0, len(selection), chunk):
        part = selection[start : start + chunk]
        solutions = problem.solve(part, T_start, n_rounds)
        plane, edge = problem.errors(solutions.x)
        T.append(solutions.T)
        errors.append(plane + edge)
        certified.append(solutions.certificates.is_optimal)
        if progress is not None:
            progress(start + len(part), len(selection))
    return _judge(
        sizes,
        np.concatenate(T).reshape(len(sizes), n_draws, 4, 4),
        np.concatenate(errors).reshape(len(sizes), n_draws, n),
        selection.reshape(len(sizes), n_draws, n) == 0,
        n_rounds * len(selection),
        float(np.mean(np.concatenate(certified))),
    )


def _judge(
    sizes: NDArray[np.int_],
    T: Array,
    errors: Array,
    is_held_out: Array,
    n_solved: int,
    certified_share: float,
) -> Draws:
    """Average held-out errors per size and capture, and candidates per size."""
    count = is_held_out.sum(axis=1)
    total = np.sum(errors * is_held_out, axis=1)
    # With few draws a capture may never be held out at a size; its mean over the sizes replaces the figure.
    overall = total.sum(axis=0) / np.maximum(count.sum(axis=0), 1)
    per_capture = np.where(count > 0, total / np.maximum(count, 1), overall)
    held_out_m = per_capture.mean(axis=1)
    best = int(np.argmin(held_out_m))
    R_mean = project_to_so3(T[:, :, :3, :3].mean(axis=1))
    t_mean = T[:, :, :3, 3].mean(axis=1)
    half_sine = np.linalg.norm(T[..., :3, :3] - R_mean[:, None], axis=(-2, -1)) / np.sqrt(8)
    angles = 2 * np.arcsin(np.clip(half_sine, 0, 1))
    distances = np.linalg.norm(T[..., :3, 3] - t_mean[:, None], axis=-1)
    return Draws(
        sizes=sizes,
        T_mean=pose(R_mean, t_mean),
        held_out_m=held_out_m,
        capture_held_out_m=per_capture[best],
        best=best,
        n_solved=n_solved,
        certified_share=certified_share,
        spread_rotation_rad=np.sqrt(np.mean(angles**2, axis=1)),
        spread_translation_m=np.sqrt(np.mean(distances**2, axis=1)),
    )


# Residuals for the first weights of captures; weights are reported in units of it.
NOMINAL_SIGMA_M = 0.01


def calibrate_by_algorithm_1(
    observations: Sequence[Observation],
    board: Board,
    options: EstimateSettings,
    progress: Callable[[int, int], None] | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from matched boards.

    Args:
        observations: one per capture.
        board: its specification.
        options: switches of the algorithm.
        progress: called with (subsets done, subsets in all).

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    parts = options.parts
    features = [extract_features(observation, board, parts.features) for observation in observations]
    problem, T_planes = _start(features, board, _weights(parts, features, NOMINAL_SIGMA_M, NOMINAL_SIGMA_M))
    fitted, shifts_m = list(observations), np.zeros(3)
    if problem.n_shift:
        shifts_m = estimate_shifts(observations, features, T_planes, board)
        if shifts_m.any():
            fitted = move_ends(observations, features, T_planes, board, shifts_m)
            features = [extract_features(observation, board, parts.features) for observation in fitted]
            problem = Problem(features, board, problem.weights)

    outliers, sigmas = reject_outliers(features, problem, T_planes, parts)
    observations, fitted = (
        [observation for observation in each if observation.capture not in outliers]
        for each in (observations, fitted)
    )
    features = [f for f in features if f.capture not in outliers]
    keep = drop_uncertain(features, T_planes) if parts.use_uncertainty else None
    problem, T_planes = _start(features, board, _weights(parts, features, *sigmas), keep)

    draws = draw_subsets(problem, T_planes, options.n_drawn, parts.n_rounds, options.seed, progress)
    # Draws judge the solution and do not choose it, so all begin at the same place.
    solution = problem.solve(np.ones((1, problem.n_captures)), T_planes, parts.n_rounds)
    cost = problem.quadratics(solution.x[0], solution.edge_ids[0], group_placements(fitted))
    covariances = _covariances(fitted, board, options, problem, solution, cost)
    held_out = np.full(len(features), np.nan) if draws is None else draws.capture_held_out_m
    certificates, cov = solution.certificates, covariances[0] + covariances[1]
    estimate = report_estimate(
        solution.T[0],
        cov[:6, :6],
        observations,
        features,
        board,
        fitted=fitted,
        certificate=Certificate(bool(certificates.is_optimal[0]), float(certificates.relative_gap[0])),
        held_out_m=held_out,
        refused=outliers,
        diagnostics=_diagnostics(problem, solution, covariances, shifts_m, draws),
    )
    if options.tolerances is None:
        return estimate
    of_profile = profile_sensitivities(
        fitted,
        board,
        parts.features,
        problem,
        solution.x[0],
        solution.edge_ids[0],
        cost.information,
        options.tolerances,
    )
    return replace(estimate, sensitivities=of_profile)


def _start(
    features: Sequence[CaptureFeatures],
    board: Board,
    weights: Weights,
    keep: Sequence[NDArray[np.bool_]] | None = None,
) -> tuple[Problem, Array]:
    """Solve for T_cam_lidar (4, 4) from the planes alone; also return the problem for the refinement.

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
    """Weight by likelihood.

    The camera's and the LiDAR's plane differ by three parameters, an offset and two tilts, for any number of
    points. Ring ends err independently, by the random position of their rays. A capture's mean
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
    cost: Quadratics,
) -> tuple[Array, Array]:
    """Estimate the covariances (6 + k, 6 + k) of the solution, edge shift last.

    Returns:
        The part from the scatter between captures, and the part from the LiDAR's errors common to them.
    """
    scatter = cost.jackknife_covariance()
    laser_m, offset_m = options.laser_bias_sigma_m, options.range_offset_sigma_m
    if laser_m == 0 and offset_m == 0:
        return scatter, np.zeros_like(scatter)
    sensitivities = ring_sensitivities(
        observations,
        board,
        options.parts.features,
        problem,
        solution.x[0],
        solution.edge_ids[0],
        cost.information,
    )
    lasers, offset = systematic_covariances(sensitivities, laser_m, offset_m)
    return scatter, lasers + offset


def _diagnostics(
    problem: Problem,
    solution: Solutions,
    covariances: tuple[Array, Array],
    shifts_m: Array,
    draws: Draws | None,
) -> Diagnostics:
    plane, edge = problem.errors(solution.x)
    figures = Diagnostics(
        plane_weight=problem.weights.plane * NOMINAL_SIGMA_M**2,
        edge_weight=problem.weights.edge * NOMINAL_SIGMA_M**2,
        fit_plane_rms_m=float(np.sqrt(np.mean(plane**2))),
        fit_edge_rms_m=float(np.sqrt(np.mean(edge**2))),
        edge_shift_echo_m=float(shifts_m[0]),
        edge_shift_blended_m=float(shifts_m[1]),
        edge_shift_blended_echo_m=float(shifts_m[2]),
    )
    if problem.n_shift:
        figures = replace(
            figures,
            edge_shift_m=float(solution.linear[0, 3]),
            edge_shift_sigma_m=float(np.sqrt(covariances[0][6, 6] + covariances[1][6, 6])),
        )
    if draws is not None:
        offset_deg, offset_m = error_to_reference(draws.T_mean[draws.best], solution.T[0])
        figures = replace(
            figures,
            best_subset_size=float(draws.sizes[draws.best]),
            n_solved=float(draws.n_solved),
            certified_share=draws.certified_share,
            draw_mean_offset_deg=offset_deg,
            draw_mean_offset_m=offset_m,
            draw_spread_rotation_deg=float(np.degrees(draws.spread_rotation_rad[draws.best])),
            draw_spread_translation_m=float(draws.spread_translation_m[draws.best]),
        )
    return with_parts(figures, *covariances)
