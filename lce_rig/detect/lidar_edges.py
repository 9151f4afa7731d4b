"""Where the rings end on a board, whether that is the board's border, and the size they show."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.detect.lidar_segments import MAX_STEPS, Indices, OrderedScan
from lce_rig.detect.lidar_template import Placement, PlaneView

SIZE_PRIOR_M = 0.10
SLACK_M = 0.05  # by how much a board's border may lie off the nominal one to be measured


@dataclass(frozen=True, eq=False)
class RingEnds:
    """First and last return of each ring on the board, E of them.

    Attributes:
        beam: (E,) index in the plane view.
        side: (E,) -1 or +1.
        gap: (E, 2) from one beam to the next along the ring at that end, outwards, in the plane view, m.
        beyond: (E,) index in the scan of the next return outwards.
        behind_m: (E,) how far behind the plane it lies, inf where there is none.
        is_border: (E,) whether the surface itself ends there: no occluder before it, no plane behind it.
    """

    beam: Indices
    side: NDArray[np.int8]
    gap: Array
    beyond: Indices
    behind_m: Array
    is_border: NDArray[np.bool_]


def median(values: Array) -> float:
    """Take the median: on a few hundred values several times faster than `numpy.median`."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.sort(values)
    return float(ordered[low] + ordered[high]) / 2


def find_ring_ends(scan: OrderedScan, view: PlaneView, is_board: NDArray[np.bool_]) -> RingEnds:
    """Take the first and last board return of each ring and look at the beams beyond them.

    Args:
        scan: all returns.
        view: beams about the board.
        is_board: (M,) which of them return from it.
    """
    board = np.flatnonzero(is_board)
    ring = scan.ring[view.member[board]]
    is_first = np.diff(ring, prepend=-1) != 0
    is_last = np.append(is_first[1:], True)
    n_on_ring = np.flatnonzero(is_last) - np.flatnonzero(is_first) + 1
    is_long = n_on_ring >= 3
    first, last = np.flatnonzero(is_first)[is_long], np.flatnonzero(is_last)[is_long]
    beam = np.concatenate([board[first], board[last]])
    inner = np.concatenate([board[first + 2], board[last - 2]])
    n_steps = np.mod(np.abs(scan.azimuth[view.member[beam]] - scan.azimuth[view.member[inner]]), 2 * np.pi)
    n_steps = np.maximum(np.minimum(n_steps, 2 * np.pi - n_steps) / max(scan.step_rad, 1e-6), 1.0)
    side = np.repeat(np.array([-1, 1], dtype=np.int8), len(first))
    gap = (view.uv[beam] - view.uv[inner]) / n_steps[:, None]
    beyond, beyond_exists = _outwards(scan, view.member[beam], side, 1)
    further, further_exists = _outwards(scan, view.member[beam], side, 2)
    height_1 = scan.points[beyond] @ view.plane[:3] + view.plane[3]
    height_2 = scan.points[further] @ view.plane[:3] + view.plane[3]
    is_occluded = beyond_exists & (height_1 > view.tolerance_m)
    goes_on = beyond_exists & (np.abs(height_1) <= view.tolerance_m)
    goes_on &= further_exists & (np.abs(height_2) <= view.tolerance_m)
    behind_m = np.where(beyond_exists, -height_1, np.inf)
    return RingEnds(beam, side, gap, beyond, behind_m, ~(is_occluded | goes_on))


def _outwards(
    scan: OrderedScan, member: Indices, side: NDArray[np.int8], n: int
) -> tuple[Indices, NDArray[np.bool_]]:
    """Find the n-th return beyond each ring end, all the way round, and whether it is a few firings off."""
    ring = scan.ring[member]
    start, end = np.searchsorted(scan.ring, ring), np.searchsorted(scan.ring, ring, side="right")
    other = start + np.mod(member - start + n * side.astype(np.intp), end - start)
    turn = np.abs(np.mod(scan.azimuth[other] - scan.azimuth[member] + np.pi, 2 * np.pi) - np.pi)
    return other, (turn < (n + MAX_STEPS) * scan.step_rad) & (other != member)


