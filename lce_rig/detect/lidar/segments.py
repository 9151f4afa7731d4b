"""A scan as rings of ordered returns, split into straight segments described by their sums."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array

Indices = NDArray[np.intp]
Floats = NDArray[np.float32]

# Maximum angle between the board's normal and the beam, rad; more is not a useful view.
MAX_INCIDENCE_RAD = np.radians(70.0)
MIN_POINTS = 4  # returns that make a segment
MAX_STEPS = 3.6  # firings from one return to the next on the same surface; dark squares drop single ones
RANGE_NOISE_FLOOR_M = 0.004


@dataclass(frozen=True, eq=False)
class OrderedScan:
    """The usable returns of a scan, sorted by ring and then by azimuth.

    Each ring starts at a gap or range jump, so that the seam at azimuth +-pi does not split a surface.

    Attributes:
        index: (N,) index of each return in the original scan.
        points: (N, 3) m, frame lidar.
        range_m: (N,).
        azimuth: (N,) atan2(y, x), rad.
        ring: (N,).
        is_break: (N,) whether the ring's previous return lies on another surface or too far away.
        step_rad: angle between neighbouring firings of one ring.
        sigma_m: noise of a single range.
    """

    index: Indices
    points: Floats
    range_m: Floats
    azimuth: Floats
    ring: NDArray[np.int16]
    is_break: NDArray[np.bool_]
    step_rad: float
    sigma_m: float


@dataclass(frozen=True, eq=False)
class Segments:
    """S runs of neighbouring returns of one ring, sorted by ring and azimuth.

    Attributes:
        start, end: (S,) half-open range of returns in the `OrderedScan`.
        ring: (S,).
        count: (S,) number of returns.
        centre: (S, 3) mean, m.
        scatter: (S, 3, 3) sum of (p - mean)(p - mean)^T, m^2.
        direction: (S, 3) unit vector from the first to the last return.
        length_m: (S,) between them.
        lateral_m: (S,) rms distance of the returns from the segment's line.
    """

    start: Indices
    end: Indices
    ring: NDArray[np.int16]
    count: Array
    centre: Array
    scatter: Array
    direction: Array
    length_m: Array
    lateral_m: Array

    def select(self, keep: NDArray[np.bool_]) -> "Segments":
        """Keep the segments of a mask (S,)."""
        return Segments(*(getattr(self, field.name)[keep] for field in fields(self)))


def order_scan(scan: Scan, min_range_m: float) -> OrderedScan:
    """Sort the returns of a scan by ring and azimuth and estimate its noise.

    Args:
        scan: the full revolution or any part of it.
        min_range_m: nearer returns are dropped, as are NaN, infinite and zero ones.
    """
    points = scan.points
    x, y, z = np.ascontiguousarray(points.T)
    with np.errstate(over="ignore", invalid="ignore"):
        range_m = np.sqrt(x * x + y * y + z * z)
        azimuth = np.arctan2(y, x)
        is_usable = (range_m >= min_range_m) & (range_m < 1e4)  # false for NaN and infinity
    # Drivers deliver by time, which is almost by azimuth: a stable sort finds the presorted runs.
    order = np.argsort(scan.ring, kind="stable")
    order = order[is_usable[order]]
    order = _by_azimuth(order, scan.ring[order], azimuth[order])
    ring, azimuth, range_m = scan.ring[order], azimuth[order], range_m[order]
    if len(order) == 0:
        no_break = np.zeros(0, dtype=np.bool_)
        return OrderedScan(order, points[order], range_m, azimuth, ring, no_break, 0.0, RANGE_NOISE_FLOOR_M)
    starts = _starts(ring)
    turn, jump = _since_previous(azimuth, starts), np.abs(_since_previous(range_m, starts))
    turn[starts] = np.mod(turn[starts], 2 * np.float32(np.pi))
    step_rad, sigma_m = _azimuth_step(turn), _range_noise(turn, range_m, ring)
    # Compute the largest change of range in m between neighbours on one tilted plane, with its noise.
    slope = float(np.tan(MAX_INCIDENCE_RAD))
    limit = np.asarray(range_m * np.minimum(turn, 0.02) * slope + 6.0 * sigma_m)
    is_break = (turn > MAX_STEPS * step_rad) | (jump > limit)
    # List the returns (N,) so that each ring begins at its first break; rings begin at `starts`.
    pieces = []
    for start, end in zip(starts, [*starts[1:], len(is_break)], strict=True):
        first = start + int(np.argmax(is_break[start:end]))
        pieces += [np.arange(first, end), np.arange(start, first)]
    turned = np.concatenate(pieces)
    is_break = is_break[turned]
    is_break[starts] = True
    order, range_m, azimuth = order[turned], range_m[turned], azimuth[turned]
    return OrderedScan(order, points.take(order, axis=0), range_m, azimuth, ring, is_break, step_rad, sigma_m)


def _starts(ring: NDArray[np.int16]) -> Indices:
    """Return the start index of each ring in returns (N,) sorted by ring."""
    return np.append(0, np.flatnonzero(ring[1:] != ring[:-1]) + 1)


def _since_previous(values: Floats, starts: Indices) -> Floats:
    """Subtract the previous value of the ring from each value (N,), cyclically."""
    change = np.empty_like(values)
    change[1:] = values[1:] - values[:-1]
    change[starts] = values[starts] - values[np.append(starts[1:], len(values)) - 1]
    return change


def _by_azimuth(order: Indices, ring: NDArray[np.int16], azimuth: Floats) -> Indices:
    """Sort each ring's returns, given in firing order, by azimuth; drop those of a second revolution.

    A scan of slightly more than one revolution has the same directions twice, 0.1 s apart; mixed, they would
    split moving objects. Point clouds that are not in order of firing stay complete.
    """
    if len(order) == 0:
        return order
    starts = _starts(ring)
    # Bring differences of two azimuths, rad, to -pi..pi.
    angle = np.diff(azimuth, prepend=azimuth[:1])
    turn = np.asarray(angle - 2 * np.float32(np.pi) * np.rint(angle / (2 * np.float32(np.pi))))
    turn[starts] = 0.0
    is_ordered = not 0.05 < np.count_nonzero(turn > 0) / len(turn) < 0.95
    if is_ordered and np.abs(np.add.reduceat(turn, starts)).max() >= 2 * np.pi:
        total = np.cumsum(turn, dtype=np.float64)
        total -= np.repeat(total[starts], np.diff(np.append(starts, len(order))))
        is_first_turn = np.abs(total) < 2 * np.pi
        order, ring, azimuth = order[is_first_turn], ring[is_first_turn], azimuth[is_first_turn]
    return order[np.argsort(ring * 8.0 + azimuth, kind="stable")]


def _azimuth_step(turn: Floats) -> float:
    """Find the firing interval in rad: the mean of the common differences of azimuth, 0 without returns."""
    forward = turn[(turn > 1e-4) & (turn < 0.05)]
    if len(forward) == 0:
        return 0.0
    middle = float(np.median(forward[:: 1 + len(forward) // 1000]))
    common = forward[np.abs(forward - middle) < 0.3 * middle]
    # Among few returns, such as those near a predicted board, two steps may have nothing in common.
    return float(np.mean(common, dtype=np.float64)) if len(common) else middle


def _range_noise(turn: Floats, range_m: Floats, ring: NDArray[np.int16]) -> float:
    """Estimate the range noise from second differences along the rings, 0 on planes up to curvature.

    The lower quartile of |r[i-1] - 2 r[i] + r[i+1]| / sqrt(6) is used, as edges and foliage spoil the rest.
    """
    second = np.abs(range_m[:-2] - 2 * range_m[1:-1] + range_m[2:])
    is_plain = (ring[:-2] == ring[2:]) & (turn[1:-1] < 0.01) & (turn[2:] < 0.01)
    second = second[is_plain]
    if len(second) < 20:
        return 0.01
    quartile = float(np.partition(second, len(second) // 4)[len(second) // 4])
    return max(quartile / (0.3186 * float(np.sqrt(6.0))), RANGE_NOISE_FLOOR_M)


def cut_segments(scan: OrderedScan, max_range_m: float, max_length_m: float = np.inf) -> Segments:
    """Split the rings at gaps and jumps, then at bends, and keep the straight pieces.

    A run with returns off its chord is cut at the farthest one, as a polyline is simplified.

    Args:
        scan: all returns.
        max_range_m: runs whose first return is farther are dropped.
        max_length_m: longer pieces are dropped: walls hold most of a scan's returns.

    References:
        D. Douglas and T. Peucker, "Algorithms for the reduction of the number of points required to represent
        a digitized line", Cartographica 10(2), 1973.
    """
    start = np.flatnonzero(scan.is_break)
    end = np.append(start[1:], len(scan.index))
    tolerance_m = 4.0 * scan.sigma_m + 0.01
    is_kept = (end - start >= MIN_POINTS) & (scan.range_m[start] <= max_range_m) if len(start) else start > 0
    start, end = start[is_kept], end[is_kept]
    xyz = np.ascontiguousarray(scan.points.T)
    done = []
    for _ in range(4):
        if len(start) == 0:
            break
        worst, distance = _worst_from_chord(xyz, start, end)
        is_straight = distance <= tolerance_m
        is_short = np.linalg.norm(xyz[:, end - 1] - xyz[:, start], axis=0) <= max_length_m
        done.append(np.stack([start[is_straight & is_short], end[is_straight & is_short]]))
        bent = ~is_straight
        start, middle, end = start[bent], worst[bent], end[bent]
        start, end = np.concatenate([start, middle]), np.concatenate([middle, end])
        is_kept = end - start >= MIN_POINTS
        start, end = start[is_kept], end[is_kept]
    bounds = np.concatenate([*done, np.stack([start, end])], axis=1)
    bounds = bounds[:, np.argsort(bounds[0])]
    return _describe(xyz, scan.ring, bounds[0], bounds[1])


def _unroll(start: Indices, end: Indices) -> tuple[Indices, Indices, Indices]:
    """Expand half-open ranges: start of each (S,), range (M,) and index (M,) of each member."""
    count = end - start
    begins = np.cumsum(count) - count
    run = np.repeat(np.arange(len(count)), count)
    return begins, run, np.arange(len(run)) + (start - begins)[run]


def _worst_from_chord(xyz: Floats, start: Indices, end: Indices) -> tuple[Indices, Floats]:
    """Find in each run of returns (3, N) the one farthest from the line through its ends, and how far in m.

    The ends are means of three returns, so that the noise of one does not tilt the chord.
    """
    begins, run, member = _unroll(start, end)
    first = (xyz[:, start] + xyz[:, start + 1] + xyz[:, start + 2]) / 3
    last = (xyz[:, end - 1] + xyz[:, end - 2] + xyz[:, end - 3]) / 3
    direction = last - first
    direction /= np.maximum(np.linalg.norm(direction, axis=0), 1e-9)
    # Rows of coordinates, and take for gathers: several times faster than rows of points.
    offset = xyz.take(member, axis=1) - first.take(run, axis=1)
    along = (offset * direction.take(run, axis=1)).sum(axis=0)
    squared = (offset * offset).sum(axis=0) - along * along
    largest = np.maximum.reduceat(squared, begins)
    at = np.flatnonzero(squared >= largest[run])
    worst = member[at[np.searchsorted(at, begins)]]
    return worst, np.sqrt(np.maximum(largest, 0.0))


def _describe(xyz: Floats, ring: NDArray[np.int16], start: Indices, end: Indices) -> Segments:
    """Compute the sums over the returns (3, N) of each run."""
    begins, run, member = _unroll(start, end)
    count = (end - start).astype(np.float64)
    points = xyz.take(member, axis=1)
    centre = np.add.reduceat(points, begins, axis=1, dtype=np.float64) / count
    spread = points - centre.astype(np.float32).take(run, axis=1)
    scatter = np.empty((len(count), 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        products = np.add.reduceat(spread[i] * spread[j], begins, dtype=np.float64)
        scatter[:, i, j] = scatter[:, j, i] = products
    chord = (xyz[:, end - 1].astype(np.float64) - xyz[:, start]).T
    length_m = np.linalg.norm(chord, axis=1)
    direction = chord / np.maximum(length_m, 1e-9)[:, None]
    along = np.einsum("ij,ijk,ik->i", direction, scatter, direction)
    across = np.einsum("ijj->i", scatter) - along
    lateral_m = np.sqrt(np.maximum(across, 0.0) / count)
    centre = np.ascontiguousarray(centre.T)
    return Segments(start, end, ring[start], count, centre, scatter, direction, length_m, lateral_m)
