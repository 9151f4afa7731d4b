"""Residuals of planes and ring ends along the LiDAR's rays for boards at given poses, for the likelihood.

Ranges. A ray u meets a board's plane n . p = h at r = h / (n . u) and reads, off by the offset o of its laser
and displaced by f theta (the lens, below),

    rho = r - n . f theta / (n . u) + o + noise                                                          (1)

The points determine three parameters of a plane's motion (`freedoms_of_plane`), so that all that an estimate
needs of the returns of a ring in a capture are the sums of products of

    v = [(1, x, y) / (n . u); 1; -n . f / (n . u); residual of (1)]

(7 x 7) with x and y on the board, however many there are.

Ring ends. A ring's last ray on the board meets its plane s inside an edge, the next ray a step D
farther out along the edge's normal. The beam has a width, so that the board is lost where the ray passes d
beyond the edge, measured across the beam; along the board that is g d, more the more obliquely it is seen:
s + g d lies anywhere between 0 and D. The error

    e = s + g d - D / 2                                                                                  (2)

in units of D has the density of `likelihood.end_density`. A beam that meets board and background reports the
stronger echo: with q the share of the power that would come from the background if the beam met both alike,
and r the range,

    d = d_0 + c r + d_1 q    where the background is far behind
    d = d_0 + c r + d_2 + d_3 q    where it is so near that both echoes blend into one                   (3)

Recordings show d_1 near -17 mm, simulation -15 mm. What is left, the same for all ring ends (a beam that is
not symmetric, a clock of the rotor), is a small displacement of ring ends against the returns between them,
along azimuth and upwards.

Lens. A spinning LiDAR sends its beams from a lens beside its axis, and drivers that do not know where place
points as if they came from the axis. With e_a the direction of growing azimuth and alpha the elevation, a
point lies at

    p + lateral e_a + vertical alpha e_z                                                                 (4)

instead of p.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard
from lce_rig.residuals.plane_and_ends import differentiate, distance_inside, freedoms_of_plane

Indices = NDArray[np.intp]
N_FIELDS = 2
# Half a beam's width, and what the outline found in the scan may be off by.
_BORDER_M = 0.02
# Columns of a return: three freedoms of its plane, its ring's offset, the lens, the residual.
_ONE, _OF_RETURN = 3, 5 + N_FIELDS
SHIFTS = ("d_0", "c", "d_1", "d_2", "d_3", "along azimuth", "upwards")
"""Unknowns of (3), and the displacement of ring ends."""
N_SHIFTS = len(SHIFTS)
# Columns of a ring end: by board pose, by lens, by shifts, residual.
_OF_END = 6 + N_FIELDS + N_SHIFTS + 1
# A ring end on an edge parallel to its ring has hardly a step, and determines the edge less accurately.
_SHORTEST_STEP_M = 2e-4
BLENDS_M = 0.35
"""Echoes from surfaces nearer to each other than this blend into one."""
BLENDS = 1
"""Column of `describe_background` that tells whether the background's echo blends into the board's."""


@dataclass(frozen=True, eq=False)
class StackedScans:
    """Rays of F captures: N returns from boards, ordered by capture and ring, and M ring ends.

    Attributes:
        n_captures: F.
        rings: (L,) ring numbers that occur.
        capture, ring: (N,) of each return; `ring` is an index into `rings`.
        rays: (N, 3) unit vectors, frame lidar.
        range_m: (N,).
        fields: (N, 3, 2) displacement by (4) for a lateral offset of 1 m, a vertical one of 1 m per rad.
        end_capture: (M,) of each ring end.
        end_rays: (M, 3) unit vectors towards it.
        next_rays: (M, 3) unit vectors of the firing after it, which missed the board.
        end_fields: (M, 3, 2) as `fields`.
        end_background: (M, 3) what is behind it, `describe_background`.
    """

    n_captures: int
    rings: NDArray[np.int16]
    capture: Indices
    ring: Indices
    rays: Array
    range_m: Array
    fields: Array
    end_capture: Indices
    end_rays: Array
    next_rays: Array
    end_fields: Array
    end_background: Array

    @property
    def group(self) -> Indices:
        """Index (N,) of each return's pair of capture and ring, of F L in all; ascending."""
        return self.capture * len(self.rings) + self.ring


