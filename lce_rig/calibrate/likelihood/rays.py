"""Residuals of planes and ring ends along the LiDAR's rays for boards at given poses.

Ranges. A ray u meets a board's plane n . p = h at r = h / (n . u) and reads, off by the range offset o of its
laser and displaced by f theta (the lens, below) and by the laser's errors a of azimuth and elevation,

    rho = r - n . (f theta + r u' a) / (n . u) + o + noise                                               (1)

with u' the derivative of the ray by the two. A board's motion (tau, phi) about its middle t moves r by
n . (tau + phi x (r u - t)) / (n . u). An estimate needs, of all returns of a ring in a capture, only the sums
of products of

    v = [n / (n . u); (r u - t) x n / (n . u); 1; -r n . u' / (n . u); -n . f / (n . u); residual of (1)]

in columns of `layout.RING`.

Ring ends. A ring's last ray on the board meets its plane s inside an edge, the next ray a step D
farther out along the edge's normal. Because of the beam's width, the board is lost where the ray passes d
beyond the edge, measured across the beam; along the board that is g d, more the more obliquely it is seen:
s + g d lies anywhere between 0 and D. The error

    e = s + g d - D / 2                                                                                  (2)

in units of D has the density of `likelihood.end_density`. A beam that meets board and background reports the
stronger echo: with q the fraction of the power from the background if the beam hit both equally,
and r the range,

    d = d_0 + c r + d_1 q    where the background is far behind
    d = d_0 + c r + d_2 + d_3 q    where it is so near that both echoes blend into one                   (3)

Recordings show d_1 near -17 mm, simulation -15 mm. A plate larger than stated shifts each edge by half the
excess; width and height have an unknown each. The remaining error, the same for all ring ends (an asymmetric
beam, the rotor's clock), is a small displacement of ring ends relative to the returns between them, along
azimuth and upwards. Without rings, beams may be ten times as wide one way as the other: what half a beam's
width adds along each edge's normal is subtracted by the search, in two parts for its two axes, and a relative
error of each is unknown.

Lens. A spinning LiDAR sends its beams from a lens beside its axis, but drivers that ignore this place points
as if the beams came from the axis. With e_a the direction of growing azimuth and alpha the elevation, a point
lies at

    p + lateral e_a + vertical alpha e_z                                                                 (4)

instead of p.

Plate. Plates are never flat. With n the board's normal, and h_w and h_h the height of one that is bent by 1 m
along its width or its height (`bow_heights`), a point p of the plate stands for the point of the plane at

    p - (bow_w h_w + bow_h h_h) n                                                                        (5)

Ranges that are too long by a fraction, the stretch, and by another amount on the dark parts of the pattern
than on the white ones, half the contrast either way, stand for the points

    p - stretch p - contrast / 2 p / |p| on dark parts, + on white ones                                  (6)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.layout import END, FIELDS, RING, Indices, State
from lce_rig.calibrate.likelihood.levels import Levels
from lce_rig.calibrate.plane_and_ends import (
    BLENDS,
    describe_background,
    differentiate,
    distance_inside,
    turn_about_z,
)
from lce_rig.core.board import Board
from lce_rig.core.data import NO_RING
from lce_rig.core.geometry import Array
from lce_rig.core.pattern import is_dark
from lce_rig.core.results import LidarBoard

# Half a beam's width, and the error of the outline found in the scan.
_BORDER_M = 0.02
# Shortest step, m: on an edge parallel to its ring, a ring end has almost no step and determines the edge
# less accurately.
_SHORTEST_STEP_M = 2e-4


@dataclass(frozen=True, eq=False)
class StackedScans:
    """Rays of F captures: N returns from boards, ordered by capture and ring, and M ring ends.

    Attributes:
        n_captures: F.
        rings: (L,) ring numbers that occur.
        capture, ring: (N,) indices of each return's capture, and of its ring in `rings`.
        rays: (N, 3) unit vectors, frame lidar.
        range_m: (N,).
        fields: (N, 3, 6) displacement by (4) to (6), per unit of lens (2), bow (2), stretch and contrast.
        weight: (F,) inverse of each capture's noise of a return, relative to others; 1 with rings. Without, a
            "return" is the mean over a cell of the plate, whose noise was measured.
        end_capture, end_ring: (M,) the same of each ring end, ordered by capture.
        end_rays: (M, 3) unit vectors towards it.
        next_rays: (M, 3) unit vectors of the firing after it, which missed the board.
        end_fields: (M, 3, 6) the same as `fields`, for ring ends.
        end_background: (M, 3) the background there, see `describe_background`.
        end_beam: (M, 2) half the beam's width along the edge's normal, by the beam's two axes; 0 with rings.
        end_sigma: (M,) noise beyond that of a sharp border, m; 0 for a sharp one.
    """

    n_captures: int
    rings: NDArray[np.int16]
    capture: Indices
    ring: Indices
    rays: Array
    range_m: Array
    fields: Array
    weight: Array
    end_capture: Indices
    end_ring: Indices
    end_rays: Array
    next_rays: Array
    end_fields: Array
    end_background: Array
    end_beam: Array
    end_sigma: Array

    @cached_property
    def group(self) -> Indices:
        """Index (N,) of each return's capture and ring, 0 to F L - 1; ascending."""
        return np.asarray(self.capture * len(self.rings) + self.ring)

    @cached_property
    def turned(self) -> Array:
        """Derivative (N, 3, 2) of each return's ray by azimuth and elevation."""
        return turn_rays(self.rays)


