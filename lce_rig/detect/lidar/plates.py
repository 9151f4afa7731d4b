"""Plates of about the board's size: clusters of straight segments that lie in one plane."""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.detect.lidar.segments import MAX_INCIDENCE_RAD, Indices, OrderedScan, Segments
from lce_rig.detect.lidar.template import Placement, plane_axes, register_ends

MAX_PAIRS = 400
CELL = 0.5  # of the board's diagonal: with too many pairs, those of one cell count as alike
N_ROUNDS = 2
BLOCK = 32  # number of centres whose mutual distances fit the cache
MAX_PLATES = 10
MIN_LONG = 4  # minimum number of chords across the plate that locate it beside a stand
MAX_JOINT = 4  # maximum returns between two segments of one chord: noise, a hand's edge, a dropped firing


@dataclass(frozen=True, eq=False)
class Plates:
    """K plates, the most promising first.

    Attributes:
        plane: (K, 4) as (n, d), n.p + d = 0, n towards the LiDAR.
        centre: (K, 3) mean of the plate's returns, m.
        n_rings: (K,); 0 without rings.
        size_m: (K, 2) long and short side of the rectangle with the same second moments.
        thickness_m: (K,) rms distance of the returns from the plane.
    """

    plane: Array
    centre: Array
    n_rings: Indices
    size_m: Array
    thickness_m: Array

    @staticmethod
    def none() -> "Plates":
        """Return an empty set of plates."""
        return Plates.of(np.ones((0, 13)), np.zeros(0, dtype=np.intp))

    @staticmethod
    def of(sums: Array, n_rings: Indices) -> "Plates":
        """Fit plates to sums (K, 13) of 1, p and p p^T over their returns."""
        plane, centre, eigenvalues = fit_planes(sums)
        return Plates(
            plane, centre, n_rings, np.sqrt(12.0 * eigenvalues[:, [2, 1]]), np.sqrt(eigenvalues[:, 0])
        )

    def select(self, keep: NDArray[np.bool_] | Indices) -> "Plates":
        """Keep the plates of a mask or index."""
        return Plates(*(getattr(self, field.name)[keep] for field in fields(self)))


def propose_plates(
    scan: OrderedScan, segments: Segments, board: Board, is_any_size: bool = False
) -> tuple[Plates, Array]:
    """Grow plates from pairs of neighbouring segments; keep distinct ones of plausible size.

    Each pair of parallel segments on neighbouring rings spans a plane. All segments in reach that lie
    in a plane are assigned to it, and it is refitted to their sums, a few times, for all planes at once.

    Args:
        scan: scan, for the noise.
        segments: straight segments of all lengths.
        board: board, for the reach.
        is_any_size: whether to keep plates that cannot be the board.

    Returns:
        The plates, and the first and last return of their segments (K, M, 3) in m; rows are padded with NaN.
    """
    diagonal_m = float(np.hypot(board.width_m, board.height_m))
    tolerance_m = 2.0 * scan.sigma_m + 0.01
    segments = segments.select(segments.lateral_m < tolerance_m)
    first, second = _neighbours(segments, diagonal_m, is_any_size)
    # Count, sum of p and sum of p p^T of each segment.
    outer = segments.centre[:, :, None] * segments.centre[:, None, :]
    second_moments = (segments.scatter + segments.count[:, None, None] * outer).reshape(-1, 9)
    count = segments.count[:, None]
    sums = np.concatenate([count, count * segments.centre, second_moments], axis=1)
    plates = _fit(np.repeat(np.arange(len(first)), 2), np.stack([first, second], 1).ravel(), segments, sums)
    is_kept = (plates.thickness_m < tolerance_m) & _faces_lidar(plates)
    facing, is_blurred = _facing_planes(plates, segments, first, second, 3.0 * scan.sigma_m)
    plates = replace(plates, plane=np.where(is_blurred[:, None], facing, plates.plane))
    is_kept |= is_blurred
    row = column = first
    for _ in range(2 * N_ROUNDS if is_blurred.any() else N_ROUNDS):
        row, column = _members(plates.select(is_kept), segments, 0.6 * diagonal_m, tolerance_m)
        plates = _fit(row, column, segments, sums)
        # Plates with the same members have identical sums.
        is_kept = np.zeros(len(plates.centre), dtype=np.bool_)
        is_kept[np.unique(plates.centre[:, 0], return_index=True)[1]] = True
        is_kept &= (plates.n_rings >= 2) & _faces_lidar(plates) & (plates.size_m[:, 0] < 2.0 * diagonal_m)
    if not is_any_size:
        # Find which plates (K,) can be the board, which may be partly hidden or outside the rings.
        long_m, short_m = max(board.width_m, board.height_m), min(board.width_m, board.height_m)
        ratio = plates.size_m / [long_m, short_m]
        is_kept &= np.asarray(
            (ratio[:, 0] > 0.5) & (ratio[:, 0] < 1.5) & (ratio[:, 1] > 0.25) & (ratio[:, 1] < 1.5)
        )
    best = _different(plates, np.flatnonzero(is_kept), board)
    ends = []
    for k in best:
        members = column[row == k]
        start, end = segments.start[members], segments.end[members]
        # Segments a few returns apart count as one.
        is_joint = (start[1:] - end[:-1] <= MAX_JOINT) & (np.diff(segments.ring[members]) == 0)
        firsts, lasts = start[np.append(True, ~is_joint)], end[np.append(~is_joint, True)] - 1
        ends.append(scan.points[np.concatenate([firsts, lasts])].astype(np.float64))
    padded = np.full((len(best), max((len(e) for e in ends), default=1), 3), np.nan)
    for k, e in enumerate(ends):
        padded[k, : len(e)] = e
    return plates.select(best), padded


