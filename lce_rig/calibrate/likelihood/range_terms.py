"""Ranges to boards at given poses, as sums over the returns of each ring in each capture.

A ray u meets the plane n . p = h of the board at r = h / (n . u) and reads, off by the offset o of its
laser and displaced by f theta (the lens, `scans`),

    rho = r - n . f theta / (n . u) + o + noise                                                          (1)

With m = n / h the range r = 1 / (m . u) depends on three numbers a capture, and dr = -(r^2 u) . dm. All
that an estimate needs of the returns of a ring in a capture are therefore the sums of products of

    v = [r^2 u; 1; -n . f / (n . u); residual of (1)]

(7 x 7), however many there are.
"""

from dataclasses import dataclass

import numpy as np

from lce_rig.calibrate.likelihood.scans import N_FIELDS, StackedScans
from lce_rig.core.geometry import Array, skew

_ONE, _SIZE = 3, 5 + N_FIELDS


@dataclass(frozen=True, eq=False)
class RangeSums:
    """Sums of v v^T by capture and ring, at given board poses.

    Attributes:
        sums: (F, L, 7, 7).
        by_pose: (F, 3, 6) derivative K of the range, dr = (r^2 u)^T K y, y the tangent of T_lidar_board.
    """

    sums: Array
    by_pose: Array


def sum_ranges(scans: StackedScans, T_lidar_board: Array, offset_m: Array, lens: Array) -> RangeSums:
    """Sum what the returns say.

    Args:
        scans: rays.
        T_lidar_board: (F, 4, 4) board poses.
        offset_m: (L,) of each ring.
        lens: (2,) theta.
    """
    n, t = T_lidar_board[:, :3, 2], T_lidar_board[:, :3, 3]
    h = np.sum(n * t, axis=1)
    k = scans.capture
    cosine = np.sum(n[k] * scans.rays, axis=1)
    r = h[k] / cosine
    v = np.ones((len(r), _SIZE))
    v[:, :_ONE] = r[:, None] ** 2 * scans.rays
    v[:, _ONE + 1 : -1] = -np.einsum("ni,nij->nj", n[k], scans.fields) / cosine[:, None]
    v[:, -1] = r + v[:, _ONE + 1 : -1] @ lens + offset_m[scans.ring] - scans.range_m
    sums = np.zeros((scans.n_captures * len(scans.rings), _SIZE, _SIZE))
    first = np.flatnonzero(np.diff(scans.group, prepend=-1))
    # Products of columns, each one contiguous: several times faster than outer products of rows.
    i, j = np.triu_indices(_SIZE)
    columns = np.ascontiguousarray(v.T)
    products = np.add.reduceat(columns[i] * columns[j], first, axis=1).T
    sums[scans.group[first, None], i, j] = sums[scans.group[first, None], j, i] = products
    return RangeSums(sums.reshape(scans.n_captures, len(scans.rings), _SIZE, _SIZE), _by_pose(n, t, h))


def _by_pose(n: Array, t: Array, h: Array) -> Array:
    """Differentiate -m = -n / h with dn = phi x n, dh = dn . t + n . tau.

    -dm = n dh / h^2 - dn / h = [n n^T / h^2,  n (n x t)^T / h^2 + n^ / h] [tau; phi]
    """
    h = h[:, None, None]
    by_translation = n[:, :, None] * n[:, None, :] / h**2
    by_rotation = n[:, :, None] * np.cross(n, t)[:, None, :] / h**2 + skew(n) / h
    return np.concatenate([by_translation, by_rotation], axis=2)


def weigh_ranges(ranges: RangeSums, sigma_m: float, sigma_ring_m: float) -> tuple[Array, Array]:
    """Weigh the sums by the noise of single ranges and by errors that a ring's returns in a capture share.

    The returns of one ring in one capture have the covariance sigma^2 I + sigma_ring^2 1 1^T; its inverse is

        (I - k 1 1^T) / sigma^2,    k = sigma_ring^2 / (sigma^2 + n sigma_ring^2)

    Returns:
        The weighted sums (F, L, 7, 7) and the log (F,) of the covariance's determinant.
    """
    n = ranges.sums[..., _ONE, _ONE]
    total = sigma_m**2 + n * sigma_ring_m**2
    shared = ranges.sums[..., _ONE, :]
    k = (sigma_ring_m**2 / total)[..., None, None]
    weighted = (ranges.sums - k * shared[..., :, None] * shared[..., None, :]) / sigma_m**2
    log_volume = np.where(n > 0, (n - 1) * np.log(sigma_m**2) + np.log(total), 0.0)
    return weighted, np.asarray(log_volume.sum(axis=1))


def range_system(ranges: RangeSums, weighted: Array) -> Array:
    """Expand weighted sums into the normal equations of each capture.

    Args:
        ranges: the sums at the poses where the system is wanted.
        weighted: (F, L, 7, 7) from `weigh_ranges`.

    Returns:
        (F, 6 + L + 3, 6 + L + 3): sums of products of [by board pose, by ring offset, by lens, residual].
    """
    F, L = weighted.shape[:2]
    # [by pose; by one ring's offset, by lens, residual] = v^T B, ring by ring.
    B = np.zeros((F, _SIZE, 6 + _SIZE - _ONE))
    B[:, :_ONE, :6] = ranges.by_pose
    B[:, np.arange(_ONE, _SIZE), np.arange(6, 6 + _SIZE - _ONE)] = 1
    total = np.swapaxes(B, 1, 2) @ weighted.sum(axis=1) @ B
    own = np.swapaxes(B, 1, 2) @ np.swapaxes(weighted[:, :, _ONE], 1, 2)
    system = np.zeros((F, 6 + L + N_FIELDS + 1, 6 + L + N_FIELDS + 1))
    common = np.r_[0:6, 6 + L : 6 + L + N_FIELDS + 1]
    pick = np.r_[0:6, 7 : 7 + N_FIELDS + 1]
    system[:, common[:, None], common] = total[:, pick[:, None], pick]
    ring = np.arange(6, 6 + L)
    system[:, common[:, None], ring] = own[:, pick]
    system[:, ring[:, None], common] = np.swapaxes(own[:, pick], 1, 2)
    system[:, ring, ring] = weighted[:, :, _ONE, _ONE]
    return system