def interior(lidar: LidarBoard, board: Board) -> LidarBoard:
    """Remove returns near the border, where the beam also hits the background and ranges are too long."""
    T = lidar.T_lidar_board
    xy = ((np.asarray(lidar.points, dtype=np.float64) - T[:3, 3]) @ T[:3, :3])[:, :2]
    keep = np.all(np.abs(xy) < np.array([board.width_m, board.height_m]) / 2 - _BORDER_M, axis=1)
    if np.count_nonzero(keep) < len(keep) / 2:
        return lidar
    offset_ns = None if lidar.offset_ns is None else lidar.offset_ns[keep]
    return replace(lidar, points=lidar.points[keep], ring=lidar.ring[keep], offset_ns=offset_ns)


def stack_scans(boards: Sequence[LidarBoard], board: Board) -> StackedScans:
    """Stack the boards of F captures; `board` is their size."""
    rings = np.unique(np.concatenate([numbers for b in boards for numbers in (b.ring, b.edge_ring)]))
    capture = np.repeat(np.arange(len(boards)), [len(board.points) for board in boards])
    ring = np.searchsorted(rings, np.concatenate([board.ring for board in boards]))
    points = np.concatenate([np.asarray(board.points, dtype=np.float64) for board in boards])
    order = np.lexsort((ring, capture))
    points, capture, ring = points[order], capture[order], ring[order]
    range_m = np.linalg.norm(points, axis=1)
    T_lidar_board = np.array([lidar.T_lidar_board for lidar in boards])
    end_capture = np.repeat(np.arange(len(boards)), [len(board.edge_points) for board in boards])
    end_ring = np.searchsorted(rings, np.concatenate([board.edge_ring for board in boards]))
    sorted_ends = np.lexsort((end_ring, end_capture))
    ends = np.concatenate([np.asarray(b.edge_points, dtype=np.float64).reshape(-1, 3) for b in boards])
    ends = ends[sorted_ends]
    angle = np.concatenate([board.edge_side * board.azimuth_step_rad for board in boards])[sorted_ends]
    end_rays = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    beams = [np.zeros((len(b.edge_points), 2)) if b.edge_beam_m is None else b.edge_beam_m for b in boards]
    sigmas = [np.zeros(len(b.edge_points)) if b.edge_sigma_m is None else b.edge_sigma_m for b in boards]
    return StackedScans(
        n_captures=len(boards),
        rings=rings,
        capture=capture,
        ring=ring,
        rays=points / range_m[:, None],
        range_m=range_m,
        fields=displacements(points, T_lidar_board[capture], board),
        weight=np.array([1.0 if lidar.has_rings else Levels().range_m / lidar.sigma_m for lidar in boards]),
        end_capture=end_capture[sorted_ends],
        end_ring=end_ring[sorted_ends],
        end_rays=end_rays,
        next_rays=turn_about_z(end_rays, angle),
        end_fields=displacements(ends, T_lidar_board[end_capture[sorted_ends]], board),
        end_background=np.concatenate([describe_background(board) for board in boards])[sorted_ends],
        end_beam=np.concatenate(beams)[sorted_ends],
        end_sigma=np.concatenate(sigmas)[sorted_ends],
    )