def interior(lidar: LidarBoard, board: Board) -> LidarBoard:
    """Remove returns near the border, where the beam also hits the background and reads too long."""
    T = lidar.T_lidar_board
    xy = ((np.asarray(lidar.points, dtype=np.float64) - T[:3, 3]) @ T[:3, :3])[:, :2]
    keep = np.all(np.abs(xy) < np.array([board.width_m, board.height_m]) / 2 - _BORDER_M, axis=1)
    if np.count_nonzero(keep) < len(keep) / 2:
        return lidar
    offset_ns = None if lidar.offset_ns is None else lidar.offset_ns[keep]
    return replace(lidar, points=lidar.points[keep], ring=lidar.ring[keep], offset_ns=offset_ns)


def stack_scans(boards: Sequence[LidarBoard]) -> StackedScans:
    """Stack the boards of F captures."""
    rings = np.unique(np.concatenate([board.ring for board in boards]))
    capture = np.repeat(np.arange(len(boards)), [len(board.points) for board in boards])
    ring = np.searchsorted(rings, np.concatenate([board.ring for board in boards]))
    points = np.concatenate([np.asarray(board.points, dtype=np.float64) for board in boards])
    order = np.lexsort((ring, capture))
    points, capture, ring = points[order], capture[order], ring[order]
    range_m = np.linalg.norm(points, axis=1)
    ends = np.concatenate([np.asarray(b.edge_points, dtype=np.float64).reshape(-1, 3) for b in boards])
    angle = np.concatenate([board.edge_side * board.azimuth_step_rad for board in boards])
    end_rays = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    return StackedScans(
        n_captures=len(boards),
        rings=rings,
        capture=capture,
        ring=ring,
        rays=points / range_m[:, None],
        range_m=range_m,
        fields=lens_fields(points),
        end_capture=np.repeat(np.arange(len(boards)), [len(board.edge_points) for board in boards]),
        end_rays=end_rays,
        next_rays=turn_about_z(end_rays, angle),
        end_fields=lens_fields(ends),
        end_background=np.concatenate([describe_background(board) for board in boards]),
    )


