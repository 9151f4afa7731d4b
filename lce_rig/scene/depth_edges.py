"""Edges of a scan: outlines of near objects, and where a surface's reflectivity changes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import NO_RING, Scan
from lce_rig.core.geometry import Array
from lce_rig.detect.lidar.measurement import Beam

_Item = TypeVar("_Item")
CHANNELS = ("depth", "reflectivity")
"""What an edge is one of: a jump in range, or in reflectivity along a continuous surface."""

_JUMP_M = 0.3
_JUMP_STEPS = 3.0  # A wall seen at a grazing angle has steps as large, one like the other.
_FULL_JUMP_M = 3.0  # Larger jumps count no more: what lies behind an edge does not sharpen it.
_GAP_STEPS = 3.5  # Neighbours on a ring are at most so many azimuth steps apart.
# Without rings, returns on either side of an outline that are compared with its last one, at most.
_N_BEYOND, _N_WITHIN = 8, 2
_SPHERE_RAD = ((-np.pi, np.pi), (-np.pi / 2, np.pi / 2))

_BRIGHT_PERCENTILE = 95  # of a scan's reflectivities, is 1; mirrors and road signs are far brighter
_CONTRAST = 0.2  # |a - b| / (a + b)
_FAINT = 0.05  # Reflectivities below this hardly differ,
_LEAST_CHANGE = 0.05  # nor do those that differ by less.
_CHANGE_SIGMAS = 4.0  # of the scatter on either side

_SAME_PLACE_M, _SAME_PLACE_RAD = 0.05, 0.01  # noise of ranges; azimuth steps
_MAX_COMPARED = 10  # More captures of one place tell no more.
_STANDING_SHARE = 0.5  # of all edges that recur before a standing rig


@dataclass(frozen=True, eq=False)
class DepthEdges:
    """Points on the edges of a scan.

    Attributes:
        points: (N, 3) m, frame lidar.
        weight: (N,) root of the jump in range (m^0.5), or of the contrast in reflectivity.
        channel: (N,) index of CHANNELS.
    """

    points: Array
    weight: Array
    channel: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, keep: NDArray[np.bool_]) -> "DepthEdges":
        """Keep the points of a mask (N,)."""
        return DepthEdges(self.points[keep], self.weight[keep], self.channel[keep])


def leave_standing(captures: Sequence[DepthEdges]) -> list[DepthEdges]:
    """Leave out what moves before a standing rig: who holds the board, its stand, passers-by.

    An edge stays if a third of the other captures have one in its place; it may be hidden in the rest. Where
    few edges stay, the rig itself moves, and all are kept.
    """
    from scipy.spatial import cKDTree

    compared = evenly(captures, _MAX_COMPARED)
    keep = []
    for edges in captures:
        # An edge recurs if a third of the other captures, and one at least, have it in the same place.
        others = [each for each in compared if each is not edges]
        tolerance_m = _SAME_PLACE_M + _SAME_PLACE_RAD * np.linalg.norm(edges.points, axis=1)
        count = np.zeros(len(edges))
        for other in others:
            for channel in range(len(CHANNELS)):
                own = edges.channel == channel
                tree = cKDTree(other.points[other.channel == channel])
                count[own] += tree.query(edges.points[own])[0] < tolerance_m[own]
        keep.append(count >= max(len(others) / 3, 1))
    if not any(map(len, captures)) or np.mean(np.concatenate(keep)) < _STANDING_SHARE:
        return list(captures)
    return [edges.select(each) for edges, each in zip(captures, keep, strict=True)]


def evenly(items: Sequence[_Item], n: int) -> list[_Item]:
    """Choose n of the items or fewer, spread over all."""
    if len(items) <= n:
        return list(items)
    return [items[k] for k in np.linspace(0, len(items) - 1, n).round().astype(int)]


@dataclass(frozen=True, eq=False)
class _Rows:
    """A scan in order of rows and azimuths.

    Attributes:
        row: (N,) rings; without them, elevations as far apart as returns are on average.
        azimuth: (N,) rad.
        range_m, intensity: (N,).
        is_next: (N - 1,) whether a return and the one after it are neighbours on a row.
        step_rad: azimuth between neighbours.
    """

    points: Array
    row: NDArray[np.intp]
    azimuth: Array
    range_m: Array
    intensity: Array
    is_next: NDArray[np.bool_]
    step_rad: float

    def beside(self, index: NDArray[np.intp], k: int) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Compare returns with the k-th after each on its row, or before it for k < 0.

        Returns:
            What is added to range, the angle between, and whether there is such a return near by.
        """
        other = np.clip(index + k, 0, len(self.row) - 1)
        gap_rad = np.abs(self.azimuth[other] - self.azimuth[index])
        is_near = (self.row[other] == self.row[index]) & (gap_rad < _GAP_STEPS * self.step_rad)
        return self.range_m[other] - self.range_m[index], gap_rad, is_near & (other != index)


