"""Outlines of near objects in a point cloud, with the direction across each."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.detect.lidar.measurement import Beam

KINDS_OF_EDGES = ("upright outline", "level outline", "upright change of reflectivity")
"""Jumps in range along and across rings, and changes of reflectivity along rings.

Across rings, reflectivities differ by the calibration of the lasers as well.
"""
UPRIGHT, LEVEL, REFLECTIVITY = range(len(KINDS_OF_EDGES))

_N_NEIGHBOURS = 24  # returns: two rings on either side of an HDL-64E, and five azimuth steps
_NEAR_RAD = 0.016  # Largest angle to a neighbour: twice the gap between the lower rings of an HDL-64E.
_JOINT_M, _JOINT_SHARE = 0.15, 0.02  # Largest step on one surface: m, and share of the range.
_JUMP_M = 2 * _JOINT_M  # Smallest jump of range at an outline: above the relief of one surface.
# Smallest ratio of a jump to the step on the near surface, which a slanted wall has as well.
_JUMP_STEPS = 3.0
_FULL_JUMP_M = 10 * _JUMP_M  # Jump above which the weight no longer grows.

_BRIGHT_PERCENTILE = 95  # Reflectivity taken as 1; road signs are far brighter.
_FAINT = 0.05  # Reflectivity, and change of it, at the level of noise.
_CONTRAST = 0.2  # Smallest |a - b| / (a + b)
_CHANGE_SIGMAS = 2.0  # of the scatter on both sides


@dataclass(frozen=True, eq=False)
class Outlines:
    """Points on the edges of a scan.

    Attributes:
        points: (N, 3) m, frame lidar.
        weight: (N,) root of the jump in range (m^0.5), or of the contrast in reflectivity.
        kind: (N,) index of KINDS_OF_EDGES.
    """

    points: Array
    weight: Array
    kind: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> "Outlines":
        """Keep the points of a mask or of indices."""
        return Outlines(self.points[keep], self.weight[keep], self.kind[keep])


@dataclass(frozen=True, eq=False)
class _Neighbours:
    """The nearest returns by angle.

    Attributes:
        index: (N, K) of the neighbour; without meaning where not near.
        apart_rad: (2, N, K) azimuth times the cosine of elevation, and elevation, to the neighbour.
        farther_m: (N, K) its range less the own.
        is_near: (N, K) whether the angle is small enough.
        sectors: (N, K) near neighbours in the quarter about each direction: an axis and a side, 1 or -1.
    """

    index: NDArray[np.intp]
    apart_rad: Array
    farther_m: Array
    is_near: NDArray[np.bool_]
    sectors: Mapping[tuple[int, int], NDArray[np.bool_]]


def find_outlines(points: NDArray[Any], intensity: NDArray[Any], beam: Beam) -> Outlines:
    """Find outlines of near objects in four directions, and vertical edges of reflectivity.

    Neighbours by angle take the place of rings, so that LiDARs without rings have outlines as well. Sparse
    rings have no neighbours above and below, and so no level outlines.

    Args:
        points: (N, 3) m, frame lidar.
        intensity: (N,).
        beam: beam of this LiDAR.
    """
    points = np.asarray(points, dtype=np.float64)
    range_m = np.linalg.norm(points, axis=1)
    is_valid = np.isfinite(range_m) & (range_m > 0)
    points, range_m = points[is_valid], range_m[is_valid]
    if len(points) <= _N_NEIGHBOURS:
        return Outlines(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.int8))
    near = _neighbours(points, range_m)
    parts = [_jumps(points, range_m, near, axis, side, beam) for axis in (0, 1) for side in (1, -1)]
    parts.append(_changes(points, range_m, np.asarray(intensity, dtype=np.float64)[is_valid], near))
    return Outlines(*map(np.concatenate, zip(*parts, strict=True)))


def _neighbours(points: Array, range_m: Array) -> _Neighbours:
    from scipy.spatial import cKDTree

    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arcsin(np.clip(points[:, 2] / range_m, -1.0, 1.0))
    # Angles on the sphere, by chords, so that neither the seam behind the LiDAR nor the poles matter.
    rays = points / range_m[:, None]
    _, index = cKDTree(rays).query(rays, _N_NEIGHBOURS + 1, distance_upper_bound=_NEAR_RAD)
    n_near = np.sum(index < len(rays), axis=1)  # including the point itself, the first
    index = index[:, 1 : max(int(n_near.max()), 2)]
    is_near = index < len(rays)
    index = np.where(is_near, index, 0)
    turn = np.remainder(azimuth[index] - azimuth[:, None] + np.pi, 2 * np.pi) - np.pi
    apart = np.stack([turn * np.cos(elevation)[:, None], elevation[index] - elevation[:, None]])
    across = np.abs(apart[::-1])
    sectors = {
        (axis, side): is_near & (side * apart[axis] > across[axis]) for axis in (0, 1) for side in (1, -1)
    }
    return _Neighbours(index, apart, range_m[index] - range_m[:, None], is_near, sectors)


def _jumps(
    points: Array, range_m: Array, near: _Neighbours, axis: int, side: int, beam: Beam
) -> tuple[Array, Array, NDArray[np.int8]]:
    """Find returns beyond which all neighbours on one side are farther; the outline is midway in the gap.

    The near surface goes on to the other side: a return between two surfaces is a blend of both.
    """
    along = side * near.apart_rad[axis]
    beyond, within = near.sectors[axis, side], near.sectors[axis, -side]
    jump = np.where(beyond, near.farther_m, np.inf).min(axis=1)
    gap_rad = np.where(beyond, along, np.inf).min(axis=1)
    before = np.where(within, -along, np.inf).argmin(axis=1)[:, None]
    step_m = np.abs(np.take_along_axis(near.farther_m, before, axis=1)[:, 0])
    step_rad = -np.take_along_axis(along, before, axis=1)[:, 0]
    keep = beyond.any(axis=1) & within.any(axis=1) & (jump > _JUMP_M) & (step_m < _joint_m(range_m))
    kept = np.flatnonzero(keep)
    slope_m = step_m[kept] * np.maximum(gap_rad[kept] / np.maximum(step_rad[kept], 1e-4), 1.0)
    kept = kept[jump[kept] > _JUMP_STEPS * slope_m]
    # A return belongs to the near object as long as any part of the beam hits it.
    beam_rad = beam.half_width_m(range_m[kept]) / range_m[kept]
    turn_rad = side * np.maximum(gap_rad[kept] / 2 - beam_rad, -gap_rad[kept] / 2)
    moved = _turned(points[kept], range_m[kept], axis, turn_rad)
    kind = np.full(len(kept), (UPRIGHT, LEVEL)[axis], dtype=np.int8)
    return moved, np.sqrt(np.minimum(jump[kept], _FULL_JUMP_M)), kind


def _turned(points: Array, range_m: Array, axis: int, turn_rad: Array) -> Array:
    """Rotate points (N, 3) along azimuth (axis 0, angle on the sphere) or elevation (axis 1)."""
    flat_m = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
    azimuth, elevation = np.arctan2(points[:, 1], points[:, 0]), np.arctan2(points[:, 2], flat_m)
    if axis == 0:
        azimuth = azimuth + turn_rad * range_m / flat_m
    else:
        elevation = elevation + turn_rad
    east, north, up = np.cos(azimuth), np.sin(azimuth), np.sin(elevation)
    flat = np.cos(elevation)
    return np.asarray(range_m[:, None] * np.stack([flat * east, flat * north, up], axis=1))


def _changes(
    points: Array, range_m: Array, intensity: Array, near: _Neighbours
) -> tuple[Array, Array, NDArray[np.int8]]:
    """Find where the mean reflectivity of the neighbours on both sides differs, on one surface."""
    bright = max(float(np.percentile(intensity, _BRIGHT_PERCENTILE)), 1e-9)
    level = np.minimum(intensity / bright, 1.0)[near.index]
    means, spread, is_seen = [], np.zeros(len(points)), np.ones(len(points), dtype=bool)
    for side in (1, -1):
        chosen = near.sectors[0, side]
        count = np.maximum(chosen.sum(axis=1), 1)
        mean = (level * chosen).sum(axis=1) / count
        spread += np.maximum((level**2 * chosen).sum(axis=1) / count - mean**2, 0.0)
        is_seen &= count > 1
        means.append(mean)
    change = np.abs(means[0] - means[1])
    is_edge = is_seen & (change > _FAINT) & (change > _CHANGE_SIGMAS * np.sqrt(spread))
    is_edge &= np.where(near.is_near, np.abs(near.farther_m), 0.0).max(axis=1) < _joint_m(range_m)
    contrast = np.where(is_edge, change / (means[0] + means[1] + 2 * _FAINT), 0.0)
    beside = near.sectors[0, 1] | near.sectors[0, -1]
    largest = np.where(beside, contrast[near.index], 0.0).max(axis=1)
    kept = np.flatnonzero((contrast > _CONTRAST) & (contrast >= largest))
    return points[kept], np.sqrt(contrast[kept]), np.full(len(kept), REFLECTIVITY, dtype=np.int8)


def _joint_m(range_m: Array) -> Array:
    """Return the largest step in range between neighbours on one surface."""
    return np.asarray(_JOINT_M + _JOINT_SHARE * range_m)
