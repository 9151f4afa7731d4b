"""Ring ends against the board's edges.

A ring's last ray on the board meets its plane at a distance s inside an edge, the next ray a step D farther
out along the edge's normal. The beam has a width, so that the board is lost where the ray is d outside the
edge: s + d lies anywhere between 0 and D, hence

    s + d - D / 2 = noise,    sigma^2 = D^2 / 12 + tau^2                                                  (1)
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lce_rig.calibrate.likelihood.scans import N_FIELDS, Indices, StackedScans
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array

# Columns of a row: by board pose, by lens, by d, residual.
_SIZE = 6 + N_FIELDS + 2


@dataclass(frozen=True, eq=False)
class EdgeRows:
    """Equation (1) for M ring ends, linear in the tangent of T_lidar_board, the lens and d.

    Attributes:
        capture: (M,).
        rows: (M, 10) by board pose (6), by lens (2), by d, residual in m.
        step_m: (M,) D.
    """

    capture: Indices
    rows: Array
    step_m: Array

    @cached_property
    def products(self) -> Array:
        """Products of each row with itself (M, 10, 10)."""
        return np.asarray(self.rows[:, :, None] * self.rows[:, None, :])

    def variance(self, tau_m: float) -> Array:
        """Variance (M,) of (1) in m^2."""
        return np.asarray(self.step_m**2 / 12 + tau_m**2)


def edge_rows(
    scans: StackedScans, T_lidar_board: Array, board: Board, lens: Array, shift_m: float
) -> EdgeRows:
    """Linearise (1).

    Args:
        scans: ring ends.
        T_lidar_board: (F, 4, 4) board poses.
        board: its size.
        lens: (2,) theta.
        shift_m: d.
    """
    T = T_lidar_board[scans.end_capture]
    R, t, n = T[:, :3, :3], T[:, :3, 3], T[:, :3, 2]
    h = np.sum(n * t, axis=1)
    cosine = np.sum(n * scans.end_rays, axis=1)
    here = (h / cosine)[:, None] * scans.end_rays - t
    beyond = (h / np.sum(n * scans.next_rays, axis=1))[:, None] * scans.next_rays - t
    xy, xy_next = (np.einsum("mji,mj->mi", R[:, :, :2], p) for p in (here, beyond))
    anchors, normals = board.edges()
    edge = nearest_edge((xy + xy_next) / 2, board)
    outwards = normals[edge, :2]
    inside_m = np.sum((anchors[edge, :2] - xy) * outwards, axis=1)
    step_m = np.abs(np.sum((xy_next - xy) * outwards, axis=1))
    # With M = R m_e: s = anchor - M . (r u + f theta - t),
    # dr = (n . tau + phi . n x (t - r u) - n . f theta) / (n . u), dM = phi x M.
    M = np.einsum("mij,mj->mi", R[:, :, :2], outwards)
    sideways = M - (np.sum(M * scans.end_rays, axis=1) / cosine)[:, None] * n
    rows = np.empty((len(M), _SIZE))
    rows[:, :3] = sideways
    rows[:, 3:6] = -np.cross(sideways, here)
    rows[:, 6:-2] = -np.einsum("mi,mij->mj", sideways, scans.end_fields)
    rows[:, -2] = 1
    rows[:, -1] = inside_m + rows[:, 6:-2] @ lens + shift_m - step_m / 2
    return EdgeRows(scans.end_capture, rows, step_m)


def nearest_edge(xy_m: Array, board: Board) -> Indices:
    """Find the edge nearest to points (M, 2) of the board's plane, in the order of `Board.edges`."""
    beyond = np.abs(xy_m) - [board.width_m / 2, board.height_m / 2]
    to_side = np.hypot(beyond[:, 0], np.maximum(beyond[:, 1], 0))
    to_rail = np.hypot(beyond[:, 1], np.maximum(beyond[:, 0], 0))
    side, rail = np.where(xy_m[:, 0] > 0, 1, 3), np.where(xy_m[:, 1] > 0, 2, 0)
    return np.where(to_side < to_rail, side, rail).astype(np.intp)


def edge_system(edges: EdgeRows, weights: Array, n_captures: int) -> Array:
    """Sum products of rows, weighted (M,), by capture: (F, 10, 10)."""
    system = np.zeros((n_captures, _SIZE, _SIZE))
    if len(edges.rows):
        first = np.flatnonzero(np.diff(edges.capture, prepend=-1))
        system[edges.capture[first]] = np.add.reduceat(weights[:, None, None] * edges.products, first, axis=0)
    return system