def no_scans(n_captures: int) -> StackedScans:
    """Stack captures that no LiDAR saw; a single ring, never measured, represents its errors."""
    at, none, rays, fields = np.zeros(0, np.intp), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 6))
    return StackedScans(
        n_captures=n_captures,
        rings=np.array([NO_RING], dtype=np.int16),
        capture=at,
        ring=at,
        rays=rays,
        range_m=none,
        fields=fields,
        weight=np.ones(n_captures),
        end_capture=at,
        end_ring=at,
        end_rays=rays,
        next_rays=rays,
        end_fields=fields,
        end_background=rays,
        end_beam=np.zeros((0, 2)),
        end_sigma=none,
    )


def spread(scans: StackedScans, captures: Indices, n_captures: int) -> StackedScans:
    """Renumber the stacked captures as a subset (n,), ascending, of captures seen by other sensors."""
    weight = np.ones(n_captures)
    weight[captures] = scans.weight
    return replace(
        scans,
        n_captures=n_captures,
        capture=captures[scans.capture],
        weight=weight,
        end_capture=captures[scans.end_capture],
    )


def displacements(points: Array, T_lidar_board: Array, board: Board) -> Array:
    """Compute the displacements (4) to (6) of points (N, 3) on boards (N, 4, 4), frame lidar: (N, 3, 6)."""
    R, t = T_lidar_board[:, :3, :3], T_lidar_board[:, :3, 3]
    on_board = np.einsum("nji,nj->ni", R, points - t)
    by_bow = -R[:, :, 2, None] * bow_heights(on_board, board)[:, None]
    side = np.where(is_dark(board, on_board[:, :2]), 0.5, -0.5)
    by_print = -(side / np.linalg.norm(points, axis=1))[:, None] * points
    # The stretch moves points along their rays by fractions of the model's ranges (`sum_ranges`): measured
    # ranges have noise, which the stretch would absorb.
    none = np.zeros((len(points), 3, 1))
    return np.concatenate([lens_fields(points), by_bow, none, by_print[..., None]], axis=2)


def correct_points(lidar: LidarBoard, board: Board, rings: NDArray[np.int16], state: State) -> Array:
    """Return a board's points (N, 3), frame lidar, without the LiDAR's estimated constant errors.

    Args:
        lidar: the board as measured.
        board: the board's size.
        rings: (L,) ring numbers of the state's lasers, ascending; other rings count as exact.
        state: the estimate.
    """
    points = np.asarray(lidar.points, dtype=np.float64)
    range_m = np.linalg.norm(points, axis=1)
    rays = points / range_m[:, None]
    at = np.minimum(np.searchsorted(rings, lidar.ring), len(rings) - 1)
    lasers = state.lasers[:, at] * (rings[at] == lidar.ring)
    of_lidar = state.fields.copy()
    of_lidar[FIELDS["bow"]] = 0
    fields = displacements(points, np.broadcast_to(lidar.T_lidar_board, (len(points), 4, 4)), board)
    along_m = (range_m - lasers[0]) / (1 + of_lidar[FIELDS["stretch"]])
    by_angles = np.einsum("nij,jn->ni", turn_rays(rays), lasers[1:])
    return np.asarray(along_m[:, None] * rays + range_m[:, None] * by_angles + fields @ of_lidar)


def bow_heights(on_board: Array, board: Board) -> Array:
    """Compute the height (..., 2) of a plate bent by 1 m along its width, or its height.

    It is a parabola whose mean over the plate is zero: the board's frame lies in the middle of its height.

    Args:
        on_board: (..., 2 or 3) points, frame board, m.
        board: the board's size.
    """
    half = np.array([board.width_m, board.height_m]) / 2
    return np.asarray(1 / 3 - (on_board[..., :2] / half) ** 2)


def lens_fields(points: Array) -> Array:
    """Compute the displacements (4) of points (N, 3), frame lidar: (N, 3, 2)."""
    across = np.hypot(points[:, 0], points[:, 1])
    fields = np.zeros((len(points), 3, 2))
    fields[:, 0, 0], fields[:, 1, 0] = -points[:, 1] / across, points[:, 0] / across
    fields[:, 2, 1] = np.arctan2(points[:, 2], across)
    return fields


