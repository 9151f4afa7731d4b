"""Depth edges of a scan: where a surface ends before a farther one, as the LiDAR sees it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array

_JUMP_M = 0.3
_FULL_JUMP_M = 3.0  # Larger jumps count no more: what lies behind an edge does not sharpen it.
_GAP_STEPS = 3.5  # Neighbours on a ring are at most so many azimuth steps apart.
_DENSE_RAD = np.radians(1.0)  # Rings farther apart leave the height of an edge open by more than they tell.


@dataclass(frozen=True)
class Beam:
    """Size of a LiDAR's beam.

    Attributes:
        aperture_m: diameter where it leaves the sensor.
        divergence_rad: full opening.
    """

    aperture_m: float
    divergence_rad: float

    def radius_m(self, range_m: Array) -> Array:
        """Half the beam's diameter at a range (N,)."""
        return (self.aperture_m + self.divergence_rad * range_m) / 2


@dataclass(frozen=True, eq=False)
class DepthEdges:
    """Points on the outlines of near objects.

    Attributes:
        points: (N, 3) m, frame lidar.
        weight: (N,) root of the jump in range, m^0.5.
        is_level: (N,) whether the outline separates two rings (is level) instead of two azimuths (upright).
        ring_step_rad: median elevation between neighbouring rings; inf with one ring.
    """

    points: Array
    weight: Array
    is_level: NDArray[np.bool_]
    ring_step_rad: float

    def __len__(self) -> int:
        return len(self.points)


def find_depth_edges(scan: Scan, beam: Beam) -> DepthEdges:
    """Find the outlines of near objects: jumps along rings, and between rings where these are dense.

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
        return DepthEdges(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=bool), float("inf"))
    step_rad = float(np.median(gap[is_neighbour & (gap > 0)]))
    is_neighbour &= gap < _GAP_STEPS * step_rad

    upright, upright_weight = _upright(points, range_m, ring, is_neighbour, step_rad, beam)
    elevation = np.arcsin(np.clip(points[:, 2] / np.maximum(range_m, 1e-9), -1.0, 1.0))
    names = np.unique(ring)
    heights = np.array([np.median(elevation[ring == name]) for name in names])
    ring_step_rad = float(np.median(np.diff(np.sort(heights)))) if len(names) > 1 else float("inf")
    level, level_weight = np.zeros((0, 3)), np.zeros(0)
    if ring_step_rad < _DENSE_RAD:
        rings = [np.flatnonzero(ring == names[k]) for k in np.argsort(heights)]
        level, level_weight = _level(points, range_m, azimuth, rings, step_rad)
    is_level = np.repeat([False, True], [len(upright), len(level)])
    weight = np.concatenate([upright_weight, level_weight])
    return DepthEdges(np.concatenate([upright, level]), weight, is_level, ring_step_rad)


def _upright(
    points: Array,
    range_m: Array,
    ring: NDArray[np.int16],
    is_neighbour: NDArray[np.bool_],
    step_rad: float,
    beam: Beam,
) -> tuple[Array, Array]:
    """Find jumps along rings: points (N, 3) on the near surface's outline, and their weights."""
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
    turn = side * (step_rad / 2 - beam.radius_m(range_m[near]) / range_m[near])
    x, y, z = points[near].T
    turned = np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z], axis=1)
    return turned, np.sqrt(np.minimum(size, _FULL_JUMP_M))


def _is_continuous(range_1_m: Array, range_2_m: Array) -> NDArray[np.bool_]:
    return np.asarray(np.abs(range_1_m - range_2_m) < 0.15 + 0.02 * range_2_m)


def _level(
    points: Array, range_m: Array, azimuth: Array, rings: list[NDArray[np.intp]], step_rad: float
) -> tuple[Array, Array]:
    """Find jumps between neighbouring rings, halfway between them: points (N, 3) and weights.

    A floor or wall seen at a grazing angle is no jump: its inverse range changes evenly from ring to ring.
    The far side must lie beyond that.
    """
    found, weights = [np.zeros((0, 3))], [np.zeros(0)]
    for inner, near, far in [
        trio for k in range(1, len(rings) - 1) for trio in (rings[k - 1 : k + 2], rings[k - 1 : k + 2][::-1])
    ]:
        of_inner, of_far = _nearest(azimuth, near, inner), _nearest(azimuth, near, far)
        r_inner, r_near, r_far = range_m[of_inner], range_m[near], range_m[of_far]
        apart = np.maximum(np.abs(azimuth[of_inner] - azimuth[near]), np.abs(azimuth[of_far] - azimuth[near]))
        flatness = 2 / np.maximum(r_near, 1e-9) - 1 / np.maximum(r_inner, 1e-9)
        expected_m = np.where(flatness > 0, 1 / np.maximum(flatness, 1e-9), np.inf)
        jump = r_far - np.maximum(r_near, expected_m)
        keep = (apart < step_rad) & (jump > _JUMP_M) & _is_continuous(r_inner, r_near)
        direction = points[near[keep]] / r_near[keep, None] + points[of_far[keep]] / r_far[keep, None]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        found.append(direction * r_near[keep, None])
        weights.append(np.sqrt(np.minimum(jump[keep], _FULL_JUMP_M)))
    return np.concatenate(found), np.concatenate(weights)


def _nearest(azimuth: Array, of: NDArray[np.intp], among: NDArray[np.intp]) -> NDArray[np.intp]:
    """Find for each point of a ring the one of another ring with the nearest azimuth."""
    right = np.clip(np.searchsorted(azimuth[among], azimuth[of]), 1, max(len(among) - 1, 1))
    right = np.minimum(right, len(among) - 1)
    left = np.maximum(right - 1, 0)
    is_left = np.abs(azimuth[among[left]] - azimuth[of]) < np.abs(azimuth[among[right]] - azimuth[of])
    return np.asarray(among[np.where(is_left, left, right)])
