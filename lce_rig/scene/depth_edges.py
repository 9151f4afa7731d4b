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
class _Rings:
    """A scan in order of rings and azimuths; `is_neighbour` (N - 1,) tells which points follow each other."""

    points: Array
    ring: NDArray[np.int16]
    range_m: Array
    intensity: Array
    is_neighbour: NDArray[np.bool_]
    step_rad: float


def find_depth_edges(scan: Scan, beam: Beam) -> DepthEdges:
    """Find the outlines of near objects and the changes of reflectivity along the rings of a scan.

    Args:
        scan: without rings it has no edges; without intensities, no changes of reflectivity.
        beam: of this LiDAR.
    """
    rings = _in_order(scan)
    found = [_find_jumps(rings, beam), _find_changes(rings)]
    channel = np.repeat(np.arange(len(CHANNELS), dtype=np.int8), [len(points) for points, _ in found])
    points, weights = zip(*found, strict=True)
    return DepthEdges(np.concatenate(points), np.concatenate(weights), channel)


def _in_order(scan: Scan) -> _Rings:
    points = np.asarray(scan.points, dtype=np.float64)
    ring = np.asarray(scan.ring)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    order = np.lexsort((azimuth, ring))
    points, ring, azimuth = points[order], ring[order], azimuth[order]
    # Without rings, no two returns are known to be neighbours: such a scan has no edges.
    gap, is_neighbour = np.diff(azimuth), (np.diff(ring) == 0) & (ring[1:] != NO_RING)
    is_step = is_neighbour & (gap > 0)
    step_rad = float(np.median(gap[is_step])) if is_step.any() else 0.0
    is_neighbour &= gap < _GAP_STEPS * step_rad
    intensity = np.asarray(scan.intensity, dtype=np.float64)[order]
    return _Rings(points, ring, np.linalg.norm(points, axis=1), intensity, is_neighbour, step_rad)


def _find_jumps(rings: _Rings, beam: Beam) -> tuple[Array, Array]:
    """Find outlines, and their weights.

    A return belongs to the near object while any part of the beam meets it, so the last one lies beyond the
    outline by up to the beam's radius, and on average half an azimuth step short of that:
    edge = last return + step / 2 - radius.
    """
    points, ring, range_m = rings.points, rings.ring, rings.range_m
    jump = np.diff(range_m)
    before = np.flatnonzero(rings.is_neighbour & (jump > _JUMP_M))
    after = np.flatnonzero(rings.is_neighbour & (jump < -_JUMP_M))
    near = np.concatenate([before, after + 1])
    side = np.repeat([1, -1], [len(before), len(after)])
    size = np.abs(np.concatenate([jump[before], jump[after]]))
    # The near surface goes on: a single return between two surfaces is a blend of both.
    inner = np.clip(near - side, 0, len(points) - 1)
    step_m = np.abs(range_m[inner] - range_m[near])
    keep = (ring[inner] == ring[near]) & (step_m < _joint_m(range_m[near])) & (size > _JUMP_STEPS * step_m)
    near, side, size = near[keep], side[keep], size[keep]
    turn = side * (rings.step_rad / 2 - beam.half_width_m(range_m[near]) / range_m[near])
    x, y, z = points[near].T
    turned = np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z], axis=1)
    return turned, np.sqrt(np.minimum(size, _FULL_JUMP_M))


def _find_changes(rings: _Rings) -> tuple[Array, Array]:
    """Find changes of reflectivity between two pairs of returns on a continuous surface, and their weights.

    A beam across such an edge reports a blend of both sides, so the edge lies midway between the pairs.
    """
    bright = float(np.percentile(rings.intensity, _BRIGHT_PERCENTILE)) if len(rings.intensity) else 0.0
    if bright <= 0 or len(rings.points) < 5:
        return np.zeros((0, 3)), np.zeros(0)
    level = np.minimum(rings.intensity / bright, 1.0)
    is_joint = rings.is_neighbour & (np.abs(np.diff(rings.range_m)) < _joint_m(rings.range_m[1:]))
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
    return (rings.points[first] + rings.points[first + 1]) / 2, np.sqrt(contrast[first - 1])


def _joint_m(range_m: Array) -> Array:
    """How far apart in range neighbours on one surface may be."""
    return np.asarray(0.15 + 0.02 * range_m)
