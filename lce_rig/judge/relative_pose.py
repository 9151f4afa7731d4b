"""Poses from poses: the robust mean of several, and the relative pose of two cameras."""

from collections.abc import Callable

import numpy as np

from lce_rig.core.geometry import Array, difference, invert, perturb, skew

_STEPS, _SETTLED = 20, 1e-10


def mean_pose(
    T: Array,
    information: Array,
    T_start: Array | None = None,
    weigh: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array]:
    """Find the pose of least sum_k w_k x_k^T W_k x_k, with x_k the tangent from it to pose k.

    Args:
        T: (K, 4, 4).
        information: (K, 6, 6) W_k.
        T_start: (4, 4) to start from; the first pose if None.
        weigh: weights w (K,) for squared distances x_k^T W_k x_k (K,), recomputed at each step, so that
            outliers do not shift the mean; 1 if None.

    Returns:
        (4, 4), and the weights (K,).
    """
    mean = T[0] if T_start is None else T_start
    weight = np.ones(len(T))
    for _ in range(_STEPS):
        apart = difference(T, mean)
        if weigh is not None:
            weight = weigh(np.einsum("ki,kij,kj->k", apart, information, apart))
        weighted = weight[:, None, None] * information
        step = np.linalg.solve(weighted.sum(axis=0), np.einsum("kij,kj->i", weighted, apart))
        mean = perturb(mean, step)
        if np.linalg.norm(step) < _SETTLED:
            break
    return mean, weight


def relative_pose(T_second: Array, T_first: Array) -> tuple[Array, Array]:
    """Compute T_second_first = T_second_x T_first_x^-1 and its derivatives by both poses.

    With tangents (tau, phi) of the two poses, R and t_1 the rotations and translations before:

        tau = tau_2 + (R t_1)^ phi_2 - R tau_1 - R t_1^ phi_1
        phi = phi_2 - R phi_1

    Args:
        T_second: (..., 4, 4) of anything x that both see: a board, or a LiDAR.
        T_first: (..., 4, 4) of the same.

    Returns:
        (..., 4, 4), and its derivatives (..., 6, 12) by the tangents of the second and of the first pose.
    """
    T = T_second @ invert(T_first)
    R, t_first = T[..., :3, :3], T_first[..., :3, 3]
    J = np.zeros((*T.shape[:-2], 6, 12))
    J[..., :6, :6] = np.eye(6)
    J[..., :3, 3:6] = skew((R @ t_first[..., None])[..., 0])
    J[..., :3, 6:9] = J[..., 3:, 9:] = -R
    J[..., :3, 9:] = -R @ skew(t_first)
    return T, J


def relative_covariance(J: Array, cov_second: Array, cov_first: Array) -> Array:
    """Propagate covariances of two poses with independent errors to that of `relative_pose` (..., 6, 6).

    Args:
        J: (..., 6, 12) derivatives from there.
        cov_second: (..., 6, 6) of the second pose.
        cov_first: of the first.
    """
    by_second, by_first = J[..., :6], J[..., 6:]
    return np.asarray(
        by_second @ cov_second @ np.swapaxes(by_second, -1, -2)
        + by_first @ cov_first @ np.swapaxes(by_first, -1, -2)
    )