def turn_rays(rays: Array) -> Array:
    """Differentiate unit rays (N, 3) by azimuth and elevation: (N, 3, 2)."""
    across = np.hypot(rays[:, 0], rays[:, 1])
    turned = np.zeros((len(rays), 3, 2))
    turned[:, 0, 0], turned[:, 1, 0] = -rays[:, 1], rays[:, 0]
    turned[:, :2, 1] = -rays[:, :2] * (rays[:, 2] / across)[:, None]
    turned[:, 2, 1] = across
    return turned


class RangeSums(NamedTuple):
    """Sums of v v^T by capture and ring, at given board poses.

    Attributes:
        sums: (F, L, 16, 16) in columns of `RING`, weighted by capture.
        n_returns: (F, L) number of returns.
    """

    sums: Array
    n_returns: Array


def sum_ranges(scans: StackedScans, state: State) -> RangeSums:
    """Sum the returns' terms at a state."""
    T = state.T_lidar_board[scans.capture]
    n, t = T[:, :3, 2], T[:, :3, 3]
    cosine = np.sum(n * scans.rays, axis=1)
    r = np.sum(n * t, axis=1) / cosine
    across = -n / cosine[:, None]
    v = np.empty((len(r), RING.size))
    v[:, RING["pose"]] = differentiate(across, r[:, None] * scans.rays - t)
    v[:, RING["range"]] = 1
    v[:, RING.span("azimuth", "elevation")] = r[:, None] * np.einsum("ni,nij->nj", across, scans.turned)
    v[:, RING.span("lens", "contrast")] = np.einsum("ni,nij->nj", across, scans.fields)
    v[:, RING["stretch"]] = r[:, None]
    by_laser, by_fields = v[:, RING.span("range", "elevation")], v[:, RING.span("lens", "contrast")]
    of_laser = np.einsum("ni,ni->n", by_laser, state.lasers.T[scans.ring])
    v[:, -1] = r + of_laser + by_fields @ state.fields - scans.range_m
    v *= scans.weight[scans.capture, None]
    by_ring = scans.n_captures, len(scans.rings)
    sums = np.zeros((by_ring[0] * by_ring[1], RING.size, RING.size))
    bounds = np.flatnonzero(np.diff(scans.group, prepend=-1, append=-1))
    # One matrix product per ring is several times faster than sums of products of columns.
    if len(v):
        sums[scans.group[bounds[:-1]]] = [v[a:b].T @ v[a:b] for a, b in pairwise(bounds.tolist())]
    n_returns = np.bincount(scans.group, minlength=len(sums)).astype(np.float64)
    return RangeSums(sums.reshape(*by_ring, RING.size, RING.size), n_returns.reshape(by_ring))


def weigh_ranges(ranges: RangeSums, sigma_m: float, sigma_ring_m: float) -> tuple[Array, Array]:
    """Weight the sums by the noise of single ranges and by errors common to a ring's returns in a capture.

    The returns of one ring in one capture have the covariance sigma^2 I + sigma_ring^2 1 1^T; its inverse is

        (I - k 1 1^T) / sigma^2,    k = sigma_ring^2 / (sigma^2 + n sigma_ring^2)

    With weights w_i, sigma^2 I is diag(sigma^2 / w_i^2), and n the sum of their squares.

    Returns:
        The weighted sums (F, L, 16, 16) and the logs (F, L) of the covariances' determinants.
    """
    n = ranges.n_returns
    shared = ranges.sums[..., RING["range"].start, :]
    total = sigma_m**2 + shared[..., RING["range"].start] * sigma_ring_m**2
    k = (sigma_ring_m**2 / total)[..., None, None]
    weighted = (ranges.sums - k * shared[..., :, None] * shared[..., None, :]) / sigma_m**2
    return weighted, np.where(n > 0, (n - 1) * np.log(sigma_m**2) + np.log(total), 0.0)


