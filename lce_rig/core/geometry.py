"""Rotations and poses as plain arrays.

`T_a_b` is a (4, 4) array that takes points from frame b to frame a. A tangent vector is
(translation m, rotation rad) with R = exp(phi^) R0 and t = t0 + tau, the order and meaning of
ROS PoseWithCovariance. Every function takes leading batch axes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FARTHEST_M = 1e6
"""No pose of a rig is so far from another."""
SIGMA_PER_MAD = 1.4826
"""Standard deviation of normal noise over its median magnitude."""
HUBER = 1.5
"""Number of standard deviations beyond which an error's weight decreases (95 % efficient)."""
SURPRISING_CHI2 = 16.81
"""Chi-squared, of six degrees of freedom, of poses above which they differ: 99 %."""
EVEN_STEPS = (1 / 1.2207440846057596) ** np.arange(1, 4)
"""Steps whose multiples, modulo 1, fill a unit cube and each of its axes evenly: powers of 1/g, g^4 = g + 1.

M. Roberts, The unreasonable effectiveness of quasirandom sequences, 2018.
"""
# Degrees of freedom of the Student distribution that weights poses, as some may be outliers.
_STUDENT = 5.0


def skew(v: Array) -> Array:
    """Build v^, the matrix with v^ w = v x w.

    Args:
        v: (..., 3).
    """
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exp_so3(phi: Array) -> Array:
    """Compute R = exp(phi^) by Rodrigues' formula, exact at zero.

    Args:
        phi: (..., 3) rotation vector, rad.
    """
    phi = np.asarray(phi, dtype=np.float64)
    angle2 = np.sum(phi * phi, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle2 < 1e-8
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(safe)) / (safe * safe))
    k = skew(phi)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def log_so3(R: Array) -> Array:
    """Compute phi with R = exp(phi^), |phi| <= pi.

    Args:
        R: (..., 3, 3).
    """
    from scipy.spatial.transform import Rotation

    R = np.asarray(R, dtype=np.float64)
    flat = R.reshape(-1, 3, 3)
    phi: Array = Rotation.from_matrix(flat).as_rotvec().reshape(*R.shape[:-2], 3)
    return phi


def project_to_so3(A: Array) -> Array:
    """Find the rotation nearest to A in the Frobenius norm.

    Args:
        A: (..., 3, 3).
    """
    U, _, Vt = np.linalg.svd(A)
    U = U.copy()
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return np.asarray(U @ Vt)


def rotation_angle(R_1: Array, R_2: Array) -> Array:
    """Compute the angle between two rotations in rad, accurate for tiny angles.

    Args:
        R_1: (..., 3, 3).
        R_2: (..., 3, 3).
    """
    half_sine = np.linalg.norm(np.asarray(R_1) - R_2, axis=(-2, -1)) / np.sqrt(8.0)
    return np.asarray(2.0 * np.arcsin(np.clip(half_sine, 0.0, 1.0)))


def pose(R: Array, t: Array) -> Array:
    """Build T from R (..., 3, 3) and t (..., 3)."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    shape = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


T_BODY_OPTICAL = pose(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
"""REP-103: z forward, x right, y down in the optical frame; x forward, y left, z up in the camera's own."""


ROUNDING = 5e-3
"""Tolerance on a rotation from a file: printed with few digits, a quaternion's norm is off by 1e-3."""


def parse_pose(value: Any, rounding: float = 1e-6) -> Array:
    """Build a pose from parsed text: four lists of four numbers.

    Args:
        value: parsed value of any type.
        rounding: tolerance on the entries of its rotation, for numbers printed with few digits.

    Returns:
        (4, 4), with its rotation orthonormalised.

    Raises:
        ValueError: not a pose; the message continues after the value's name.
    """
    is_matrix = isinstance(value, list) and len(value) == 4
    if not is_matrix or not all(isinstance(row, list) and len(row) == 4 for row in value):
        raise ValueError("is missing or no 4x4 matrix of numbers")
    if not all(type(figure) in (int, float) and abs(figure) <= FARTHEST_M for row in value for figure in row):
        raise ValueError("is missing or no 4x4 matrix of numbers")
    T = np.array(value, dtype=np.float64)
    R = project_to_so3(T[:3, :3])
    if np.abs(R - T[:3, :3]).max() > rounding or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise ValueError("is no rigid transform")
    T[:3, :3] = R
    return T


