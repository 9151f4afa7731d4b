"""Least squares over any correspondences, from a closed-form start, with a covariance over placements."""

from collections.abc import Sequence

import numpy as np

from lce_rig.core.geometry import Array, pose
from lce_rig.core.results import Observation
from lce_rig.residuals.placements import group_placements
from lce_rig.residuals.plane_and_ends import residual_rows
from lce_rig.residuals.quadratics import without_prior
from lce_rig.solvers.registration import (
    N_ROTATION,
    eliminate_linear,
    linear_unknowns,
    minimise_on_so3,
    tangent_basis,
    vec_rotation,
    with_one,
)


def point_rows(targets: Array, sources: Array) -> Array:
    """Write the residuals g - R p - t as rows of a . x, x = [vec R; t; 1].

    Args:
        targets: (N, 3) g, m, target frame.
        sources: (N, 3) p, m, source frame.

    Returns:
        (3 N, 13).
    """
    return residual_rows(np.eye(3)[None], targets[:, None], sources[:, None]).reshape(-1, 13)


def direction_rows(targets: Array, sources: Array) -> Array:
    """Write the residuals d - R s of unit vectors, which no translation moves, as rows of a . x.

    Args:
        targets: (N, 3) d, target frame.
        sources: (N, 3) s, source frame.

    Returns:
        (3 N, 13).
    """
    rows = point_rows(targets, sources)
    rows[:, N_ROTATION:12] = 0.0
    return rows


def refine(moments: Array, T_start: Array) -> Array:
    """Minimise x^T M x over poses, from a start, to the next minimum.

    Args:
        moments: (F, 13, 13) of each capture.
        T_start: (4, 4).

    Returns:
        (4, 4).
    """
    Q, L = eliminate_linear(moments.sum(axis=0)[None])
    R, _ = minimise_on_so3(Q, T_start[None, :3, :3])
    return np.asarray(pose(R[0], linear_unknowns(L, R)[0]))


def placement_covariance(moments: Array, T: Array, observations: Sequence[Observation]) -> Array:
    """Estimate the covariance (6, 6) of a minimum from how placements of the board disagree.

    Args:
        moments: (F, 13, 13) of each capture.
        T: (4, 4) the minimum.
        observations: of each capture.
    """
    x = with_one(np.concatenate([vec_rotation(T[:3, :3]), T[:3, 3]]))
    J = tangent_basis(T[:3, :3], 0)
    cost = without_prior(moments @ x @ J, J.T @ moments @ J, group_placements(observations))
    return cost.jackknife_covariance()
