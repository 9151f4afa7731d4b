"""Algorithm 1: planes -> ring ends by background -> outliers and weights -> solution.

References:
    Jiao et al., "LCE-Calib: Automatic LiDAR-Frame/Event Camera Extrinsic Calibration With a Globally Optimal
    Solution", IEEE/ASME Transactions on Mechatronics, 2023. Unlike there, all captures that agree are used at
    once, random subsets are not drawn, and the solution carries a certificate.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.algorithm_1.background import estimate_shifts, move_ends
from lce_rig.calibrate.algorithm_1.certificate import solve_globally
from lce_rig.calibrate.algorithm_1.moments import Problem, Weights
from lce_rig.calibrate.algorithm_1.registration import (
    eliminate_linear,
    linear_unknowns,
    rotation_from_directions,
    vec_rotation,
    with_one,
)
from lce_rig.calibrate.findings import OUTLIER, UNDETERMINED
from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.plane_and_ends import PLANE_FREEDOMS, CaptureFeatures, extract_features
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.calibrate.result import Start
from lce_rig.core.board import Board
from lce_rig.core.calibration import MOTIONS, Certificate, Diagnostics
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import SIGMA_PER_MAD, Array, pose
from lce_rig.core.results import Observation

NOMINAL_SIGMA_M = 0.01
"""Residuals for the first weights of captures; weights are reported in units of it."""
# Fraction of the plane terms that are kept: those with the smallest propagated variance.
_KEPT_SHARE = 0.9
# Largest error attributed to noise: in deviations from the median of all captures, and as a multiple of it.
_DEVIATIONS, _TIMES_MEDIAN = 6.0, 3.0
# Smaller disagreements count as noise, even if the other captures agree better, m.
_FLOOR_M = 0.02
_MAX_SHARE = 0.25
# Maximum number of folds: larger sessions predict and reject several captures at once, so that the cost stays
# linear.
_MAX_FOLDS = 60
_SIGMA_FLOOR_M = 0.001
# A motion that changes the planes of all captures together by less, relative to how far it moves the boards,
# counts as undetermined: noise of 5 mm of one capture's plane would let it move them by 10 cm.
_LEAST_CHANGE = 0.05


@dataclass(frozen=True, eq=False)
class Algorithm1(Start):
    """Algorithm 1's solution.

    Attributes:
        problem: the moments of the captures used.
        cost: quadratic cost at the solution, in tangent (translation m, rotation rad) and edge shift m.
    """

    problem: Problem
    cost: Quadratics


def solve(observations: Sequence[Observation], board: Board) -> Algorithm1:
    """Solve for T_cam_lidar from matched boards.

    Args:
        observations: one per capture.
        board: the board's specification.

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    features = [extract_features(observation, board) for observation in observations]
    problem, T_planes = solve_planes(features, (NOMINAL_SIGMA_M, NOMINAL_SIGMA_M))
    shifts_m = estimate_shifts(observations, features, T_planes)
    if shifts_m.any():
        moved = move_ends(observations, features, T_planes, shifts_m)
        features = [extract_features(observation, board) for observation in moved]
        problem = Problem(features, problem.weights)

    refused, plane_m, edge_m = reject_outliers(features, problem, T_planes)
    observations = [o for o in observations if o.capture not in refused]
    features = [f for f in features if f.capture not in refused]
    sigmas = max(float(np.median(plane_m)), _SIGMA_FLOOR_M), max(float(np.median(edge_m)), _SIGMA_FLOOR_M)
    problem, T_planes = solve_planes(features, sigmas, drop_uncertain(features, T_planes))
    solution = problem.solve(np.ones((1, problem.n_captures)), T_planes)

    plane, edge = problem.errors(solution.x)
    figures = Diagnostics(
        fit_plane_rms_m=float(np.sqrt(np.mean(plane**2))),
        fit_edge_rms_m=float(np.sqrt(np.mean(edge**2))),
        edge_shift_m=float(solution.linear[0, 3]),
        edge_shift_echo_m=float(shifts_m[0]),
        edge_shift_blended_m=float(shifts_m[1]),
        edge_shift_blended_echo_m=float(shifts_m[2]),
    )
    certificates = solution.certificates
    return Algorithm1(
        T_cam_lidar=solution.T[0],
        certificate=Certificate(bool(certificates.is_optimal[0]), float(certificates.relative_gap[0])),
        observations=observations,
        refused=refused,
        held_out_m=plane_m + edge_m,
        diagnostics=figures,
        problem=problem,
        cost=problem.quadratics(solution.x[0], solution.edge_ids[0], group_placements(observations)),
    )


def solve_planes(
    features: Sequence[CaptureFeatures],
    sigmas_m: tuple[float, float],
    keep: Sequence[NDArray[np.bool_]] | None = None,
) -> tuple[Problem, Array]:
    """Solve point-to-plane over all captures.

    The start rotates the LiDAR's normals onto the camera's. If its minimum is not certified, the global one
    is searched from everywhere.

    Planes and ring ends are weighted by likelihood. The camera's and the LiDAR's plane differ by three
    parameters, an offset and two tilts, for any number of points. Ring ends err independently, by the random
    position of their rays. A capture's mean squares therefore count 3 / sigma_plane^2 and M / sigma_edge^2,
    with M ring ends.

    Args:
        features: fitted features of each capture.
        sigmas_m: typical errors of a capture's plane and of its ring ends.
        keep: per capture a mask of the plane points to use; all by default.

    Returns:
        The problem for the refinement, and T_cam_lidar (4, 4) by the planes alone.

    Raises:
        NotEnoughDataError: the planes leave a direction undetermined, which is named.
    """
    n_ends = float(np.mean([len(f.edge_points) for f in features]))
    weights = Weights(PLANE_FREEDOMS / sigmas_m[0] ** 2, n_ends / sigmas_m[1] ** 2)
    problem = Problem(features, weights, keep)
    R_start = rotation_from_directions(
        np.array([f.normal for f in features]), np.array([f.lidar_normal for f in features])
    )
    no_edges = np.zeros((1, len(problem.edge_capture)), dtype=np.intp)
    Q, L = eliminate_linear(problem.moments(np.ones((1, len(features))), no_edges, Weights(1.0, 0.0)))
    R, _ = solve_globally(Q, R_start[None])
    T_cam_lidar = pose(R[0], linear_unknowns(L, R)[0, :3])
    require_observable(features, problem, T_cam_lidar)
    return problem, T_cam_lidar