def invert(T_a_b: Array) -> Array:
    """Compute T_b_a (..., 4, 4)."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return pose(R_b_a, -(R_b_a @ T_a_b[..., :3, 3:])[..., 0])


def transform(T_a_b: Array, points_b: NDArray[Any]) -> Array:
    """Transform points from frame b to frame a: p_a = R p_b + t.

    Args:
        T_a_b: (..., 4, 4).
        points_b: (..., N, 3) in m.
    """
    R_a_b = T_a_b[..., :3, :3]
    return np.asarray(points_b @ np.swapaxes(R_a_b, -1, -2) + T_a_b[..., None, :3, 3], dtype=np.float64)


def perturb(T: Array, tangent: Array) -> Array:
    """Apply a tangent (translation m, rotation rad): R = exp(phi^) R0, t = t0 + tau.

    Args:
        T: (..., 4, 4).
        tangent: (..., 6).
    """
    return pose(exp_so3(tangent[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] + tangent[..., :3])


def difference(T_1: Array, T_2: Array) -> Array:
    """Compute the tangent (..., 6) that takes T_2 to T_1, the inverse of `perturb`."""
    phi = log_so3(T_1[..., :3, :3] @ np.swapaxes(T_2[..., :3, :3], -1, -2))
    return np.concatenate([T_1[..., :3, 3] - T_2[..., :3, 3], phi], axis=-1)


def tangent_sizes(tangent: Array) -> tuple[float, float]:
    """Compute the angle in deg and the distance in m of a tangent (6,)."""
    return float(np.degrees(np.linalg.norm(tangent[3:]))), float(np.linalg.norm(tangent[:3]))


def sigma_sizes(cov: Array) -> tuple[float, float]:
    """Return the roots of the summed variances, rotation in deg and translation in m, of a tangent.

    Args:
        cov: (6 + k, 6 + k), the tangent first.
    """
    rotation, translation = np.trace(cov[3:6, 3:6]), np.trace(cov[:3, :3])
    # Rounding may leave zero variances slightly negative.
    rotation, translation = max(rotation, 0.0), max(translation, 0.0)
    return float(np.degrees(np.sqrt(rotation))), float(np.sqrt(translation))


def largest_sizes(cov: Array) -> tuple[float, float]:
    """Return the rotation (deg) and translation (m) that a tangent exceeds with a probability of 5 %.

    The squared size, of mean tr C and variance 2 tr C^2, is taken as g chi2 with h degrees of freedom,
    g = tr C^2 / tr C, h = tr(C)^2 / tr C^2 (Satterthwaite).

    Args:
        cov: (6 + k, 6 + k), the tangent first.
    """
    from scipy.special import chdtri

    sizes = []
    for part in (cov[3:6, 3:6], cov[:3, :3]):
        total, squares = np.trace(part), np.trace(part @ part)
        sizes.append(np.sqrt(squares / total * chdtri(total**2 / squares, 0.05)))
    return float(np.degrees(sizes[0])), float(sizes[1])


def chance_of(chi2: float, n_freedoms: float) -> float:
    """Compute the probability that a chi-squared variable of `n_freedoms` exceeds `chi2`."""
    from scipy.special import chdtrc

    return float(chdtrc(n_freedoms, chi2))


@dataclass(frozen=True, eq=False)
class PoseDifference:
    """The difference of two poses, compared with its covariance.

    Attributes:
        tangent: (6,) from one to the other (translation m, rotation rad).
        cov: (6, 6) of the tangent if both are right.
    """

    tangent: Array
    cov: Array

    @property
    def chi2(self) -> float:
        """Squared Mahalanobis distance."""
        return float(self.tangent @ np.linalg.solve(self.cov, self.tangent))

    @property
    def chance(self) -> float:
        """Probability of a difference this large or larger if the poses are equal."""
        return chance_of(self.chi2, 6)

    @property
    def is_significant(self) -> bool:
        """Whether a difference this large occurs by chance in at most 1 % of cases."""
        return self.chi2 > SURPRISING_CHI2

    @property
    def sizes(self) -> dict[str, float]:
        """Angle and distance, as figures of a finding."""
        rotation_deg, translation_m = tangent_sizes(self.tangent)
        return {"rotation_deg": rotation_deg, "translation_m": translation_m}


def shortened(points: NDArray[Any], by_m: float) -> Array:
    """Shorten points (N, 3) along their rays towards the origin; one at the origin becomes NaN."""
    points = np.asarray(points, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(points * (1 - by_m / np.linalg.norm(points, axis=1))[:, None])


def fit_plane(points: NDArray[Any]) -> tuple[Array, float]:
    """Fit n.p + d = 0 by least squares, n towards the origin of the points' frame (d >= 0).

    Args:
        points: (N, 3) with N >= 3, m.

    Returns:
        Plane (4,) as (n, d) with unit n, and the rms distance of the points in m.
    """
    points = np.asarray(points, dtype=np.float64)
    centre = points.mean(axis=0)
    spread = points - centre
    _, eigenvectors = np.linalg.eigh(spread.T @ spread)
    normal = eigenvectors[:, 0]
    d = -float(normal @ centre)
    if d < 0:
        normal, d = -normal, -d
    rms = float(np.sqrt(np.mean((spread @ normal) ** 2)))
    return np.append(normal, d), rms


def mean_pose(
    T: Array,
    information: Array,
    T_start: Array | None = None,
    weigh: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array]:
    """Find the pose with minimum sum_k w_k x_k^T W_k x_k, where x_k is the tangent from it to pose k.

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
    for _ in range(20):
        apart = difference(T, mean)
        if weigh is not None:
            weight = weigh(np.einsum("ki,kij,kj->k", apart, information, apart))
        weighted = weight[:, None, None] * information
        step = np.linalg.solve(weighted.sum(axis=0), np.einsum("kij,kj->i", weighted, apart))
        mean = perturb(mean, step)
        if np.linalg.norm(step) < 1e-10:  # m and rad, far below any noise
            break
    return mean, weight


def student_weights(chi2: Array) -> Array:
    """Compute robust weights of poses (K,) for `mean_pose` from their squared distances from the mean."""
    return np.asarray((_STUDENT + 6) / (_STUDENT + chi2))


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


def composition_slopes(T_a_b: Array, T_b_c: Array) -> tuple[Array, Array]:
    """Differentiate T_a_b T_b_c (4, 4) by the tangents of both, (6, 6) each."""
    R, by_first = T_a_b[:3, :3], np.eye(6)
    by_first[:3, 3:] = -skew(R @ T_b_c[:3, 3])
    return by_first, np.asarray(np.kron(np.eye(2), R))


def relative_covariance(J: Array, cov_second: Array, cov_first: Array) -> Array:
    """Propagate covariances of two poses with independent errors to that of `relative_pose` (..., 6, 6).

    Args:
        J: (..., 6, 12) derivatives from `relative_pose`.
        cov_second: (..., 6, 6) of the second pose.
        cov_first: covariance of the first pose.
    """
    by_second, by_first = J[..., :6], J[..., 6:]
    return np.asarray(
        by_second @ cov_second @ np.swapaxes(by_second, -1, -2)
        + by_first @ cov_first @ np.swapaxes(by_first, -1, -2)
    )
