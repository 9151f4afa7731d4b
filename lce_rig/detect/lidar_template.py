"""Register the board's rectangle in a plane: where the beams end, meet the plane, or pass through it."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.detect.lidar_segments import MAX_STEPS, OrderedScan

N_ANGLES = 12
CAP_M = 0.10


@dataclass(frozen=True, eq=False)
class PlaneView:
    """The beams about a plate as they pierce its plane, M of them, by ring and azimuth.

    Attributes:
        plane: (4,) as (n, d), n towards the LiDAR.
        axes: (3, 2) unit vectors u (level) and v (up) in the plane, right-handed with n.
        origin: (3,) m, the point of the plane from which u and v are counted.
        member: (M,) index in the `OrderedScan`.
        uv: (M, 2) where each beam pierces the plane, m.
        height_m: (M,) distance of each return from the plane, positive before it.
        tolerance_m: returns within it lie on the plane.
        chord_start, chord_end: (C,) first and last member of the longest run on the plane of each ring.
    """

    plane: Array
    axes: Array
    origin: Array
    member: NDArray[np.intp]
    uv: Array
    height_m: Array
    tolerance_m: float
    chord_start: NDArray[np.intp]
    chord_end: NDArray[np.intp]

    @property
    def is_on(self) -> NDArray[np.bool_]:
        """Which beams return from the plane (M,)."""
        return np.abs(self.height_m) <= self.tolerance_m


@dataclass(frozen=True)
class Placement:
    """A rectangle in a plane view.

    Attributes:
        u_m, v_m: its centre.
        angle_rad: of its width axis from u.
        half_m: half width and half height.
        error_m: how far the beams contradict it: mean capped distance of the chords' ends from the border,
            plus the cap for each beam that contradicts it elsewhere, per chord end or beam on the plane.
    """

    u_m: float
    v_m: float
    angle_rad: float
    half_m: tuple[float, float]
    error_m: float = np.inf

    def local(self, uv: Array) -> Array:
        """Take points (..., 2) of the plane view to the rectangle's axes, m."""
        cosine, sine = np.cos(self.angle_rad), np.sin(self.angle_rad)
        offset = uv - [self.u_m, self.v_m]
        return np.asarray(offset @ np.array([[cosine, -sine], [sine, cosine]]))


def view_plane(scan: OrderedScan, plane: Array, centre: Array, radius_m: float, tolerance_m: float) -> PlaneView:
    """Pierce a plane by all beams that do so within a radius of a point, and find its chord on each ring.

    Args:
        scan: all returns.
        plane: (4,) as (n, d), n towards the LiDAR.
        centre: (3,) m, near the plane.
        radius_m: of the disc that is looked at.
        tolerance_m: returns within it lie on the plane.
    """
    normal, d = plane[:3], plane[3]
    origin = centre - (centre @ normal + d) * normal
    distance = float(np.linalg.norm(origin))
    # Coarse cone about the disc first: most returns are elsewhere.
    cosine = np.cos(np.arcsin(min(1.0, radius_m / max(distance, 1e-6))))
    near = np.flatnonzero(scan.points @ origin > cosine * distance * scan.range_m)
    points = scan.points[near]
    along_normal = points @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        pierced = points * (-d / along_normal)[:, None] - origin
    is_near = (along_normal < 0) & (np.einsum("ij,ij->i", pierced, pierced) <= radius_m**2)
    near, pierced, height_m = near[is_near], pierced[is_near], along_normal[is_near] + d
    level = np.cross([0.0, 0.0, 1.0], normal)
    if np.linalg.norm(level) < 1e-3:
        level = np.cross([0.0, 1.0, 0.0], normal)
    level /= np.linalg.norm(level)
    axes = np.stack([level, np.cross(normal, level)], axis=1)
    uv = pierced @ axes
    start, end = _longest_runs(scan, near, uv, np.abs(height_m) <= tolerance_m)
    return PlaneView(plane, axes, origin, near, uv, height_m, tolerance_m, start, end)


