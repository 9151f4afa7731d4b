"""Ring ends against the board's edges.

A ring's last ray on the board meets its plane at a distance s inside an edge, the next ray a step D farther
out along the edge's normal. The beam has a width, so that the board is lost where the ray passes d beyond
the edge, measured across the beam; along the board that is g d, more the more obliquely it is seen:
s + g d lies anywhere between 0 and D. The error

    e = s + g d - D / 2                                                                                  (1)

in units of D has the density of `end_density`. A beam that meets board and background reports the stronger
echo: with q the share of the power that would come from the background if the beam met both alike, and r the
range,

    d = d_0 + c r + d_1 q    where the background is far behind
    d = d_0 + c r + d_2 + d_3 q    where it is so near that both echoes blend into one                   (2)

Recordings show d_1 near -17 mm, simulation -15 mm. What is left, the same for all ring ends (a beam that is
not symmetric, a clock of the rotor), is a small displacement of ring ends against the returns between them,
along azimuth and upwards.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.background import BLENDS
from lce_rig.calibrate.likelihood.end_density import density, information
from lce_rig.calibrate.likelihood.scans import N_FIELDS, Indices, StackedScans
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array

SHIFTS = ("d_0", "c", "d_1", "d_2", "d_3", "along azimuth", "upwards")
"""Unknowns of (2), and the displacement of ring ends."""
N_SHIFTS = len(SHIFTS)
# Columns of a row: by board pose, by lens, by shifts, residual.
_SIZE = 6 + N_FIELDS + N_SHIFTS + 1
# A ring end on an edge parallel to its ring has hardly a step; it says where the edge is, but not so well.
_SHORTEST_STEP_M = 2e-4


@dataclass(frozen=True, eq=False)
class EdgeRows:
    """Equation (1) for M ring ends, linear in the tangent of T_lidar_board, the lens and the shifts.

    Attributes:
        capture: (M,).
        rows: (M, 16) by board pose (6), by lens (2), by `SHIFTS`, e in m.
        step_m: (M,) D.
        range_m: (M,) to the board.
        is_backed: (M,) whether the background's echo blends into the board's.
    """

    capture: Indices
    rows: Array
    step_m: Array
    range_m: Array
    is_backed: NDArray[np.bool_]

    @cached_property
    def columns(self) -> Array:
        """Derivatives (15, M), each column of `rows` contiguous."""
        return np.ascontiguousarray(self.rows[:, :-1].T)

    @cached_property
    def products(self) -> Array:
        """Products of each row's derivatives with each other (120, M), in the order of `np.triu_indices`."""
        i, j = np.triu_indices(_SIZE - 1)
        return np.asarray(self.columns[i] * self.columns[j])

    def blur_m(self, edge_rad: float, backed_rad: float) -> Array:
        """Blur (M,) of each interval's ends, by `Levels`."""
        return np.asarray(np.where(self.is_backed, backed_rad, edge_rad) * self.range_m)


def edge_rows(
    scans: StackedScans, T_lidar_board: Array, board: Board, lens: Array, shifts: Array
) -> EdgeRows:
    """Linearise (1).

    Args:
        scans: ring ends.
        T_lidar_board: (F, 4, 4) board poses.
        board: its size.
        lens: (2,) theta.
        shifts: (7,) `SHIFTS`.
    """
    T = T_lidar_board[scans.end_capture]
    R, t, n = T[:, :3, :3], T[:, :3, 3], T[:, :3, 2]
    h = np.sum(n * t, axis=1)
    cosine = np.sum(n * scans.end_rays, axis=1)
    here = (h / cosine)[:, None] * scans.end_rays - t
    beyond = (h / np.sum(n * scans.next_rays, axis=1))[:, None] * scans.next_rays - t
    xy, xy_next = (np.einsum("mji,mj->mi", R[:, :, :2], p) for p in (here, beyond))
    anchors, normals = board.edges()
    edge = board.nearest_edge((xy + xy_next) / 2)
    outwards = normals[edge, :2]
    inside_m = np.sum((anchors[edge, :2] - xy) * outwards, axis=1)
    step_m = np.maximum(np.abs(np.sum((xy_next - xy) * outwards, axis=1)), _SHORTEST_STEP_M)
    # With M = R m_e: s = anchor - M . (r u + f theta - t),
    # dr = (n . tau + phi . n x (t - r u) - n . f theta) / (n . u), dM = phi x M.
    M = np.einsum("mij,mj->mi", R[:, :, :2], outwards)
    sideways = M - (np.sum(M * scans.end_rays, axis=1) / cosine)[:, None] * n
    rows = np.empty((len(M), _SIZE))
    rows[:, :3] = sideways
    rows[:, 3:6] = -np.cross(sideways, here)
    rows[:, 6 : 6 + N_FIELDS] = -np.einsum("mi,mij->mj", sideways, scans.end_fields)
    range_m = h / cosine
    rows[:, 6 + N_FIELDS : -1] = _by_shifts(scans, sideways, range_m)
    rows[:, -1] = inside_m + rows[:, 6:-1] @ np.concatenate([lens, shifts]) - step_m / 2
    return EdgeRows(scans.end_capture, rows, step_m, range_m, scans.end_background[:, BLENDS] > 0)


def _by_shifts(scans: StackedScans, sideways: Array, range_m: Array) -> Array:
    """Differentiate e by `SHIFTS`: (M, 7)."""
    of_width = np.column_stack([np.ones(len(range_m)), range_m, scans.end_background])
    displacement = np.stack([np.sum(sideways * scans.end_fields[:, :, 0], axis=1), sideways[:, 2]], axis=1)
    return np.hstack([np.linalg.norm(sideways, axis=1, keepdims=True) * of_width, -displacement])


def edge_system(
    edges: EdgeRows, edge_rad: float, backed_rad: float, lost_share: float, n_captures: int
) -> Array:
    """Expand -2 ln p of the ring ends to second order, by capture: (F, 16, 16).

    With J a row without its residual: J J^T times the information, J times the score in the last column, and
    -2 ln p itself in the corner. The information is the mean over all ring ends of such a blur: that of a
    single one is zero in the middle of its interval, and no Hessian to step by.
    """
    system = np.zeros((n_captures, _SIZE, _SIZE))
    if len(edges.rows):
        D, blur = edges.step_m, edges.blur_m(edge_rad, backed_rad) / edges.step_m
        p, slope = density(edges.rows[:, -1] / D, blur, lost_share)
        weighted = [
            edges.products * (information(blur, lost_share) / D**2),
            edges.columns * (-slope / p / D),
            -2 * np.log(p / D)[None],
        ]
        first = np.flatnonzero(np.diff(edges.capture, prepend=-1))
        sums = np.add.reduceat(np.concatenate(weighted), first, axis=1).T
        seen, (i, j) = edges.capture[first], np.triu_indices(_SIZE - 1)
        system[seen[:, None], i, j] = system[seen[:, None], j, i] = sums[:, : len(i)]
        system[seen, :-1, -1] = system[seen, -1, :-1] = sums[:, len(i) : -1]
        system[seen, -1, -1] = sums[:, -1]
    return system
