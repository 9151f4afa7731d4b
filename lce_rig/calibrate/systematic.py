"""The effect of constant errors on the solution: of the LiDAR's ranges, of the profile's lens and board.

The scatter between captures shows their noise. A laser whose ranges are all 8 mm too long has the same error
in each capture: it causes no scatter, but moves the extrinsics.
"""

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.algorithm_1.algorithm import Algorithm1
from lce_rig.calibrate.algorithm_1.moments import Problem
from lce_rig.calibrate.features import CaptureFeatures, extract_features, features_of_lidar
from lce_rig.calibrate.quadratics import symmetric_inverse
from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.calibrate.tolerances import Sensitivity, Tolerances, sensitivities_of, vary
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard

# Of the order of the errors themselves, so that the difference quotient represents their effect.
STEP_M = 0.005
# Captures at once: few, as every ring of a capture makes another one.
_CHUNK = 256


def ring_sensitivities(start: Algorithm1, board: Board) -> Array:
    """Differentiate the solution by the range offset of each ring, by one Newton step.

    With half gradient g and half Hessian H of the cost, both at the solution, a range error b in
    ring r move the minimum by

        s_r b = -H^-1 sum_k (g_k(ranges of ring r + b) - g_k)                                            (1)

    A ring that a capture does not see does not change its g_k: only (capture, ring) pairs that occur are
    built, as captures of one large problem. To first order an offset common to all rings moves the minimum
    by the sum of all s_r.

    Args:
        start: the solution; its association is held.
        board: the board.

    Returns:
        (7, L): a column for each of the L rings seen, tangent (translation m, rotation rad, edge shift m)
        per m of range.
    """
    boards = [observation.lidar for observation in start.fitted]
    rings = [np.union1d(lidar.ring, lidar.edge_ring) for lidar in boards]
    ring, column = np.unique(np.concatenate(rings), return_inverse=True)
    shifted = (
        (k, replace(f, **features_of_lidar(lidar)))
        for k, f in enumerate(extract_features(observation, board) for observation in start.fitted)
        for lidar in shift_rings(boards[k], rings[k], STEP_M)
    )
    change = np.zeros((len(ring), len(start.cost.information)))
    np.add.at(change, column, _changes(shifted, board, start) / STEP_M)
    return np.asarray(-symmetric_inverse(start.cost.information) @ change.T)


def profile_sensitivities(
    start: Algorithm1, board: Board, known: Tolerances, lens: SessionLens | None
) -> tuple[Sensitivity, ...]:
    """Differentiate the solution by errors of lens and board, as (1) does by range offsets.

    Args:
        start, board: as of `ring_sensitivities`.
        known: standard deviations of the board.
        lens: of the session.
    """
    variants = vary(start.fitted, board, lens, bends_scans=True)
    changes = []
    for variant in variants:
        features = (extract_features(o, variant.board) for o in variant.apply(start.fitted))
        changes.append(_changes(enumerate(features), variant.board, start).sum(axis=0))
    moves = -np.array(changes) @ symmetric_inverse(start.cost.information)[:, :6]
    return sensitivities_of(variants, moves, known)


def _changes(features: Iterable[tuple[int, CaptureFeatures]], board: Board, start: Algorithm1) -> Array:
    """Compute by how much half gradients (n, 7) differ from those of the captures as observed.

    Args:
        features: n numbers of captures, and their features as they would be with some error.
        board: that is assumed.
        start: as of `ring_sensitivities`.
    """
    problem, x, edge_ids = start.problem, start.solution.x[0], start.solution.edge_ids[0]
    gradients = problem.quadratics(x, edge_ids).gradients
    own_ids = np.split(edge_ids, np.searchsorted(problem.edge_capture, np.arange(1, problem.n_captures)))
    source, differences = iter(features), []
    while chunk := list(islice(source, _CHUNK)):
        captures = [k for k, _ in chunk]
        keep = None if problem.keep is None else [problem.keep[k] for k in captures]
        moved = Problem([f for _, f in chunk], board, problem.weights, keep)
        ids = np.concatenate([own_ids[k] for k in captures])
        differences.append(moved.quadratics(x, ids).gradients - gradients[captures])
    return np.concatenate(differences)


def shift_rings(lidar: LidarBoard, rings: NDArray[np.int16], offset_m: float) -> list[LidarBoard]:
    """Lengthen the ranges of one ring at a time, and refit the plane.

    The plane m . p = 1, with m = -n / d, predicts ranges r_i = 1 / (m . u_i) along the rays u_i. Fitted to
    them by least squares, range errors b_i change it to first order by

        dm = (sum J_i^T J_i)^-1 sum J_i^T b_i,    J_i = -r_i^2 u_i^T                                     (2)

    Args:
        lidar: a board as measured.
        rings: (L,) ring numbers.
        offset_m: added to every range of the ring.

    Returns:
        The board with the points and ring ends of each ring moved along their rays, and the plane refitted.
    """
    rays = lidar.points / np.linalg.norm(lidar.points, axis=1, keepdims=True)
    end_rays = lidar.edge_points / np.linalg.norm(lidar.edge_points, axis=1, keepdims=True)
    m = -lidar.plane[:3] / lidar.plane[3]
    jacobian = -rays / (rays @ m)[:, None] ** 2
    is_ring, is_end = lidar.ring == rings[:, None], lidar.edge_ring == rings[:, None]
    m_moved = m + offset_m * (is_ring @ jacobian) @ symmetric_inverse(jacobian.T @ jacobian)
    planes = np.column_stack([-m_moved, np.ones(len(rings))])
    planes /= np.linalg.norm(m_moved, axis=1, keepdims=True)
    return [
        replace(
            lidar,
            points=lidar.points + offset_m * moved[:, None] * rays,
            edge_points=lidar.edge_points + offset_m * moved_ends[:, None] * end_rays,
            plane=plane,
        )
        for plane, moved, moved_ends in zip(planes, is_ring, is_end, strict=True)
    ]


def systematic_covariances(
    sensitivities: Array, sigma_each: float, sigma_common: float
) -> tuple[Array, Array]:
    """Propagate errors common to all groups, which the scatter between groups cannot show.

    Source r is off by e + e_r, with e the mean error of all L sources and e_r its own deviation from it, and
    moves the estimate by s_r for each unit. Independent deviations less their mean leave

        cov = sigma_each^2 sum_r (s_r - s) (s_r - s)^T + sigma_common^2 L^2 s s^T,   s = sum_r s_r / L

    Args:
        sensitivities: (..., p, L) s_r in columns.
        sigma_each: standard deviation of e_r, before their mean is subtracted.
        sigma_common: standard deviation of e.

    Returns:
        Its two terms (..., p, p).
    """
    common = sensitivities.sum(axis=-1, keepdims=True)
    each = sensitivities - sensitivities.mean(axis=-1, keepdims=True)
    of_each = sigma_each**2 * each @ np.swapaxes(each, -1, -2)
    return of_each, sigma_common**2 * common @ np.swapaxes(common, -1, -2)