def measure_size(
    ends: RingEnds, uv: Array, placement: Placement, beyond_m: float
) -> tuple[Placement, Array, Array, Array]:
    """Fit a rectangle of free size to the ring ends: least squares of their distance from the nearest edge.

    An end lies half a step of the ring inside the edge on average, and half a light spot outside
    (`beyond_m`); both along the edge's normal. A weak prior holds a side that no end shows.

    Args:
        ends: ring ends.
        uv: (M, 2) of the plane view, m.
        placement: of the rectangle with the nominal size.
        beyond_m: how far the light spot reaches over an edge.

    Returns:
        The fitted rectangle, the standard deviation of its width and height (2,), the residuals (E,) in m,
        positive outwards, and the step along the edge's normal (E,) in m.
    """
    local = placement.local(uv[ends.beam])
    over = np.abs(local) - placement.half_m
    axis = over.argmax(axis=1)
    rows = np.arange(len(axis))
    sign = np.where(local[rows, axis] < 0, -1.0, 1.0)
    gap_local = placement.local(ends.gap + [placement.u_m, placement.v_m])
    step_m = np.abs(gap_local[rows, axis])
    half = np.asarray(placement.half_m)
    # Unknowns: shift along x and y, angle, half width, half height.
    jacobian = np.zeros((len(axis), 5))
    jacobian[rows, axis] = sign
    jacobian[:, 2] = sign * np.where(axis == 0, -local[:, 1], local[:, 0])
    jacobian[rows, 3 + axis] = 1.0
    target = np.abs(local[rows, axis]) - half[axis] - (beyond_m - step_m / 2)
    sigma_m = np.sqrt(step_m**2 / 12 + 0.003**2)
    usable = ends.is_border
    prior = np.diag([0.0, 0.0, 0.0, 4.0, 4.0]) / SIZE_PRIOR_M**2 + 1e-3 * np.eye(5)
    x = np.zeros(5)
    for _ in range(6):
        residual = target - jacobian @ x
        scale = max(median(np.abs(residual[usable])) * 1.4826, 0.003) if usable.any() else 0.01
        weight = usable * np.maximum(1 - (residual / (4.7 * np.maximum(scale, sigma_m))) ** 2, 0.0) ** 2
        information = (jacobian * (weight / sigma_m**2)[:, None]).T @ jacobian + prior
        x = np.linalg.solve(information, jacobian.T @ (weight / sigma_m**2 * target))
    residual = target - jacobian @ x
    cov = np.linalg.inv(information)
    freedom = max(1.0, float((weight > 0).sum()) - 5)
    chi2 = float((weight * (residual / sigma_m) ** 2).sum()) / freedom
    # Ends of rings at equal gaps share their phase: their steps do not average out.
    common_m = median(step_m) / np.sqrt(12) if len(step_m) else 0.0
    size_sigma_m = np.hypot(2 * np.sqrt(np.diag(cov)[3:] * max(1.0, chi2)), common_m)
    if np.abs(x[:2]).max() > SLACK_M or np.abs(x[3:]).max() > SLACK_M:
        # The ends contradict each other: they say nothing about the size.
        return placement, np.full(2, SIZE_PRIOR_M), target, step_m
    cosine, sine = np.cos(placement.angle_rad), np.sin(placement.angle_rad)
    fitted = Placement(
        placement.u_m + float(cosine * x[0] - sine * x[1]),
        placement.v_m + float(sine * x[0] + cosine * x[1]),
        placement.angle_rad + float(x[2]),
        (float(half[0] + x[3]), float(half[1] + x[4])),
        placement.error_m,
    )
    return fitted, size_sigma_m, residual, step_m
