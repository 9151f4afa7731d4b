"""First phase of Algorithm 1: the extrinsic from the boards' planes alone."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, pose
from lce_rig.residuals.features import CaptureFeatures
from lce_rig.residuals.moments import Problem, Weights
from lce_rig.solvers.certificate import solve_globally
from lce_rig.solvers.registration import eliminate_linear, linear_unknowns, rotation_from_directions

KEPT_SHARE = 0.9


def solve_planes(features: Sequence[CaptureFeatures], problem: Problem) -> Array:
    """Solve point-to-plane over all captures: T_cam_lidar (4, 4).

    The start turns the LiDAR's normals onto the camera's; where its minimum is not certified the global one
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
    normal. No capture loses more than half of its points: the filter thins captures and does not select them.

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