def _facing_planes(
    plates: Plates, segments: Segments, first: Indices, second: Indices, blur_m: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Place a plane (K, 4) through each pair's line, perpendicular to the beam, for pairs lost in noise.

    If the noise is as large as the distance between two rings, their plane is arbitrary; this one is close
    enough to collect the rings beyond them.
    """
    direction = segments.direction[first]
    away = segments.centre[second] - segments.centre[first]
    away = away - np.einsum("ij,ij->i", away, direction)[:, None] * direction
    is_blurred = np.linalg.norm(away, axis=1) < blur_m
    along = np.einsum("ij,ij->i", plates.centre, direction)
    normal = along[:, None] * direction - plates.centre
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)[:, None]
    d = -np.einsum("ij,ij->i", normal, plates.centre)
    return np.concatenate([normal, d[:, None]], axis=1), is_blurred


def _neighbours(segments: Segments, diagonal_m: float, is_any_size: bool) -> tuple[Indices, Indices]:
    """List the pairs of board-like segments that can lie side by side on one plate."""
    max_length_m = (2.0 if is_any_size else 1.15) * diagonal_m
    is_seed = (segments.length_m > 0.2 * diagonal_m) & (segments.length_m < max_length_m)
    distance = np.linalg.norm(segments.centre, axis=1)
    along_beam = np.einsum("ij,ij->i", segments.direction, segments.centre)
    is_seed &= np.abs(along_beam) < np.sin(MAX_INCIDENCE_RAD) * distance
    seed = np.flatnonzero(is_seed)
    ring, centre, direction = segments.ring[seed], segments.centre[seed], segments.direction[seed]
    # Only few pairs are on neighbouring rings: compute everything else for these. Segments are sorted by
    # ring.
    begin, end = np.searchsorted(ring, ring + 1), np.searchsorted(ring, ring + 1, side="right")
    first = np.repeat(np.arange(len(ring)), end - begin)
    second = np.arange(len(first)) + (begin - np.cumsum(end - begin) + (end - begin))[first]
    away = centre[second] - centre[first]
    reach = segments.length_m[seed]
    is_near = np.einsum("ij,ij->i", away, away) < (0.6 * diagonal_m) ** 2
    is_near &= np.abs(np.einsum("ij,ij->i", direction[first], direction[second])) > 0.95
    is_near &= np.abs(np.einsum("ij,ij->i", direction[first], away)) < 0.4 * (reach[first] + reach[second])
    first, second = seed[first[is_near]], seed[second[is_near]]
    best = np.argsort(-segments.count[first] - segments.count[second], kind="stable")
    if len(best) > MAX_PAIRS:
        best = best[_spread_out(segments.centre[first[best]], CELL * diagonal_m)]
    return first[best], second[best]


def _spread_out(centres: Array, cell_m: float) -> Indices:
    """Choose MAX_PAIRS of the pairs at centres (P, 3), best first but distributed over the scan.

    Dense rings give hundreds of pairs on every wall and floor, which all grow into the same few planes.
    Therefore each cell of space contributes its best pair before any cell contributes its second.
    """
    cell = np.unique(np.floor(centres / cell_m), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(cell, kind="stable")
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.empty(len(cell), dtype=np.intp)
    rank[order] = np.arange(len(cell)) - np.repeat(starts, np.diff(np.append(starts, len(cell))))
    return np.sort(np.argsort(rank, kind="stable")[:MAX_PAIRS])


def _fit(row: Indices, column: Indices, segments: Segments, sums: Array) -> Plates:
    """Fit a plane to the sums of each plate's segments.

    Args:
        row: (L,) plate of each membership, rising.
        column: (L,) segment of each membership, rising within a plate.
        segments: S of them.
        sums: (S, 13) of the segments.
    """
    start = np.flatnonzero(np.diff(row, prepend=-1))
    if len(start) == 0:
        return Plates.none()
    is_new_ring = (np.diff(row, prepend=-1) != 0) | (np.diff(segments.ring[column], prepend=-1) != 0)
    return Plates.of(
        np.add.reduceat(sums[column], start), np.add.reduceat(is_new_ring.astype(np.intp), start)
    )


def fit_planes(sums: Array) -> tuple[Array, Array, Array]:
    """Fit planes (K, 4), n towards the LiDAR, to sums (K, 13); also centres (K, 3), eigenvalues (K, 3)."""
    mean = sums[:, 1:] / sums[:, :1]
    centre, second = mean[:, :3], mean[:, 3:].reshape(-1, 3, 3)
    eigenvalues, vectors = np.linalg.eigh(second - centre[:, :, None] * centre[:, None, :])
    normal = vectors[:, :, 0]
    d = -np.einsum("ij,ij->i", normal, centre)
    plane = np.concatenate([normal, d[:, None]], axis=1) * np.where(d < 0, -1.0, 1.0)[:, None]
    return plane, centre, np.maximum(eigenvalues, 0.0)


def _members(
    plates: Plates, segments: Segments, reach_m: float, tolerance_m: float
) -> tuple[Indices, Indices]:
    """List the segments in each plane, within reach of its centre: (plate, segment), ascending."""
    row, column = _within_reach(plates.centre, segments.centre, reach_m)
    normal = plates.plane[:, :3]
    offset = np.einsum("ij,ij->i", normal[row], segments.centre[column]) + plates.plane[row, 3]
    is_near = np.abs(offset) < tolerance_m
    row, column, offset = row[is_near], column[is_near], offset[is_near]
    outer = (normal[:, :, None] * normal[:, None, :]).reshape(-1, 9)
    scatter = segments.scatter.reshape(-1, 9) / segments.count[:, None]
    variance = np.einsum("ij,ij->i", outer[row], scatter[column])
    is_member = offset * offset + variance < tolerance_m**2
    row, column = row[is_member], column[is_member]
    # Renumber the plates that still have members.
    return np.cumsum(np.diff(row, prepend=row[:1]) != 0), column


def _within_reach(centres: Array, others: Array, reach_m: float) -> tuple[Indices, Indices]:
    """List the pairs (row, column) of points closer than the reach, in blocks that fit the cache."""
    half_squared = np.einsum("ij,ij->i", others, others) / 2
    limit = (reach_m**2 - np.einsum("ij,ij->i", centres, centres)) / 2
    rows, columns = [], []
    for begin in range(0, len(centres), BLOCK):
        dot = centres[begin : begin + BLOCK] @ others.T
        is_near = half_squared - dot < limit[begin : begin + BLOCK, None]
        row, column = np.divmod(np.flatnonzero(is_near), len(others))  # faster than nonzero in two dimensions
        rows.append(row + begin)
        columns.append(column)
    return np.concatenate(rows or [np.zeros(0, np.intp)]), np.concatenate(columns or [np.zeros(0, np.intp)])


def _faces_lidar(plates: Plates) -> NDArray[np.bool_]:
    """Check which planes (K,) have an incidence below the limit; d = distance of the plane."""
    distance = np.linalg.norm(plates.centre, axis=1)
    return np.asarray(plates.plane[:, 3] > np.cos(MAX_INCIDENCE_RAD) * distance)


def _different(plates: Plates, candidates: Indices, board: Board) -> Indices:
    """Choose the most board-like plate at each position and orientation, best first."""
    long_m, short_m = max(board.width_m, board.height_m), min(board.width_m, board.height_m)
    misfit = np.abs(np.log(np.maximum(plates.size_m[candidates], 1e-3) / [long_m, short_m])).sum(axis=1)
    # Few rings leave the size undetermined; many returns on a wrong size exclude the board.
    rank = candidates[np.argsort(misfit - 0.1 * np.minimum(plates.n_rings[candidates], 8), kind="stable")]
    rank = rank[: 20 * MAX_PLATES]
    centre, normal = plates.centre[rank], plates.plane[rank, :3]
    apart = np.linalg.norm(centre[:, None] - centre, axis=2)
    offset = np.abs(centre @ normal.T + plates.plane[rank, 3])
    is_same = (apart <= 0.3 * np.hypot(long_m, short_m)) & (normal @ normal.T >= 0.95) & (offset <= 0.05)
    is_open = np.ones(len(rank), dtype=np.bool_)
    chosen: list[int] = []
    while is_open.any() and len(chosen) < MAX_PLATES:
        best = int(np.argmax(is_open))
        chosen.append(int(rank[best]))
        is_open &= ~is_same[best]
        is_open[best] = False
    return np.array(chosen, dtype=np.intp)


def screen_plates(
    plates: Plates, ends: Array, board: Board, limit_m: float, *, on_stand: bool = False
) -> list[tuple[Array, Array, Placement]]:
    """Register the outline with the ends of each plate's segments; keep the plates that fit, best first.

    Args:
        plates: K of them.
        ends: (K, M, 2) ends from `propose_plates`.
        board: board, for the rectangle.
        limit_m: largest error of an outline.
        on_stand: whether to skip chords shorter than half the board's short side: a stand flush with the
            plate is narrower than the plate, and its chords end elsewhere.
    """
    if len(plates.centre) == 0:
        return []
    relative = (ends - plates.centre[:, None]) @ plane_axes(plates.plane[:, :3])
    if on_stand:
        # The first and the last return of each chord, in two runs.
        for row in relative:
            n = np.count_nonzero(~np.isnan(row[:, 0])) // 2
            is_short = (
                np.linalg.norm(row[n : 2 * n] - row[:n], axis=1) < min(board.width_m, board.height_m) / 2
            )
            if 0 < np.count_nonzero(is_short) <= n - MIN_LONG:
                row[: 2 * n][np.tile(is_short, 2)] = np.nan
                row[:] = row[np.argsort(np.isnan(row[:, 0]), kind="stable")]
    placements = register_ends(relative, board)
    rank = sorted(range(len(placements)), key=lambda k: placements[k].error_m)
    return [
        (plates.plane[k], plates.centre[k], placements[k]) for k in rank if placements[k].error_m < limit_m
    ]