def find_depth_edges(scan: Scan, beam: Beam) -> DepthEdges:
    """Find the outlines of near objects and the changes of reflectivity along the rows of a scan.

    Args:
        scan: with or without rings; without intensities it has no changes of reflectivity.
        beam: of this LiDAR.
    """
    rows = _in_order(scan)
    has_rings = bool(np.any(scan.ring != NO_RING))
    found = [_find_jumps(rows, beam) if has_rings else _find_gaps(rows, beam), _find_changes(rows)]
    channel = np.repeat(np.arange(len(CHANNELS), dtype=np.int8), [len(points) for points, _ in found])
    points, weights = zip(*found, strict=True)
    return DepthEdges(np.concatenate(points), np.concatenate(weights), channel)


def _in_order(scan: Scan) -> _Rows:
    points = np.asarray(scan.points, dtype=np.float64)
    row = np.asarray(scan.ring, dtype=np.intp)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    step_rad = 0.0
    if not np.any(row != NO_RING):
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        # Give the mean angle between returns: the root of the solid angle in view by how many share it.
        counts, _, _ = np.histogram2d(azimuth, elevation, bins=(360, 180), range=_SPHERE_RAD)
        is_seen, middle = counts > 0, np.radians(np.arange(-89.5, 90.0))
        step_rad = float(np.radians(1.0) * np.sqrt((is_seen @ np.cos(middle)).sum() / max(len(azimuth), 1)))
        row = np.floor(elevation / step_rad).astype(np.intp)
    order = np.lexsort((azimuth, row))
    points, row, azimuth = points[order], row[order], azimuth[order]
    gap, is_next = np.diff(azimuth), np.diff(row) == 0
    is_step = is_next & (gap > 0)
    if not step_rad and is_step.any():
        step_rad = float(np.median(gap[is_step]))
    is_next &= gap < _GAP_STEPS * step_rad
    intensity = np.asarray(scan.intensity, dtype=np.float64)[order]
    return _Rows(points, row, azimuth, np.linalg.norm(points, axis=1), intensity, is_next, step_rad)


def _find_jumps(rows: _Rows, beam: Beam) -> tuple[Array, Array]:
    """Find outlines, and their weights.

    A return belongs to the near object while any part of the beam meets it, so the last one lies beyond the
    outline by up to the beam's radius, and on average half an azimuth step short of that:
    edge = last return + step / 2 - radius.
    """
    points, row, range_m = rows.points, rows.row, rows.range_m
    jump = np.diff(range_m)
    before = np.flatnonzero(rows.is_next & (jump > _JUMP_M))
    after = np.flatnonzero(rows.is_next & (jump < -_JUMP_M))
    near = np.concatenate([before, after + 1])
    side = np.repeat([1, -1], [len(before), len(after)])
    size = np.abs(np.concatenate([jump[before], jump[after]]))
    # The near surface goes on: a single return between two surfaces is a blend of both.
    inner = np.clip(near - side, 0, len(points) - 1)
    step_m = np.abs(range_m[inner] - range_m[near])
    keep = (row[inner] == row[near]) & (step_m < _joint_m(range_m[near])) & (size > _JUMP_STEPS * step_m)
    near, side, size = near[keep], side[keep], size[keep]
    return _outline(points[near], side * rows.step_rad / 2, beam), _weight(size)