def _longest_runs(
    scan: OrderedScan, member: NDArray[np.intp], uv: Array, is_on: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find the first and last beam of each ring's longest run on the plane, over gaps of a few firings."""
    on = np.flatnonzero(is_on)
    if len(on) < 2:
        return on[:0], on[:0]
    ring = scan.ring[member[on]]
    turn = np.mod(np.diff(scan.azimuth[member[on]]), 2 * np.pi)
    is_cut = (np.diff(ring) != 0) | (turn > MAX_STEPS * scan.step_rad)
    start = np.concatenate([[0], np.flatnonzero(is_cut) + 1])
    end = np.append(start[1:], len(on)) - 1
    length = np.linalg.norm(uv[on[end]] - uv[on[start]], axis=1)
    order = np.lexsort((-length, ring[start]))
    is_first = np.diff(ring[start][order], prepend=-1) != 0
    best = order[is_first]
    best = best[end[best] - start[best] >= 2]
    return on[start[best]], on[end[best]]


def register(view: PlaneView, board: Board, starts: list[Placement] | None = None) -> Placement | None:
    """Find the placement of the board's outline that the beams contradict least.

    The chords' ends should lie on the border, beams that return from the plane inside it, and beams that
    return from behind the plane outside. Gauss-Newton on the signed distance from the rectangle with
    Geman-McClure weights, from several angles at once; the ends' inequality partners are thinned out.

    Args:
        view: beams about the plate.
        board: gives the rectangle.
        starts: placements to start from; all angles where None.

    Returns:
        The best placement, None where no ring has a chord.
    """
    if len(view.chord_start) == 0:
        return None
    half = (board.width_m / 2, board.height_m / 2)
    samples, kind = _samples(view)
    if starts is None:
        starts = _starts(samples[kind == 0], half)
    state = np.array([[s.u_m, s.v_m, s.angle_rad] for s in starts])
    if len(state) > 4:
        state = state[np.argsort(_cost(state, samples, kind, half), kind="stable")[:4]]
    for scale_m in (0.08, 0.06, 0.04, 0.03, 0.03, 0.03):
        state = _step(state, samples, kind, half, scale_m)
    cost = _cost(state, samples, kind, half)
    best = int(np.argmin(cost))
    u_m, v_m, angle_rad = (float(x) for x in state[best])
    return Placement(u_m, v_m, angle_rad, half, float(cost[best]))


def _samples(view: PlaneView) -> tuple[Array, NDArray[np.intp]]:
    """Collect chord ends (kind 0), beams that should be inside (1) and outside (2), at most 96 of each."""
    ends = view.uv[np.concatenate([view.chord_start, view.chord_end])]
    inside = view.uv[view.is_on]
    outside = view.uv[view.height_m < -view.tolerance_m]
    inside = inside[:: max(1, -(-len(inside) // 96))]
    outside = outside[:: max(1, -(-len(outside) // 96))]
    kind = np.repeat([0, 1, 2], [len(ends), len(inside), len(outside)])
    return np.concatenate([ends, inside, outside]), kind


def _starts(ends: Array, half: tuple[float, float]) -> list[Placement]:
    """Place the rectangle at equal angles over half a turn, each time in the middle of the ends' extent."""
    starts = []
    for angle in np.arange(N_ANGLES) * np.pi / N_ANGLES:
        axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        local = ends @ axes
        middle = axes @ (local.min(axis=0) + local.max(axis=0)) / 2
        starts.append(Placement(float(middle[0]), float(middle[1]), float(angle), half))
    return starts


def signed_distance(local: Array, half: tuple[float, float]) -> tuple[Array, Array]:
    """Measure the distance from a rectangle's border in m, negative inside, and its gradient.

    Args:
        local: (..., 2) m, axes of the rectangle.
        half: half width and half height, m.

    Returns:
        (...,) and (..., 2).
    """
    over = np.abs(local) - half
    is_outside = (over > 0).any(axis=-1)
    outside = np.maximum(over, 0.0)
    away = np.linalg.norm(outside, axis=-1)
    distance = np.where(is_outside, away, over.max(axis=-1))
    along_x = over[..., 0] > over[..., 1]
    inner = np.stack([along_x, ~along_x], axis=-1).astype(np.float64)
    gradient = np.where(is_outside[..., None], outside / np.maximum(away, 1e-12)[..., None], inner)
    return distance, gradient * np.where(local < 0, -1.0, 1.0)


def _residuals(
    state: Array, samples: Array, kind: NDArray[np.intp], half: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """Compute signed violations (K, M), their gradients (K, M, 2) and local points (K, M, 2)."""
    cosine, sine = np.cos(state[:, 2]), np.sin(state[:, 2])
    offset = samples[None] - state[:, None, :2]
    x = offset[..., 0] * cosine[:, None] + offset[..., 1] * sine[:, None]
    y = offset[..., 1] * cosine[:, None] - offset[..., 0] * sine[:, None]
    local = np.stack([x, y], axis=-1)
    distance, gradient = signed_distance(local, half)
    is_satisfied = ((kind == 1) & (distance < 0)) | ((kind == 2) & (distance > 0))
    return np.where(is_satisfied, 0.0, distance), gradient, local


def _cost(state: Array, samples: Array, kind: NDArray[np.intp], half: tuple[float, float]) -> Array:
    """Compute `Placement.error_m` of each state (K,)."""
    violation = np.minimum(np.abs(_residuals(state, samples, kind, half)[0]), CAP_M)
    n_ends, n_on = int((kind == 0).sum()), int((kind == 1).sum())
    at_ends = violation[:, kind == 0].sum(axis=1) / max(n_ends, 1)
    elsewhere = (violation[:, kind > 0] > 0.3 * CAP_M).sum(axis=1) / max(n_on, 1)
    return np.asarray(at_ends + CAP_M * elsewhere)


def _step(
    state: Array, samples: Array, kind: NDArray[np.intp], half: tuple[float, float], scale_m: float
) -> Array:
    """Take one damped Gauss-Newton step of (u, v, angle) from each state (K, 3)."""
    residual, gradient, local = _residuals(state, samples, kind, half)
    weight = 1.0 / (1.0 + (residual / scale_m) ** 2) ** 2 * (residual != 0)
    cosine, sine = np.cos(state[:, 2])[:, None], np.sin(state[:, 2])[:, None]
    jacobian = np.stack(
        [
            -(gradient[..., 0] * cosine - gradient[..., 1] * sine),
            -(gradient[..., 0] * sine + gradient[..., 1] * cosine),
            gradient[..., 0] * local[..., 1] - gradient[..., 1] * local[..., 0],
        ],
        axis=-1,
    )
    weighted = jacobian * weight[..., None]
    hessian = np.swapaxes(weighted, 1, 2) @ jacobian + np.diag([0.1, 0.1, 0.01])
    slope = np.einsum("kmi,km->ki", weighted, residual)
    return np.asarray(state - np.linalg.solve(hessian, slope[..., None])[..., 0])


def resized(placement: Placement, half_m: tuple[float, float]) -> Placement:
    """Give a placement another size."""
    return replace(placement, half_m=half_m)