@dataclass(frozen=True, eq=False)
class EdgeRows:
    """Equation (2) for M ring ends, linear in the unknowns; ordered by capture and ring.

    Attributes:
        group: (M,) index of each end's pair of capture and ring, of F L in all; ascending.
        rows: (M, 28) in columns of `END`, e in m.
        step_m: (M,) D.
        range_m: (M,) range to the board.
        is_backed: (M,) whether the background's echo blends into the board's.
        sigma_m: (M,) noise beyond that of a sharp border.
    """

    group: Indices
    rows: Array
    step_m: Array
    range_m: Array
    is_backed: NDArray[np.bool_]
    sigma_m: Array

    def blur_m(self, edge_rad: float, backed_rad: float) -> Array:
        """Blur (M,) of each interval's ends, by `Levels` and the border's own noise."""
        sharp_m = np.where(self.is_backed, backed_rad, edge_rad) * self.range_m
        return np.asarray(np.where(self.sigma_m > 0, np.hypot(sharp_m, self.sigma_m), sharp_m))


def edge_rows(scans: StackedScans, board: Board, state: State) -> EdgeRows:
    """Linearise (2) at a state; `board` is the plate's size."""
    T = state.T_lidar_board[scans.end_capture]
    R, t, n = T[:, :3, :3], T[:, :3, 3], T[:, :3, 2]
    h = np.sum(n * t, axis=1)
    cosine = np.sum(n * scans.end_rays, axis=1)
    range_m = h / cosine
    turned = turn_rays(scans.end_rays)
    off = scans.end_fields @ state.fields
    off += range_m[:, None] * np.einsum("mij,jm->mi", turned, state.lasers[1:, scans.end_ring])
    # A displaced point is the intersection of its displaced ray with the plane.
    off -= (np.sum(n * off, axis=1) / cosine)[:, None] * scans.end_rays
    here = range_m[:, None] * scans.end_rays - t + off
    beyond = (h / np.sum(n * scans.next_rays, axis=1))[:, None] * scans.next_rays - t + off
    xy, xy_next = (np.einsum("mji,mj->mi", R[:, :, :2], p) for p in (here, beyond))
    # A ring leaves the board at the nearest edge that it crosses outwards.
    anchors, normals = (of_edges[:, :2] for of_edges in board.edges())
    steps_m = (xy_next - xy) @ normals.T
    distances_m = np.sum(anchors * normals, axis=1) - xy @ normals.T + state.shifts[0] - steps_m / 2
    edge = np.argmin(np.where(steps_m >= 0, np.abs(distances_m), np.inf), axis=1)
    outwards = normals[edge]
    inside_m = distance_inside(board, xy, edge)
    step_m = np.maximum(np.abs(np.sum((xy_next - xy) * outwards, axis=1)), _SHORTEST_STEP_M)
    # With M = R m_e: s = anchor - M . (r u + f theta - t),
    # dr = (n . tau + phi . n x (t - r u) - n . f theta) / (n . u), dM = phi x M.
    M = np.einsum("mij,mj->mi", R[:, :, :2], outwards)
    sideways = M - (np.sum(M * scans.end_rays, axis=1) / cosine)[:, None] * n
    rows = np.zeros((len(M), END.size))
    rows[:, END["pose"]] = -differentiate(sideways, here)
    by_angle = -range_m[:, None] * np.einsum("mi,mij->mj", sideways, turned)
    rows[:, END.span("azimuth", "elevation")] = by_angle
    rows[:, END.span("lens", "contrast")] = -np.einsum("mi,mij->mj", sideways, scans.end_fields)
    # By the shifts of (3), the shape of the plate, and the displacement along azimuth and upwards.
    across = np.linalg.norm(sideways, axis=1, keepdims=True)
    of_width = np.column_stack([np.ones(len(range_m)), range_m, scans.end_background])
    of_plate = np.abs(outwards) / 2
    by_azimuth = np.sum(sideways * scans.end_fields[:, :, 0], axis=1)
    by_shifts = np.column_stack([across * of_width, of_plate, -by_azimuth, -sideways[:, 2], scans.end_beam])
    rows[:, END["shifts"]], rows[:, END["own_shift"]] = by_shifts, by_shifts[:, :1]
    rows[:, -1] = inside_m + rows[:, END.of(["shifts"])] @ state.shifts - step_m / 2
    rows[:, -1] += by_shifts[:, 0] * state.own_shift_m[scans.end_capture]
    is_backed = scans.end_background[:, BLENDS] > 0
    group = scans.end_capture * len(scans.rings) + scans.end_ring
    return EdgeRows(group, rows, step_m, range_m, is_backed, scans.end_sigma)
