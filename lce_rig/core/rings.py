"""The laser of each point of a spinning LiDAR, inferred from the points alone."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import SourceError
from lce_rig.core.geometry import Array

BIN_RAD = np.radians(0.02)
MAX_RINGS = 256
MAX_OFFSET_M = 0.015


def rings_from_elevation(points_lidar: NDArray[Any]) -> NDArray[np.int16]:
    """Number the lasers of a point cloud without a ring field, 0 = lowest elevation.

    A laser mounted h above the origin of the frame and inclined by alpha draws the line
    z = rho tan(alpha) + h over the distance rho from the vertical axis. The lines are found as peaks of
    elevation among the far points, where h (11 mm at most on a VLP-16) hardly bends them, and refitted with
    all points; what no line explains is searched again, for lasers that see little or only what is near.

    Args:
        points_lidar: (N, 3) m, frame lidar (z along the axis of rotation); NaN where there is no return.

    Returns:
        (N,) int16; -1 where the point is not finite or lies at the origin.

    Raises:
        SourceError: the elevations form no rings, as with a solid-state LiDAR or a point cloud that was
            moved.
    """
    points = np.asarray(points_lidar, dtype=np.float64)
    rho = np.hypot(points[:, 0], points[:, 1])
    is_valid = np.isfinite(points).all(axis=1) & (rho > 1e-3)
    ring = np.full(len(points), -1, dtype=np.int16)
    if is_valid.any():
        ring[is_valid] = _assign(rho[is_valid], points[is_valid, 2])
    return ring


def _assign(rho: Array, z: Array) -> NDArray[np.int16]:
    """Find the lines and the nearest line of each point (rho, z)."""
    slope = z / rho
    lines = np.zeros((0, 2))
    is_left = rho >= min(3.0, float(np.median(rho)))
    for _ in range(3):
        peaks = np.tan(_elevation_peaks(np.arctan(slope[is_left])))
        lines = np.concatenate([lines, np.stack([peaks, np.zeros_like(peaks)], axis=1)])
        if not len(lines):
            raise SourceError(
                f"no rings in the cloud: its {len(rho)} points are too few or too scattered to tell",
                "give the cloud with its ring field, or as the LiDAR's driver publishes it",
            )
        lines = _refine_lines(rho, z, lines[np.argsort(lines[:, 0])])
        ring, miss = _nearest_line(rho, z, lines)
        is_left = (miss > MAX_OFFSET_M) & (miss > 5 * BIN_RAD * rho)
        if is_left.sum() < max(3, 1e-4 * len(rho)):
            break
    seen, ring_of_seen = np.unique(ring, return_inverse=True)
    if len(seen) > MAX_RINGS or np.mean(is_left) > 0.1:
        raise SourceError(
            f"no rings in the cloud: {100 * np.mean(is_left):.0f} % of its points lie on none of the "
            f"{len(seen)} elevations found",
            "give the cloud with its ring field, or in the frame of the LiDAR as its driver publishes it",
        )
    return ring_of_seen.astype(np.int16)


def _elevation_peaks(elevation: Array) -> Array:
    """Find elevations in rad that many points share: runs of a histogram above its thin background."""
    low = elevation.min() - 2 * BIN_RAD
    bins = ((elevation - low) / BIN_RAD).astype(np.intp)
    counts = np.bincount(bins, minlength=int(bins.max()) + 3).astype(np.float64)
    smooth = np.convolve(counts, np.ones(3), mode="same")
    level = max(2.5, 0.05 * float(np.quantile(smooth[smooth > 0], 0.9)))
    step = np.diff(np.concatenate([[0], smooth > level, [0]]).astype(np.int8))
    bounds = np.stack([np.flatnonzero(step > 0), np.flatnonzero(step < 0)], axis=1).ravel()
    if len(bounds) == 0:
        return np.zeros(0)
    centres = low + (np.arange(len(counts)) + 0.5) * BIN_RAD
    weight = np.add.reduceat(np.append(counts, 0.0), bounds)[::2]
    moment = np.add.reduceat(np.append(counts * centres, 0.0), bounds)[::2]
    return np.asarray(moment[weight > 0] / weight[weight > 0])


def _nearest_line(rho: Array, z: Array, lines: Array) -> tuple[NDArray[np.intp], Array]:
    """Find the line (slope, offset) nearest in z to each point, and the distance in m; lines rise."""
    # An offset moves a point no further than to the neighbour of the line with the nearest slope.
    guess = np.searchsorted((lines[1:, 0] + lines[:-1, 0]) / 2, z / rho)
    nearest, miss = guess, np.abs(z - rho * lines[guess, 0] - lines[guess, 1])
    for shift in (-1, 1):
        other = np.clip(guess + shift, 0, len(lines) - 1)
        other_miss = np.abs(z - rho * lines[other, 0] - lines[other, 1])
        is_better = other_miss < miss
        nearest, miss = np.where(is_better, other, nearest), np.where(is_better, other_miss, miss)
    return nearest, miss


def _refine_lines(rho: Array, z: Array, lines: Array, n_rounds: int = 3) -> Array:
    """Fit z / rho = slope + offset / rho to the points of each line, least squares in elevation."""
    n = len(lines)
    if n < 2:
        return lines
    x, y = 1.0 / rho, z / rho
    for _ in range(n_rounds):
        ring, _ = _nearest_line(rho, z, lines)
        count = np.maximum(np.bincount(ring, minlength=n), 1)
        mean_x, mean_y = np.bincount(ring, x, n) / count, np.bincount(ring, y, n) / count
        dx, dy = x - mean_x[ring], y - mean_y[ring]
        # A prior holds the offset at zero where a ring sees a single distance (0.1 mrad against 15 mm).
        prior = (1e-4 / MAX_OFFSET_M) ** 2 * count
        offset = np.bincount(ring, dx * dy, n) / (np.bincount(ring, dx * dx, n) + prior)
        offset = np.clip(offset, -MAX_OFFSET_M, MAX_OFFSET_M)
        refined = np.stack([mean_y - offset * mean_x, offset], axis=1)
        is_seen = np.bincount(ring, minlength=n) > 0
        lines = np.where(is_seen[:, None], refined, lines)
        lines = lines[np.argsort(lines[:, 0], kind="stable")]
    return lines
