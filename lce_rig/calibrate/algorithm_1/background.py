"""Shift of ring ends caused by the background: in front of it, the board seems to end earlier.

A beam that hits both board and background reports the stronger echo. The brighter and nearer the background,
the earlier the board is lost. If the background is so near that both echoes merge, the range is off the
board's plane. Recordings show 17 mm times the background's share of the power (docs/method.md).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.plane_and_ends import (
    EDGE_SHIFT_SIGMA_M,
    CaptureFeatures,
    describe_background,
    end_residuals,
    end_rows,
)
from lce_rig.calibrate.quadratics import Quadratics, jackknife_scatter, symmetric_inverse
from lce_rig.core.geometry import HUBER, Array
from lce_rig.core.results import Observation

BACKGROUND_SIGMAS_M = (EDGE_SHIFT_SIGMA_M, 0.01, EDGE_SHIFT_SIGMA_M)
"""Prior standard deviations of the shifts, in the order of `describe_background`."""
# Prior standard deviations of the extrinsics around which the shifts are estimated.
_SIGMA_TRANSLATION_M, _SIGMA_ROTATION_RAD = 0.02, 0.01
_N_SHIFTS = len(BACKGROUND_SIGMAS_M)
_END_SIGMA_M = 0.003  # noise of a ring end
_ROUNDS = 5
# Groups of columns tested for significance: all, far background, near background.
_TOGETHER = ((0, 1, 2), (0,), (1, 2))
# Minimum number of captures in which a column differs from 0.
_MIN_CAPTURES = 5
# Significance: chance produces such shifts in at most one of this number of sessions.
_ONE_IN = 1000


def estimate_shifts(
    observations: Sequence[Observation], features: Sequence[CaptureFeatures], T_cam_lidar: Array
) -> Array:
    """Estimate how far each column of `describe_background` shifts ring ends, outwards: (3,) m.

    Zero if not significant. Robust least squares over all ring ends, with the extrinsics, the beam's
    width and the shifts unknown.

    Args:
        observations: F captures.
        features: fitted features of each capture.
        T_cam_lidar: (4, 4) near the truth.
    """
    from scipy.special import fdtri

    parts = [end_rows(f, T_cam_lidar) for f in features]
    first = np.flatnonzero(np.concatenate([np.arange(len(r)) == 0 for r, _, _ in parts]))
    inside = np.concatenate([r for r, _, _ in parts])
    background = np.concatenate([describe_background(observation.lidar) for observation in observations])
    # Inside distance = - (change of the extrinsics) - beam's width - shifts.
    by_pose_and_width = np.concatenate([J[:, :7] for _, J, _ in parts])
    A = -np.column_stack([by_pose_and_width, background])
    # The scatter of columns with few captures is unreliable: they stay zero, like insignificant ones.
    n_having = np.count_nonzero(np.add.reduceat(background, first, axis=0) > 0, axis=0)
    free = n_having >= _MIN_CAPTURES
    while free.any():
        shifts, scatter = _fit_shifts(A, inside, first, free)
        is_sure = np.zeros(_N_SHIFTS, dtype=bool)
        for group in _TOGETHER:
            columns = np.array([column for column in group if free[column]], dtype=int)
            if len(columns):
                # Hotelling's test.
                freedoms, n_left = len(columns), n_having[columns].max() - len(columns)
                T2 = shifts[columns] @ symmetric_inverse(scatter[np.ix_(columns, columns)]) @ shifts[columns]
                limit = fdtri(freedoms, n_left, 1 - 1 / _ONE_IN) * freedoms * (n_left + freedoms - 1) / n_left
                is_sure[columns] |= limit < T2
        if is_sure[free].all():
            return shifts
        free = is_sure
    return np.zeros(_N_SHIFTS)


def _fit_shifts(
    A: Array, inside_m: Array, first: NDArray[np.intp], free: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Solve A x = inside distances (M,) robustly: the shifts (3,), and their scatter (3, 3) over captures.

    Captures begin at the rows `first`; shifts that are not free (3,) are zero.
    """
    extrinsic = np.repeat([_SIGMA_TRANSLATION_M, _SIGMA_ROTATION_RAD], 3)
    sigmas = np.concatenate([extrinsic, [EDGE_SHIFT_SIGMA_M], BACKGROUND_SIGMAS_M])
    A = A * np.concatenate([np.ones(7), free])
    prior, x = np.diag(np.square(_END_SIGMA_M / sigmas)), np.zeros(len(sigmas))
    for _ in range(_ROUNDS):
        weights = 1 / np.maximum(np.abs(inside_m - A @ x) / (HUBER * _END_SIGMA_M), 1.0)
        information = A.T @ (weights[:, None] * A) + prior
        x = np.linalg.solve(information, A.T @ (weights * inside_m))
    gradients = np.add.reduceat(A * (weights * (A @ x - inside_m))[:, None], first, axis=0)
    hessians = np.add.reduceat(A[:, :, None] * (weights[:, None] * A)[:, None, :], first, axis=0)
    cost = Quadratics(gradients, hessians, prior, prior @ x, np.arange(len(first)))
    scatter = jackknife_scatter(cost.moves())
    return x[-_N_SHIFTS:], scatter[-_N_SHIFTS:, -_N_SHIFTS:]


def move_ends(
    observations: Sequence[Observation],
    features: Sequence[CaptureFeatures],
    T_cam_lidar: Array,
    shifts_m: Array,
) -> list[Observation]:
    """Subtract the shifts (3,) of `estimate_shifts` from ring ends."""
    moved = []
    for observation, f in zip(observations, features, strict=True):
        _, edge = end_residuals(f, T_cam_lidar)
        outwards = f.edge_normals[edge] @ T_cam_lidar[:3, :3]
        shift = (describe_background(observation.lidar) @ shifts_m)[:, None] * outwards
        lidar = replace(observation.lidar, edge_points=observation.lidar.edge_points - shift)
        moved.append(replace(observation, surface=lidar))
    return moved