def turn_about_z(vectors: Array, angle_rad: Array) -> Array:
    """Turn vectors (M, 3) about the z axis by angles (M,)."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    x = cosine * vectors[:, 0] - sine * vectors[:, 1]
    y = sine * vectors[:, 0] + cosine * vectors[:, 1]
    return np.stack([x, y, vectors[:, 2]], axis=1)


def lens_fields(points: Array) -> Array:
    """Compute the displacements (4) of points (N, 3), frame lidar: (N, 3, 2)."""
    across = np.hypot(points[:, 0], points[:, 1])
    fields = np.zeros((len(points), 3, N_FIELDS))
    fields[:, 0, 0], fields[:, 1, 0] = -points[:, 1] / across, points[:, 0] / across
    fields[:, 2, 1] = np.arctan2(points[:, 2], across)
    return fields


def is_blended(lidar: LidarBoard) -> NDArray[np.bool_]:
    """Return for each ring end (M,) whether an object is close behind the board along the beam."""
    cosine = np.abs(lidar.edge_points @ lidar.plane[:3]) / np.linalg.norm(lidar.edge_points, axis=1)
    return np.asarray(lidar.edge_behind_m < BLENDS_M * cosine)


def describe_background(lidar: LidarBoard) -> Array:
    """Describe the background of each ring end (M, 3).

    Columns are the background's share of the power where it is far behind, whether it blends, and its share
    where it does.
    """
    blends = is_blended(lidar)
    return np.stack([lidar.edge_echo * ~blends, blends, lidar.edge_echo * blends], axis=1)


@dataclass(frozen=True, eq=False)
class RangeSums:
    """Sums of v v^T by capture and ring, at given board poses.

    Attributes:
        sums: (F, L, 7, 7).
        by_pose: (F, 3, 6) derivative of the plane's three freedoms by the tangent of T_lidar_board.
    """

    sums: Array
    by_pose: Array


def sum_ranges(scans: StackedScans, T_lidar_board: Array, offset_m: Array, lens: Array) -> RangeSums:
    """Sum the returns' terms.

    Args:
        scans: rays.
        T_lidar_board: (F, 4, 4) board poses.
        offset_m: (L,) of each ring.
        lens: (2,) theta.
    """
    R, n = T_lidar_board[:, :3, :3], T_lidar_board[:, :3, 2]
    k = scans.capture
    # Rays and the boards' middles in the axes of each board; returns are ordered by capture.
    by_capture = np.split(scans.rays, np.searchsorted(k, np.arange(1, scans.n_captures)))
    x, y, cosine = np.concatenate([u @ axes for u, axes in zip(by_capture, R, strict=True)]).T
    middle = np.einsum("fji,fj->fi", R, T_lidar_board[:, :3, 3])
    r = middle[k, 2] / cosine
    v = np.ones((len(r), _OF_RETURN))
    v[:, 0], v[:, 1], v[:, 2] = 1 / cosine, r * x - middle[k, 0], r * y - middle[k, 1]
    v[:, 1:_ONE] /= cosine[:, None]
    v[:, _ONE + 1 : -1] = -np.einsum("ni,nij->nj", n[k], scans.fields) / cosine[:, None]
    v[:, -1] = r + v[:, _ONE + 1 : -1] @ lens + offset_m[scans.ring] - scans.range_m
    sums = np.zeros((scans.n_captures * len(scans.rings), _OF_RETURN, _OF_RETURN))
    first = np.flatnonzero(np.diff(scans.group, prepend=-1))
    # Products of columns, each one contiguous: several times faster than outer products of rows.
    i, j = np.triu_indices(_OF_RETURN)
    columns = np.ascontiguousarray(v.T)
    products = np.add.reduceat(columns[i] * columns[j], first, axis=1).T
    sums[scans.group[first, None], i, j] = sums[scans.group[first, None], j, i] = products
    K = freedoms_of_plane()
    by_pose = np.concatenate([K[:, :3] @ np.swapaxes(R, 1, 2), K[:, 3:] @ np.swapaxes(R, 1, 2)], axis=2)
    return RangeSums(sums.reshape(scans.n_captures, len(scans.rings), _OF_RETURN, _OF_RETURN), by_pose)


def weigh_ranges(ranges: RangeSums, sigma_m: float, sigma_ring_m: float) -> tuple[Array, Array]:
    """Weight the sums by the noise of single ranges and by errors common to a ring's returns in a capture.

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
    B = np.zeros((F, _OF_RETURN, 6 + _OF_RETURN - _ONE))
    B[:, :_ONE, :6] = ranges.by_pose
    B[:, np.arange(_ONE, _OF_RETURN), np.arange(6, 6 + _OF_RETURN - _ONE)] = 1
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


@dataclass(frozen=True, eq=False)
class EdgeRows:
    """Equation (2) for M ring ends, linear in the tangent of T_lidar_board, the lens and the shifts.

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
        i, j = np.triu_indices(_OF_END - 1)
        return np.asarray(self.columns[i] * self.columns[j])

    def blur_m(self, edge_rad: float, backed_rad: float) -> Array:
        """Blur (M,) of each interval's ends, by `Levels`."""
        return np.asarray(np.where(self.is_backed, backed_rad, edge_rad) * self.range_m)


def edge_rows(
    scans: StackedScans, T_lidar_board: Array, board: Board, lens: Array, shifts: Array
) -> EdgeRows:
    """Linearise (2).

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
    edge = board.nearest_edge((xy + xy_next) / 2)
    outwards = board.edges()[1][edge, :2]
    inside_m = distance_inside(board, xy, edge)
    step_m = np.maximum(np.abs(np.sum((xy_next - xy) * outwards, axis=1)), _SHORTEST_STEP_M)
    # With M = R m_e: s = anchor - M . (r u + f theta - t),
    # dr = (n . tau + phi . n x (t - r u) - n . f theta) / (n . u), dM = phi x M.
    M = np.einsum("mij,mj->mi", R[:, :, :2], outwards)
    sideways = M - (np.sum(M * scans.end_rays, axis=1) / cosine)[:, None] * n
    rows = np.empty((len(M), _OF_END))
    rows[:, :6] = -differentiate(sideways, here)
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
