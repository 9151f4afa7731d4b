"""Proof by Lagrangian duality that a rotation is the global minimum of z^T Q z over SO(3).

SO(3) is the set of z = [vec R; 1] with z^T A_i z = 0 for 21 constant matrices A_i: orthonormal columns,
orthonormal rows and handedness. For any multipliers l and any bound g the matrix

    Z = Q + sum l_i A_i - g e e^T,   e = (0, ..., 0, 1)                                              (1)

gives f(R) = g + z^T Z z >= g + 4 min(eig Z, 0) on SO(3), since |z|^2 = 4. With R* the candidate and E its z,

    f(R*) - min f <= f(R*) - g + 4 (max(-lambda, 0) + |Z E|)                                         (2)

where lambda is the least eigenvalue of Z on the complement of E. After rotating the problem so that R* = I,
E, the pseudo-inverse that solves Z E = 0 for the multipliers, and the family N_j of multipliers that leave
Z E alone are constants. Multipliers of least norm are tried first, then those that maximise lambda within the
family, by a barrier method.

(2) holds whether or not any of this has converged. It does not measure how well the minimum is determined.

References:
    Briales, Gonzalez-Jimenez, "Convex global 3D registration with Lagrangian duality", CVPR 2017.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.algorithm_1.registration import (
    cube_rotations,
    minimise_on_so3,
    rotation_cost,
)
from lce_rig.core.geometry import Array

# Largest gap at a global minimum, relative to its cost: far below the effect of noise.
_RELATIVE_GAP = 1e-6
# Largest gap for costs near zero, relative to the trace of Q: rounding of double precision, with margin.
_ROUNDING = 1e-11
_BARRIER_STEPS = 60


@dataclass(frozen=True, eq=False)
class Certificates:
    """Bounds for a batch of candidates.

    Attributes:
        gap: (B,) bound (2) on f - min f.
        cost: (B,) f.
        is_optimal: (B,) whether gap is below the tolerance, relative to f, or below rounding.
    """

    gap: Array
    cost: Array
    is_optimal: NDArray[np.bool_]

    @property
    def relative_gap(self) -> Array:
        """The gap as a share of the cost (B,)."""
        return np.asarray(self.gap / np.maximum(self.cost, 1e-300))


def certify(Q: Array, R: Array) -> Certificates:
    """Bound how far each R may be from the global minimum of z^T Q z.

    Args:
        Q: (B, 10, 10).
        R: (B, 3, 3) candidates from `minimise_on_so3`.
    """
    cost = rotation_cost(Q, R)
    tolerance = _RELATIVE_GAP * cost + _ROUNDING * np.trace(Q, axis1=-2, axis2=-1)
    Z, bound, stationarity = _least_norm_dual(Q, R)

    def gap_at(eigenvalue: Array, rows: NDArray[np.intp]) -> Array:
        slack = np.maximum(-eigenvalue, 0) + stationarity[rows]
        return np.asarray(np.maximum(cost[rows] - bound[rows], 0) + 4 * slack)  # equation (2)

    gap = gap_at(_least_eigenvalue(Z), np.arange(len(Z)))
    # No multipliers exist for an R that is not stationary.
    left = np.flatnonzero((gap > tolerance) & (4 * stationarity <= tolerance))
    if len(left):
        gap[left] = np.minimum(gap[left], gap_at(_raise_least_eigenvalue(Z[left]), left))
    return Certificates(gap, cost, gap <= tolerance)


def solve_globally(Q: Array, R_start: Array) -> tuple[Array, Certificates]:
    """Minimise z^T Q z over SO(3); uncertified starts are retried from the 24 rotations of a cube.

    Args:
        Q: (B, 10, 10).
        R_start: (B, 3, 3).

    Returns:
        R (B, 3, 3) and its certificates.
    """
    R, _ = minimise_on_so3(Q, R_start)
    certificates = certify(Q, R)
    left = np.flatnonzero(~certificates.is_optimal)
    if len(left) == 0:
        return R, certificates
    starts = np.concatenate(
        [np.tile(cube_rotations(), (len(left), 1, 1)).reshape(len(left), 24, 3, 3), R[left, None]], 1
    )
    n = starts.shape[1]
    candidates, cost = minimise_on_so3(np.repeat(Q[left], n, axis=0), starts.reshape(-1, 3, 3))
    best = np.argmin(cost.reshape(-1, n), axis=1)
    R[left] = candidates.reshape(-1, n, 3, 3)[np.arange(len(left)), best]
    return R, certify(Q, R)


@dataclass(frozen=True, eq=False)
class _Dual:
    """Constants of the dual problem at R* = I.

    Attributes:
        at_identity: (10,) E.
        complement: (10, 9) orthonormal basis P of the complement of E.
        stationarity: (10, 22) C with C (l, g) = -Q E <=> Z E = 0.
        pseudo_inverse: (22, 10) of C.
        particular: (10, 9, 9) P^T (sum over (l, g) = C^+ e_i of the matrices) P.
        family: (m, 9, 9) orthonormal basis of P^T N P over multipliers that leave Z E alone.
    """

    at_identity: Array
    complement: Array
    stationarity: Array
    pseudo_inverse: Array
    particular: Array
    family: Array


@cache
def _dual() -> _Dual:
    E = np.zeros(10)
    E[[0, 4, 8, 9]] = 1
    bound = np.zeros((1, 10, 10))
    bound[0, 9, 9] = -1
    matrices = np.concatenate([_constraints(), bound])
    C = (matrices @ E).T
    P = np.linalg.svd(E[None])[2][1:].T
    pseudo_inverse = np.linalg.pinv(C)
    restricted = P.T @ matrices @ P
    rank = np.linalg.matrix_rank(C)
    null = np.linalg.svd(C)[2][rank:]
    spanned = np.tensordot(null, restricted, axes=1).reshape(len(null), 81)
    _, singular, basis = np.linalg.svd(spanned, full_matrices=False)
    family = basis[singular > 1e-9].reshape(-1, 9, 9)
    particular = np.tensordot(pseudo_inverse.T, restricted, axes=1)
    return _Dual(E, P, C, pseudo_inverse, particular, (family + family.swapaxes(1, 2)) / 2)


def _constraints() -> Array:
    """Build A_i (21, 10, 10) with z^T A_i z = 0 on SO(3)."""
    matrices = []
    for i in range(3):
        for j in range(i, 3):
            for is_row in (False, True):
                A = np.zeros((10, 10))
                for k in range(3):
                    a, b = (3 * k + i, 3 * k + j) if is_row else (3 * i + k, 3 * j + k)
                    A[a, b] += 0.5
                    A[b, a] += 0.5
                A[9, 9] = -1.0 if i == j else 0.0
                matrices.append(A)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # column i x column j = column k
        for m in range(3):
            p, q = (m + 1) % 3, (m + 2) % 3
            A = np.zeros((10, 10))
            A[3 * i + p, 3 * j + q], A[3 * i + q, 3 * j + p], A[3 * k + m, 9] = 1, -1, -1
            matrices.append((A + A.T) / 2)
    return np.stack(matrices)


def _least_norm_dual(Q: Array, R: Array) -> tuple[Array, Array, Array]:
    """Find the least-norm multipliers with Z E = 0: P^T Z P (B, 9, 9), g (B,) and |Z E| (B,)."""
    dual = _dual()
    # In R' = R^T R the candidate becomes the identity; vec(R R') = (I kron R) vec R'.
    T = np.zeros((*R.shape[:-2], 10, 10))
    for k in range(3):
        T[..., 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = R
    T[..., 9, 9] = 1
    turned = np.swapaxes(T, -1, -2) @ Q @ T
    wanted = -(turned @ dual.at_identity)
    multipliers = wanted @ dual.pseudo_inverse.T
    Z = dual.complement.T @ turned @ dual.complement + np.tensordot(wanted, dual.particular, axes=1)
    residual = multipliers @ dual.stationarity.T - wanted
    return Z, multipliers[:, -1], np.linalg.norm(residual, axis=-1)


def _least_eigenvalue(Z: Array) -> Array:
    return np.asarray(np.linalg.eigvalsh(Z)[..., 0])


def _raise_least_eigenvalue(Z: Array) -> Array:
    """Maximise s subject to Z + sum c_j N_j >= s I by Newton's method on s + mu log det(. - s I), mu -> 0.

    Returns:
        (B,) the largest least eigenvalue of Z + sum c_j N_j that was found.
    """
    family = _dual().family
    m = len(family)
    scale = np.maximum(np.abs(np.trace(Z, axis1=-2, axis2=-1)) / 9, 1e-300)
    Z = Z / scale[:, None, None]
    c = np.zeros((len(Z), m))
    best = _least_eigenvalue(Z)
    s = best - 1e-2 * (1 + np.abs(best))
    mu = np.full(len(Z), 0.1)
    active = np.arange(len(Z))
    for _ in range(_BARRIER_STEPS):
        slack = Z[active] + np.tensordot(c[active], family, axes=1) - s[active, None, None] * np.eye(9)
        inverse = np.linalg.inv(slack)
        # Derivatives of the slack: N_j along c_j, -I along s.
        W = np.concatenate([inverse[:, None] @ family, -inverse[:, None]], axis=1)
        traces = np.trace(W, axis1=-2, axis2=-1)
        gradient = mu[active, None] * traces
        gradient[:, -1] += 1
        flat, flat_t = W.reshape(-1, m + 1, 81), W.swapaxes(-1, -2).reshape(-1, m + 1, 81)
        hessian = mu[active, None, None] * (flat @ flat_t.swapaxes(-1, -2))
        hessian += 1e-14 * np.trace(hessian, axis1=-2, axis2=-1)[:, None, None] * np.eye(m + 1)
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        decrement = np.sqrt(np.maximum(np.sum(gradient * step, axis=-1) / mu[active], 0))
        step *= np.where(decrement < 0.25, 1.0, 1 / (1 + decrement))[:, None]
        c[active] += step[:, :m]
        eigenvalue = _least_eigenvalue(Z[active] + np.tensordot(c[active], family, axes=1))
        s[active] = np.minimum(s[active] + step[:, m], eigenvalue - 1e-3 * mu[active])
        best[active] = np.maximum(best[active], eigenvalue)
        mu[active] = np.where(decrement < 0.5, 0.2 * mu[active], mu[active])
        active = active[(9 * mu[active] >= 1e-10) & (best[active] <= 0)]
        if len(active) == 0:
            break
    return np.asarray(best * scale)
