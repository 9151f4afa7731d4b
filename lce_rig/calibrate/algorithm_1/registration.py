"""Point-to-plane and point-to-line registration on sufficient statistics.

The cost over a rotation R, a translation t and further linear unknowns s (nuisances) is

    f(R, t, s) = sum_i w_i (n_i . (g_i - R p_i - t) + c_i . s)^2                                     (1)

With x = [vec R; t; s; 1] every residual is a_i . x, hence f = x^T M x with one moment matrix
M = sum w a a^T (2), for any number of points; sets of captures are sums of matrices. The linear unknowns
minimise (1) in closed form for every R, which leaves f = z^T Q z over z = [vec R; 1] (3), minimised on SO(3)
by Newton's method. vec stacks columns. Every function takes leading batch axes.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, exp_so3, project_to_so3, skew

N_ROTATION = 9
# Limit of Newton steps, and length of the last one, rad: the next would be below double precision.
_MAX_STEPS, _TOLERANCE_RAD = 50, np.sqrt(np.finfo(float).eps)
# Eigenvalues of the linear block below this fraction of the largest count as unobserved.
_RELATIVE_FLOOR = 1e-12


def vec_rotation(R: Array) -> Array:
    """Stack the columns of R (..., 3, 3) into (..., 9)."""
    return np.swapaxes(R, -1, -2).reshape(*R.shape[:-2], N_ROTATION)


def with_one(vectors: Array) -> Array:
    """Append the constant 1 to vectors (..., m)."""
    return np.concatenate([vectors, np.ones((*vectors.shape[:-1], 1))], axis=-1)


def tangent_basis(R: Array) -> Array:
    """Differentiate x = [vec R; t; d; 1] by the tangent (translation, rotation, d), R = exp(phi^) R (3, 3).

    Returns:
        (14, 7).
    """
    J = np.zeros((14, 7))
    # vec R moves by vec(e_k^ R).
    J[:N_ROTATION, 3:6] = vec_rotation(skew(np.eye(3)) @ R).T
    J[N_ROTATION:12, :3], J[12, 6] = np.eye(3), 1
    return J


def eliminate_linear(M: Array) -> tuple[Array, Array]:
    """Minimise over t and s in closed form (Schur complement), equation (3).

    Directions that no residual sees are left at zero.

    Args:
        M: (..., m, m) moments.

    Returns:
        Q (..., 10, 10), and L (..., m - 10, 10) with [t; s] = L z.
    """
    rest = np.r_[:N_ROTATION, M.shape[-1] - 1]
    linear = np.arange(N_ROTATION, M.shape[-1] - 1)
    cross = M[..., linear[:, None], rest]
    values, vectors = np.linalg.eigh(M[..., linear[:, None], linear])
    is_seen = values > _RELATIVE_FLOOR * values[..., -1:]
    inverse = np.where(is_seen, 1.0 / np.where(is_seen, values, 1.0), 0.0)
    L = -(vectors * inverse[..., None, :]) @ (np.swapaxes(vectors, -1, -2) @ cross)
    Q = M[..., rest[:, None], rest] + np.swapaxes(cross, -1, -2) @ L
    return (Q + np.swapaxes(Q, -1, -2)) / 2, L


def rotation_cost(Q: Array, R: Array) -> Array:
    """Evaluate f = z^T Q z at R (..., 3, 3)."""
    z = with_one(vec_rotation(R))
    return np.asarray(np.sum(z * (Q @ z[..., None])[..., 0], axis=-1))


def linear_unknowns(L: Array, R: Array) -> Array:
    """Evaluate [t; s] = L z at R (..., 3, 3)."""
    return np.asarray((L @ with_one(vec_rotation(R))[..., None])[..., 0])


def rotation_from_directions(targets: Array, sources: Array) -> Array:
    """Find the R that best rotates the source directions onto the target directions (Wahba's problem).

    Args:
        targets: (..., n, 3).
        sources: (..., n, 3).

    References:
        Wahba, "A least squares estimate of satellite attitude", SIAM Review, 1965.
    """
    return project_to_so3(np.swapaxes(targets, -1, -2) @ sources)


def cube_rotations() -> Array:
    """List the 24 rotations of a cube, a cover of SO(3) by balls of 62.8 deg."""
    signs = np.stack(np.meshgrid(*[[1.0, -1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    permutations = np.eye(3)[[[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]]
    signed = (permutations[:, None] * signs[None]).reshape(-1, 3, 3)
    return np.asarray(signed[np.linalg.det(signed) > 0])


def minimise_on_so3(Q: Array, R_start: Array) -> tuple[Array, Array]:
    """Minimise z^T Q z over SO(3) by damped Newton steps R <- R exp(w^), saddle-free where not convex.

    Args:
        Q: (B, 10, 10).
        R_start: (B, 3, 3).

    Returns:
        R (B, 3, 3) and f (B,) at it.
    """
    R = np.array(R_start, dtype=np.float64)
    Q = np.broadcast_to(Q, (len(R), 10, 10))
    trace = np.trace(Q, axis1=-2, axis2=-1)
    cost, gradient, hessian = _expand(Q, R)
    damping = np.zeros(len(R))
    active = np.arange(len(R))
    for _ in range(_MAX_STEPS):
        if len(active) == 0:
            break
        step, is_convex = _newton_step(hessian[active], gradient[active], damping[active])
        length = np.linalg.norm(step, axis=-1)
        candidate = R[active] @ exp_so3(step)
        new_cost, new_gradient, new_hessian = _expand(Q[active], candidate)
        # Near the minimum rounding dominates f, so accept Newton's step without comparing costs.
        is_tiny = is_convex & (damping[active] == 0) & (length < 1e-6)
        is_better = (new_cost <= cost[active] * (1 + 1e-14) + 1e-15 * trace[active]) | is_tiny
        taken = active[is_better]
        R[taken], cost[taken] = candidate[is_better], new_cost[is_better]
        gradient[taken], hessian[taken] = new_gradient[is_better], new_hessian[is_better]
        scale = trace[active]
        relaxed = np.where(damping[active] > 1e-10 * scale, 0.1 * damping[active], 0.0)
        raised = np.maximum(10 * damping[active], 1e-3 * scale)
        damping[active] = np.where(is_better, relaxed, raised)
        is_done = (is_better & (length < _TOLERANCE_RAD)) | (damping[active] > 1e12 * scale)
        active = active[~is_done]
    return R, cost


def _expand(Q: Array, R: Array) -> tuple[Array, Array, Array]:
    """Compute f, half its gradient (B, 3) and half its Hessian (B, 3, 3) of f(R exp(w^)) at w = 0."""
    z = with_one(vec_rotation(R))
    y = (Q @ z[..., None])[..., 0]
    Y = np.swapaxes(y[..., :9].reshape(*y.shape[:-1], 3, 3), -1, -2)
    A = np.swapaxes(R, -1, -2) @ Y
    gradient = np.stack(
        [A[..., 2, 1] - A[..., 1, 2], A[..., 0, 2] - A[..., 2, 0], A[..., 1, 0] - A[..., 0, 1]], axis=-1
    )
    # Columns vec(R e_k^) of the derivative of vec R.
    G = np.zeros((*R.shape[:-2], 9, 3))
    c0, c1, c2 = R[..., :, 0], R[..., :, 1], R[..., :, 2]
    G[..., 3:6, 0], G[..., 6:9, 0] = c2, -c1
    G[..., 0:3, 1], G[..., 6:9, 1] = -c2, c0
    G[..., 0:3, 2], G[..., 3:6, 2] = c1, -c0
    second_order = (A + np.swapaxes(A, -1, -2)) / 2 - np.trace(A, axis1=-2, axis2=-1)[
        ..., None, None
    ] * np.eye(3)
    hessian = np.swapaxes(G, -1, -2) @ (Q[..., :9, :9] @ G) + second_order
    return np.sum(z * y, axis=-1), gradient, hessian


def _newton_step(hessian: Array, gradient: Array, damping: Array) -> tuple[Array, NDArray[Any]]:
    """Solve for the damped step (B, 3), at most 1 rad long, and mark positive Hessians."""
    values, vectors = np.linalg.eigh(hessian)
    is_convex = values[:, 0] + damping > 0
    size = np.abs(values)
    # Absolute eigenvalues direct the step away from a saddle; the floor keeps it finite along flat
    # directions.
    floored = np.maximum(size, 1e-3 * size.max(axis=1, keepdims=True)) + 1e-300
    size = np.where(is_convex[:, None], values, floored) + damping[:, None]
    along = np.swapaxes(vectors, 1, 2) @ gradient[..., None]
    step = -(vectors @ (along / size[..., None]))[..., 0]
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    return step / np.maximum(length, 1.0), is_convex