def _find_gaps(rows: _Rows, beam: Beam) -> tuple[Array, Array]:
    """Find outlines where returns do not follow each other in rings, and their weights.

    On one side of an outline's last return, all returns at about its elevation are farther; on the other, the
    next ones belong to its surface. Seen at a slant it has steps of all sizes, as returns lie at random:
    the jump is compared with its slope. The outline is midway in the gap, less the beam's radius.
    """
    points, weights = [], []
    for side in (1, -1):
        jump, gap_rad, is_near = rows.beside(np.arange(len(rows.points)), side)
        last = np.flatnonzero(is_near & (jump > _JUMP_M))
        size, gap_rad = jump[last], gap_rad[last]
        for k in range(2, _N_BEYOND + 1):
            jump, _, is_near = rows.beside(last, side * k)
            size = np.where(is_near, np.minimum(size, jump), size)
        step_m, apart_rad = np.zeros(len(last)), np.zeros(len(last))
        for k in range(1, _N_WITHIN + 1):
            jump, apart, is_near = rows.beside(last, -side * k)
            step_m = np.where(is_near, np.maximum(step_m, np.abs(jump)), step_m)
            apart_rad = np.where(is_near, apart, apart_rad)
        slope_m = step_m * np.maximum(gap_rad / np.maximum(apart_rad, 1e-9), 1.0)
        keep = (apart_rad > 0) & (step_m < _joint_m(rows.range_m[last]))
        keep &= (size > _JUMP_M) & (size > _JUMP_STEPS * slope_m)
        points.append(_outline(rows.points[last[keep]], side * gap_rad[keep] / 2, beam))
        weights.append(_weight(size[keep]))
    return np.concatenate(points), np.concatenate(weights)


def _outline(last: Array, turn_rad: Array, beam: Beam) -> Array:
    """Turn last returns (N, 3) about the LiDAR's axis to the outline, by angles less the beam's radius."""
    range_m = np.linalg.norm(last, axis=1)
    turn = turn_rad - np.sign(turn_rad) * beam.half_width_m(range_m) / range_m
    x, y, z = last.T
    return np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z], axis=1)


def _weight(size_m: Array) -> Array:
    return np.asarray(np.sqrt(np.minimum(size_m, _FULL_JUMP_M)))


def _find_changes(rows: _Rows) -> tuple[Array, Array]:
    """Find changes of reflectivity between two pairs of returns on a continuous surface, and their weights.

    A beam across such an edge reports a blend of both sides, so the edge lies midway between the pairs.
    """
    bright = float(np.percentile(rows.intensity, _BRIGHT_PERCENTILE)) if len(rows.intensity) else 0.0
    if bright <= 0 or len(rows.points) < 5:
        return np.zeros((0, 3)), np.zeros(0)
    level = np.minimum(rows.intensity / bright, 1.0)
    is_joint = rows.is_next & (np.abs(np.diff(rows.range_m)) < _joint_m(rows.range_m[1:]))
    outer, left, right, far = level[:-3], level[1:-2], level[2:-1], level[3:]
    change = np.abs(right + far - outer - left) / 2
    scatter = np.hypot(left - outer, far - right) / 2 / np.sqrt(2)
    is_edge = is_joint[:-2] & is_joint[1:-1] & is_joint[2:]
    is_edge &= (change > _LEAST_CHANGE) & (change > _CHANGE_SIGMAS * scatter)
    contrast = np.where(is_edge, change / ((outer + left + right + far) / 2 + 2 * _FAINT), 0.0)
    # The largest of each value and the two on either side.
    largest = np.max([np.pad(contrast, 2)[k : k + len(contrast)] for k in range(5)], axis=0)
    is_edge &= (contrast > _CONTRAST) & (contrast >= largest)
    first = np.flatnonzero(is_edge) + 1
    return (rows.points[first] + rows.points[first + 1]) / 2, np.sqrt(contrast[first - 1])


def _joint_m(range_m: Array) -> Array:
    """How far apart in range neighbours on one surface may be."""
    return np.asarray(0.15 + 0.02 * range_m)
