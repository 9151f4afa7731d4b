"""Depth edges of a scan: where a surface ends before a farther one, as the LiDAR sees it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array
from lce_rig.detect.lidar.measurement import Beam

_JUMP_M = 0.3
_FULL_JUMP_M = 3.0  # Larger jumps count no more: what lies behind an edge does not sharpen it.
_GAP_STEPS = 3.5  # Neighbours on a ring are at most so many azimuth steps apart.


@dataclass(frozen=True, eq=False)
class DepthEdges:
    """Points on the outlines of near objects.

    Attributes:
        points: (N, 3) m, frame lidar.
        weight: (N,) root of the jump in range, m^0.5.
    """

    points: Array
    weight: Array

    def __len__(self) -> int:
        return len(self.points)

    def select(self, keep: NDArray[np.bool_]) -> "DepthEdges":
        """Keep the points of a mask (N,)."""
        return DepthEdges(self.points[keep], self.weight[keep])


def find_depth_edges(scan: Scan, beam: Beam) -> DepthEdges:
    """Find the outlines of near objects: jumps along rings.

    A return belongs to the near object while any part of the beam meets it, so the last one lies beyond the
    outline by up to the beam's radius, and on average half an azimuth step short of that:
    edge = last return + step / 2 - radius.

    Args:
        scan: with rings.
        beam: of this LiDAR.
    """
    points = np.asarray(scan.points, dtype=np.float64)
    ring = np.asarray(scan.ring)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    order = np.lexsort((azimuth, ring))
    points, ring, azimuth = points[order], ring[order], azimuth[order]
    range_m = np.linalg.norm(points, axis=1)
    gap, is_neighbour = np.diff(azimuth), np.diff(ring) == 0
    if not np.any(is_neighbour & (gap > 0)):
        return DepthEdges(np.zeros((0, 3)), np.zeros(0))
    step_rad = float(np.median(gap[is_neighbour & (gap > 0)]))
    is_neighbour &= gap < _GAP_STEPS * step_rad

    jump = np.diff(range_m)
    before = np.flatnonzero(is_neighbour & (jump > _JUMP_M))
    after = np.flatnonzero(is_neighbour & (jump < -_JUMP_M))
    near = np.concatenate([before, after + 1])
    side = np.repeat([1, -1], [len(before), len(after)])
    size = np.abs(np.concatenate([jump[before], jump[after]]))
    # The near surface goes on: a single return between two surfaces is a blend of both.
    inner = np.clip(near - side, 0, len(points) - 1)
    keep = (ring[inner] == ring[near]) & _is_continuous(range_m[inner], range_m[near])
    near, side, size = near[keep], side[keep], size[keep]
    turn = side * (step_rad / 2 - beam.half_width_m(range_m[near]) / range_m[near])
    x, y, z = points[near].T
    turned = np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z], axis=1)
    return DepthEdges(turned, np.sqrt(np.minimum(size, _FULL_JUMP_M)))


def _is_continuous(range_1_m: Array, range_2_m: Array) -> NDArray[np.bool_]:
    return np.asarray(np.abs(range_1_m - range_2_m) < 0.15 + 0.02 * range_2_m)