def require_observable(features: Sequence[CaptureFeatures], problem: Problem, T_cam_lidar: Array) -> None:
    """Check that the boards' planes alone determine all six directions.

    Edges could replace planes, but a set that requires this is fragile, as edge errors are systematic.

    Args:
        features: fitted features of the captures in `problem`.
        problem: their moments.
        T_cam_lidar: (4, 4) estimate.

    Raises:
        NotEnoughDataError: a direction is undetermined; it is named.
    """
    x = with_one(np.concatenate([vec_rotation(T_cam_lidar[:3, :3]), T_cam_lidar[:3, 3], np.zeros(1)]))
    planes = Weights(PLANE_FREEDOMS, 0.0)
    hessians = problem.quadratics(x, problem.associate(x[None])[0], weights=planes).hessians
    lever_m = float(np.sqrt(np.mean([f.centre @ f.centre for f in features])))
    scale = np.r_[np.ones(3), np.full(3, lever_m)]
    information = hessians.sum(axis=0)[:6, :6] / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(information)
    weak = values < _LEAST_CHANGE**2
    if not weak.any():
        return
    # Unit vectors near one direction do not vary along it, so use the smaller of the two lateral spreads.
    spread = np.linalg.eigvalsh(np.cov(np.array([f.normal for f in features]).T, bias=True))[1]
    finding = UNDETERMINED(
        # Main component of each weak direction; translations and rotations have comparable units.
        motions=tuple(dict.fromkeys(MOTIONS[k] for k in np.argmax(np.abs(vectors[:, weak]), axis=0))),
        n_captures=len(features),
        spread_deg=float(np.degrees(np.sqrt(max(spread, 0.0)))),
    )
    raise NotEnoughDataError.of(finding)


def drop_uncertain(features: Sequence[CaptureFeatures], T_cam_lidar: Array) -> list[NDArray[np.bool_]]:
    """Mask the tenth of all plane terms with the largest propagated variance.

    The distance n . (R p + t) + d of a point inherits sigma^2 = (R p + t)^T cov_n (R p + t) from the camera's
    normal. No capture loses more than half of its points, so that the filter does not reject whole captures.

    Args:
        features: fitted features of all captures.
        T_cam_lidar: (4, 4) estimate.

    Returns:
        Per capture a mask of the points kept.
    """
    variances = []
    for f in features:
        points_cam = f.plane_points @ T_cam_lidar[:3, :3].T + T_cam_lidar[:3, 3]
        variances.append(np.einsum("ni,ij,nj->n", points_cam, f.cov_normal, points_cam))
    limit = np.quantile(np.concatenate(variances), _KEPT_SHARE)
    return [v <= max(limit, np.median(v)) for v in variances]


def reject_outliers(
    features: Sequence[CaptureFeatures], problem: Problem, T_start: Array
) -> tuple[dict[str, Refusal], Array, Array]:
    """Refuse captures whose plane or edges are far from the other captures' prediction, worst first.

    Args:
        features: fitted features of the captures in `problem`.
        problem: their moments, weighted alike.
        T_start: (4, 4) planar initialisation.

    Returns:
        The refusals by capture; and the predicted plane and edge errors of the captures kept, m.
    """
    kept = np.arange(problem.n_captures)
    refusals: dict[str, Refusal] = {}
    while True:
        # Each capture is predicted without its fold; in small sessions each capture is a fold.
        fold = np.arange(len(kept)) % _MAX_FOLDS
        selection = np.zeros((fold.max() + 1, problem.n_captures))
        selection[:, kept] = fold != np.arange(len(selection))[:, None]
        plane, edge = (error[fold, kept] for error in problem.errors(problem.solve(selection, T_start).x))
        excess = np.maximum(_excess(plane), _excess(edge))
        at_once = -(-len(kept) // _MAX_FOLDS)
        worst = [int(k) for k in np.argsort(-excess, kind="stable")[:at_once] if excess[k] > 1]
        n_refused = problem.n_captures - len(kept)
        if not worst or len(kept) <= 4 or n_refused >= _MAX_SHARE * problem.n_captures:
            return refusals, plane, edge
        for k in worst:
            refusals[features[kept[k]].capture] = OUTLIER.refusal(
                plane_m=float(plane[k]),
                edges_m=float(edge[k]),
                plane_median_m=float(np.median(plane)),
                edges_median_m=float(np.median(edge)),
            )
        kept = np.delete(kept, worst)


def _excess(errors: Array) -> Array:
    """Divide errors (F,) by the largest error attributed to noise."""
    median = float(np.median(errors))
    deviation = SIGMA_PER_MAD * float(np.median(np.abs(errors - median)))
    return errors / max(median + _DEVIATIONS * deviation, _TIMES_MEDIAN * median, _FLOOR_M)
