"""Cost of any subset of captures as a sum of moment matrices, minimised for many subsets at once.

Per capture k the cost is

    w_plane mean_i (n_k . (g_k - R p_i - t))^2 + w_edge mean_j (m_e(j) . (h_e(j) - R q_j - t) + d)^2     (1)

over the board's plane (n_k, g_k) and edges (m_e, h_e) as the camera sees them, points p_i and ring ends q_j
of the LiDAR, the edge e(j) nearest to each ring end, and the edge shift d by which ring ends appear beyond
the plate. Means instead of sums, so that a near board does not outweigh a far one by its many points:
all points of a capture share the errors of the board's pose in the image. Every ring end keeps one row for
each of the four edges, so that association only chooses which are summed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.algorithm_1.certificate import Certificates, solve_globally
from lce_rig.calibrate.algorithm_1.registration import (
    eliminate_linear,
    linear_unknowns,
    tangent_basis,
    vec_rotation,
    with_one,
)
from lce_rig.calibrate.plane_and_ends import EDGE_SHIFT_SIGMA_M, CaptureFeatures
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.geometry import Array, pose

N_ROUNDS = 3
"""Rounds of association and solution."""
# Unknowns [vec R; t; d; 1].
_SIZE = 14


class Weights(NamedTuple):
    """Weights w_plane and w_edge of (1)."""

    plane: float
    edge: float


@dataclass(frozen=True, eq=False)
class Solutions:
    """Solutions for B subsets of captures.

    Attributes:
        R: (B, 3, 3).
        linear: (B, 4): t, then the edge shift.
        edge_ids: (B, n) edge of each ring end.
        certificates: certificate of each solution.
    """

    R: Array
    linear: Array
    edge_ids: NDArray[np.intp]
    certificates: Certificates

    @property
    def T(self) -> Array:
        """T_cam_lidar (B, 4, 4)."""
        return pose(self.R, self.linear[:, :3])

    @property
    def x(self) -> Array:
        """[vec R; t; d; 1] (B, 14)."""
        return with_one(np.concatenate([vec_rotation(self.R), self.linear], axis=1))


class Problem:
    """Moment matrices of F captures' planes, and rows of their ring ends.

    Args:
        features: one per capture.
        weights: weights of the terms.
        keep: per capture a mask of the plane points to use; all by default.
    """

    def __init__(
        self,
        features: Sequence[CaptureFeatures],
        weights: Weights,
        keep: Sequence[NDArray[np.bool_]] | None = None,
    ) -> None:
        self.n_captures, self.weights, self.keep = len(features), weights, keep
        self._board = features[0].board
        self.plane = np.zeros((len(features), _SIZE, _SIZE))
        for k, f in enumerate(features):
            heights = f.board_rows(f.plane_points if keep is None else f.plane_points[keep[k]])[:, 2]
            self.plane[k] = heights.T @ heights / max(len(heights), 1)
        counts = [len(f.edge_points) for f in features]
        self.edge_capture = np.repeat(np.arange(len(features)), counts)
        self._edge_weight = 1.0 / np.maximum(np.array(counts), 1)[self.edge_capture]
        # Board coordinates x, y of ring ends (n, 2, 14), and how far they lie inside each edge (n, 4, 14).
        self._to_board = np.concatenate([f.board_rows(f.edge_points)[:, :2] for f in features])
        anchors, normals = (of_edges[:, :2] for of_edges in self._board.edges())
        self._inside = -normals @ self._to_board
        self._inside[:, :, 12] += 1
        self._inside[:, :, 13] += np.sum(anchors * normals, axis=1)

    def associate(self, x: Array) -> NDArray[np.intp]:
        """Find the nearest of the board's edges to each ring end.

        Args:
            x: (B, 14).

        Returns:
            (B, n) edges, numbered as in `Board.nearest_edge`.
        """
        return self._board.nearest_edge(self._on_board(x))

    def _on_board(self, x: Array) -> Array:
        """Compute board coordinates (B, n, 2) of the ring ends, each coordinate in a block of its own."""
        return np.moveaxis(np.stack([x @ self._to_board[:, 0].T, x @ self._to_board[:, 1].T]), 0, -1)

    def _mean_of_ends(self, values: Array) -> Array:
        """Average values (n, ...) of the ring ends of each capture, (F, ...); 0 for captures without any."""
        means = np.zeros((self.n_captures, *values.shape[1:]))
        first = np.flatnonzero(np.diff(self.edge_capture, prepend=-1))
        if len(first):
            weighted = (values.T * self._edge_weight).T
            means[self.edge_capture[first]] = np.add.reduceat(weighted, first, axis=0)
        return means

    def moments(self, selection: Array, edge_ids: NDArray[np.intp], weights: Weights | None = None) -> Array:
        """Sum (1) over sets of captures.

        Args:
            selection: (B, F) weight of each capture in each set.
            edge_ids: (B, n).
            weights: other weights than the problem's.

        Returns:
            (B, 14, 14).
        """
        w = weights or self.weights
        M = w.plane * np.tensordot(selection, self.plane, axes=1)
        for k, ids in enumerate(edge_ids):
            rows = self._inside[np.arange(len(ids)), ids]
            weight = w.edge * selection[k, self.edge_capture] * self._edge_weight
            M[k] += rows.T @ (weight[:, None] * rows)
        M[:, 12, 12] += EDGE_SHIFT_SIGMA_M**-2
        return M

    def solve(self, selection: Array, T_start: Array, n_rounds: int = N_ROUNDS) -> Solutions:
        """Solve each set of captures, re-associating the ring ends between rounds.

        Args:
            selection: (B, F).
            T_start: (4, 4) T_cam_lidar for the first association.
            n_rounds: number of rounds of association and solution.
        """
        R = np.repeat(T_start[None, :3, :3], len(selection), axis=0)
        linear = np.tile(np.append(T_start[:3, 3], 0.0), (len(selection), 1))
        for _ in range(n_rounds):
            x = with_one(np.concatenate([vec_rotation(R), linear], axis=1))
            edge_ids = self.associate(x)
            Q, L = eliminate_linear(self.moments(selection, edge_ids))
            R, certificates = solve_globally(Q, R)
            linear = linear_unknowns(L, R)
        return Solutions(R, linear, edge_ids, certificates)

    def quadratics(
        self,
        x: Array,
        edge_ids: NDArray[np.intp],
        placement: NDArray[np.intp] | None = None,
        weights: Weights | None = None,
    ) -> Quadratics:
        """Expand each capture's cost in the tangent (translation m, rotation rad, edge shift m).

        Args:
            x: (14,) solution [vec R; t; d; 1].
            edge_ids: (n,) its association.
            placement: (F,) numbers of the board placements; each capture's own by default.
            weights: other weights than the problem's.
        """
        w = weights or self.weights
        rows = self._inside[np.arange(len(edge_ids)), edge_ids]
        M = w.plane * self.plane + w.edge * self._mean_of_ends(rows[:, :, None] * rows[:, None])
        J = tangent_basis(x[:9].reshape(3, 3).T)
        prior = np.zeros((7, 7))
        prior[6, 6] = EDGE_SHIFT_SIGMA_M**-2
        placement = np.arange(self.n_captures) if placement is None else placement
        return Quadratics((M @ x) @ J, J.T @ M @ J, prior, prior[:, 6] * x[12], placement)

    def errors(self, x: Array) -> tuple[Array, Array]:
        """Compute each capture's rms plane and edge residual in m, (B, F) each.

        Args:
            x: (B, 14).
        """
        plane = np.maximum(np.sum((x @ self.plane) * x, axis=-1).T, 0)
        inside_m = self._board.inside_nearest_edge(self._on_board(x)) + x[:, 12, None]
        return np.sqrt(plane), np.sqrt(self._mean_of_ends(inside_m.T**2).T)
