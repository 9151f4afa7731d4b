"""Register the board's rectangle in a plane by beams that end, hit the plane, or pass through it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, pose
from lce_rig.detect.lidar.segments import MAX_STEPS, Floats, Indices, OrderedScan

N_ANGLES = 12
CAP_M = 0.10  # largest distance of a beam from the border that counts: farther outliers weigh no more
MAX_SAMPLES = 64
MIN_ON_RING = 3  # returns that make a chord
DARK_DEPTH_M = 0.10  # maximum depth behind the plane measured for a dark square that a beam grazes
# Role of a beam for the outline: it ends a chord, or should lie inside or outside.
END, INSIDE, OUTSIDE, UNUSED = range(4)


@dataclass(frozen=True, eq=False)
class PlaneView:
    """M beams near a plate, intersected with its plane, sorted by ring and azimuth.

    Attributes:
        plane: (4,) as (n, d), n towards the LiDAR.
        axes: (3, 2) unit vectors u (level) and v (up) in the plane, right-handed with n.
        origin: (3,) m, the point of the plane from which u and v are counted.
        member: (M,) index among all returns.
        uv: (M, 2) intersection of each beam with the plane, m.
        height_m: (M,) distance of each return from the plane, positive before it.
        tolerance_m: returns within it lie on the plane.
        dark_m: longest way across a dark square whose beams return nothing, or weakly from too far; 0 where
            all squares return the same.
        may_be_hidden: whether the border may lie farther out than where a ring ends behind another surface.
    """

    plane: Array
    axes: Array
    origin: Array
    member: Indices
    uv: Array
    height_m: Array
    tolerance_m: float
    dark_m: float = 0.0
    may_be_hidden: bool = False

    @property
    def is_on(self) -> NDArray[np.bool_]:
        """Whether beams return from the plane (M,)."""
        return np.abs(self.height_m) <= self.tolerance_m

    @property
    def is_behind(self) -> NDArray[np.bool_]:
        """Whether beams pass through the plane (M,), but not through a dark square."""
        return self.height_m < -(max(self.tolerance_m, DARK_DEPTH_M) if self.dark_m else self.tolerance_m)

    def pose_of(self, placement: "Placement") -> Array:
        """Build T_lidar_board (4, 4) of a placed board; if ambiguous, y points upwards."""
        direction = placement.axes[0]
        x = self.axes @ (-direction if direction[0] < 0 else direction)
        normal = self.plane[:3]
        R = np.stack([x, np.cross(normal, x), normal], axis=1)
        return pose(R, self.origin + self.axes @ [placement.u_m, placement.v_m])


@dataclass(frozen=True)
class Placement:
    """A rectangle in a plane view.

    Attributes:
        u_m, v_m: its centre.
        angle_rad: angle of its width axis from u.
        half_m: half width and half height.
        error_m: contradiction by the beams: mean capped distance of the chords' ends from the border,
            plus the cap for each beam that contradicts it elsewhere, per chord end or beam on the plane.
    """

    u_m: float
    v_m: float
    angle_rad: float
    half_m: tuple[float, float]
    error_m: float = np.inf

    @property
    def axes(self) -> Array:
        """Unit vectors of the width and the height in the plane view, the rows of (2, 2)."""
        cosine, sine = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return np.array([[cosine, sine], [-sine, cosine]])

    def local(self, uv: Array) -> Array:
        """Convert points (..., 2) of the plane view to the rectangle's axes, m."""
        return np.asarray((uv - [self.u_m, self.v_m]) @ np.ascontiguousarray(self.axes.T))

    def distance_m(self, uv: Array) -> Array:
        """Compute the distance of points (..., 2) of the plane view from the border, negative inside."""
        return self.beyond_m(self.local(uv))

    def beyond_m(self, local: Array) -> Array:
        """Compute the distance of points (..., 2) in the rectangle's axes from the border."""
        over = np.abs(local) - self.half_m
        return _distance_over(over[..., 0], over[..., 1])[0]


def beams_about(scan: OrderedScan, centre: Array, radius_m: float) -> Indices:
    """List the beams (M,) in the cone around a sphere; the others need no closer test."""
    distance = float(np.linalg.norm(centre))
    cosine = np.sqrt(max(0.0, 1.0 - (radius_m / max(distance, 1e-6)) ** 2))
    along = scan.points @ centre.astype(np.float32)
    return np.flatnonzero(along > np.float32(cosine * distance) * scan.range_m)


def view_plane(
    points: Array | Floats,
    among: Indices,
    plane: Array,
    centre: Array,
    radius_m: float,
    tolerance_m: float,
    dark_m: float = 0.0,
) -> PlaneView:
    """Intersect a plane with the beams that hit it within a radius of a point.

    Args:
        points: (N, 3) m, all returns.
        among: (K,) indices of those examined.
        plane: (4,) as (n, d), n towards the LiDAR.
        centre: (3,) m, near the plane.
        radius_m: radius of the disc examined.
        tolerance_m, dark_m: see `PlaneView`.
    """
    normal, d = plane[:3], plane[3]
    origin = centre - (centre @ normal + d) * normal
    tried = points.take(among, axis=0).astype(np.float64)
    along_normal = tried @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        pierced = tried * (-d / along_normal)[:, None] - origin
    is_near = (along_normal < 0) & (np.einsum("ij,ij->i", pierced, pierced) <= radius_m**2)
    axes = plane_axes(normal)
    uv = pierced[is_near] @ axes
    return PlaneView(plane, axes, origin, among[is_near], uv, along_normal[is_near] + d, tolerance_m, dark_m)


def plane_axes(normal: Array) -> Array:
    """Build the unit vectors (..., 3, 2) of a plane: horizontal, then upwards; right-handed with n."""
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    length = np.hypot(x, y)
    is_level = length < 1e-3
    safe = np.where(is_level, 1.0, length)
    a, b = np.where(is_level, 0.0, -y / safe), np.where(is_level, -1.0, x / safe)
    axes = np.zeros((*normal.shape, 2))
    axes[..., 0, 0], axes[..., 1, 0] = a, b
    # n x level, written out.
    axes[..., 0, 1], axes[..., 1, 1], axes[..., 2, 1] = -z * b, z * a, x * b - y * a
    return axes


def find_chords(scan: OrderedScan, view: PlaneView, placement: Placement) -> tuple[Indices, Indices]:
    """Find on each ring the run of returns from the plane that overlaps most with the placed rectangle.

    Other runs of the ring belong to other objects that happen to lie in the plane.

    Args:
        scan: all returns.
        view: beams about the plate.
        placement: estimated place of the board.

    Returns:
        First and last beam of each run (C,), as indices into the view.
    """
    on = np.flatnonzero(view.is_on)
    if len(on) < 2:
        return on[:0], on[:0]
    ring = scan.ring[view.member[on]]
    turn = np.mod(np.diff(scan.azimuth[view.member[on]]), 2 * np.pi)
    is_new_ring = np.diff(ring) != 0
    is_cut = is_new_ring | (turn > MAX_STEPS * scan.step_rad)
    if view.dark_m:
        is_cut &= is_new_ring | ~_crosses_dark_square(view, placement, on)
    start = np.concatenate([[0], np.flatnonzero(is_cut) + 1])
    end = np.append(start[1:], len(on)) - 1
    is_inside = placement.distance_m(view.uv[on]) < 0
    n_inside = np.add.reduceat(is_inside.astype(np.intp), start)
    order = np.lexsort((-n_inside, ring[start]))
    best = order[np.diff(ring[start][order], prepend=-1) != 0]
    best = best[n_inside[best] >= MIN_ON_RING]
    return on[start[best]], on[end[best]]


def lost_share(scan: OrderedScan, view: PlaneView, placement: Placement) -> float:
    """Compute the fraction of beams between the chords' ends that do not return from the plane."""
    first, last = find_chords(scan, view, placement)
    azimuth = scan.azimuth[view.member]
    turn = np.abs(np.mod(azimuth[last] - azimuth[first] + np.pi, 2 * np.pi) - np.pi)
    n_on = np.append(0, np.cumsum(view.is_on))
    return 1.0 - float((n_on[last + 1] - n_on[first]).sum() / (turn / scan.step_rad + 1.0).sum())


def register(scan: OrderedScan, view: PlaneView, start: Placement) -> Placement | None:
    """Find the placement of a rectangle near a first guess that agrees best with the beams.

    The chords' ends should lie on the border, beams that return from the plane inside it, and beams that
    return from behind the plane outside.

    Args:
        scan: all returns.
        view: beams about the plate.
        start: first guess, which sets the size.

    Returns:
        The placement, None if no ring shows the plate.
    """
    samples, kind = _samples(scan, view, start)
    if not (kind == END).any():
        return None
    guess = np.array([[[start.u_m, start.v_m, start.angle_rad]]])
    state, error_m = _search(guess, samples[None], kind[None], start.half_m, (0.04, 0.03, 0.03, 0.03))
    u_m, v_m, angle_rad = (float(x) for x in state[0])
    return Placement(u_m, v_m, angle_rad, start.half_m, float(error_m[0]))


def _samples(scan: OrderedScan, view: PlaneView, placement: Placement) -> tuple[Array, Indices]:
    """Collect the beams that locate the outline: points (M, 2) of the view and their kind (M,)."""
    first, last = find_chords(scan, view, placement)
    ends = view.uv[np.concatenate([first, last])]
    bound = np.zeros(len(view.uv) + 1, dtype=np.int8)
    bound[first] += 1
    bound[last + 1] -= 1
    is_inside = view.is_on & (np.cumsum(bound[:-1]) > 0)
    inside, outside = view.uv[is_inside], view.uv[view.is_behind]
    # Beams far from any border repeat their neighbours, so a sample is enough.
    inside = inside[:: max(1, -(-len(inside) // MAX_SAMPLES))]
    outside = outside[:: max(1, -(-len(outside) // MAX_SAMPLES))]
    kind = np.repeat([END, INSIDE, OUTSIDE], [len(ends), len(inside), len(outside)])
    # The border lies beyond an end that is hidden or may be followed by a dark square.
    if view.dark_m:
        kind[: len(ends)][_is_before_dark(scan, view, first, last)] = INSIDE
    if view.may_be_hidden:
        kind[: len(ends)][_is_before_cover(scan, view, first, last)] = INSIDE
    return np.concatenate([ends, inside, outside]), kind


def _crosses_dark_square(view: PlaneView, placement: Placement, on: Indices) -> NDArray[np.bool_]:
    """Find the pairs of neighbouring beams on the plane (K,) with a possible dark square between (K - 1,).

    The two are close together and inside the outline, and no beam between them returns from elsewhere.
    """
    is_inside = placement.distance_m(view.uv[on]) < 0
    is_short = np.linalg.norm(np.diff(view.uv[on], axis=0), axis=1) <= view.dark_m
    n_elsewhere = np.cumsum(view.is_behind | (view.height_m > view.tolerance_m))
    is_clear = np.diff(n_elsewhere[on]) == 0
    return np.asarray(is_short & is_clear & is_inside[1:] & is_inside[:-1])


def _is_before_dark(scan: OrderedScan, view: PlaneView, first: Indices, last: Indices) -> NDArray[np.bool_]:
    """Find ends (2 C,) of chords after which the ring continues, but not with a beam passing the plate."""
    end, beyond, is_next = _beyond(scan, view, first, last)
    passes = view.is_behind[beyond] & is_next
    return np.asarray((scan.ring[view.member[beyond]] == scan.ring[view.member[end]]) & ~passes)


def _is_before_cover(scan: OrderedScan, view: PlaneView, first: Indices, last: Indices) -> NDArray[np.bool_]:
    """Find ends (2 C,) of chords followed by a return in front of the plane."""
    end, beyond, is_next = _beyond(scan, view, first, last)
    is_same = scan.ring[view.member[beyond]] == scan.ring[view.member[end]]
    return np.asarray(is_same & is_next & (view.height_m[beyond] > view.tolerance_m))


def _beyond(
    scan: OrderedScan, view: PlaneView, first: Indices, last: Indices
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """List the ends (2 C,) of chords, the beams after them, and whether these follow directly."""
    end = np.concatenate([first, last])
    beyond = np.clip(end + np.repeat([-1, 1], len(first)), 0, len(view.uv) - 1)
    turn = scan.azimuth[view.member[beyond]] - scan.azimuth[view.member[end]]
    turn = np.abs(np.mod(turn + np.pi, 2 * np.pi) - np.pi)
    return end, beyond, turn <= MAX_STEPS * scan.step_rad


def register_ends(ends: Array, board: Board) -> list[Placement]:
    """For each of G plates, find the board placement whose border is nearest to the plate's ends.

    Args:
        ends: (G, M, 2) start and end of the rings in each plate's plane, m; rows are padded with NaN.
        board: board, for the rectangle.
    """
    half = (board.width_m / 2, board.height_m / 2)
    is_unused = np.isnan(ends[..., 0])
    kind = np.where(is_unused, UNUSED, END)
    samples = np.where(is_unused[..., None], ends[:, :1], ends)
    angle = np.arange(N_ANGLES) * np.pi / N_ANGLES
    cosine, sine = np.cos(angle), np.sin(angle)
    # At each angle the rectangle starts in the middle of the ends' extent.
    u, v = samples[:, None, :, 0], samples[:, None, :, 1]
    x = u * cosine[:, None] + v * sine[:, None]
    y = v * cosine[:, None] - u * sine[:, None]
    x, y = (x.min(axis=2) + x.max(axis=2)) / 2, (y.min(axis=2) + y.max(axis=2)) / 2
    starts = np.stack([x * cosine - y * sine, x * sine + y * cosine, np.broadcast_to(angle, x.shape)], axis=2)
    cost = _cost(starts, samples, kind, half)
    best = np.argsort(cost, axis=1, kind="stable")[:, :2]
    starts = np.take_along_axis(starts, best[..., None], axis=1)
    state, error_m = _search(starts, samples, kind, half, (0.08, 0.06, 0.04, 0.03))
    return [
        Placement(float(x[0]), float(x[1]), float(x[2]), half, float(e))
        for x, e in zip(state, error_m, strict=True)
    ]


def _distance_over(over_x: Array, over_y: Array) -> tuple[Array, Array]:
    """Convert distances of points beyond the sides, m, to signed distances and distances outside."""
    away = np.hypot(np.maximum(over_x, 0.0), np.maximum(over_y, 0.0))
    return away + np.minimum(np.maximum(over_x, over_y), 0.0), away


def _search(
    state: Array, samples: Array, kind: Indices, half: tuple[float, float], scales_m: tuple[float, ...]
) -> tuple[Array, Array]:
    """Improve states (G, A, 3) and return the best of each group (G, 3) with its error (G,).

    Gauss-Newton on the signed distance from the rectangle, with Geman-McClure weights of falling scale.
    """
    for scale_m in scales_m:
        state = _step(state, samples, kind, half, scale_m)
    cost = _cost(state, samples, kind, half)
    best = np.argmin(cost, axis=1)
    rows = np.arange(len(best))
    return state[rows, best], cost[rows, best]


def _residuals(
    state: Array, samples: Array, kind: Indices, half: tuple[float, float]
) -> tuple[Array, Array, Array, Array]:
    """Compute signed violations, local x and y, and distances outside, each (G, A, M)."""
    cosine, sine = np.cos(state[..., 2])[..., None], np.sin(state[..., 2])[..., None]
    u = samples[:, None, :, 0] - state[..., 0, None]
    v = samples[:, None, :, 1] - state[..., 1, None]
    x, y = u * cosine + v * sine, v * cosine - u * sine
    distance, away = _distance_over(np.abs(x) - half[0], np.abs(y) - half[1])
    kind = kind[:, None]
    counts = (kind == END) | (kind == np.where(distance > 0, INSIDE, OUTSIDE))
    return distance * counts, x, y, away


def _cost(state: Array, samples: Array, kind: Indices, half: tuple[float, float]) -> Array:
    """Compute `Placement.error_m` of each state (G, A)."""
    violation = np.minimum(np.abs(_residuals(state, samples, kind, half)[0]), CAP_M)
    is_end, is_inside = (kind == END)[:, None], (kind == INSIDE)[:, None]
    at_ends = (violation * is_end).sum(axis=-1) / np.maximum(is_end.sum(axis=-1), 1)
    elsewhere = ((violation > 0.3 * CAP_M) & ~is_end).sum(axis=-1) / np.maximum(is_inside.sum(axis=-1), 1)
    return np.asarray(at_ends + CAP_M * elsewhere)


def _step(state: Array, samples: Array, kind: Indices, half: tuple[float, float], scale_m: float) -> Array:
    """Compute one damped Gauss-Newton step of (u, v, angle) from each state (G, A, 3)."""
    residual, x, y, away = _residuals(state, samples, kind, half)
    weight = (residual != 0) / (1.0 + (residual / scale_m) ** 2) ** 2
    over_x, over_y = np.abs(x) - half[0], np.abs(y) - half[1]
    # Gradient of the signed distance: away from the nearest point of the border.
    is_outside, scale = away > 0, np.maximum(away, 1e-12)
    along_x = np.copysign(np.where(is_outside, np.maximum(over_x, 0.0) / scale, over_x > over_y), x)
    along_y = np.copysign(np.where(is_outside, np.maximum(over_y, 0.0) / scale, over_x <= over_y), y)
    # The shift is along the rectangle's axes, which saves rotating every gradient.
    jacobian = np.empty((*residual.shape[:2], 3, residual.shape[2]))
    np.negative(along_x, out=jacobian[:, :, 0])
    np.negative(along_y, out=jacobian[:, :, 1])
    np.subtract(along_x * y, along_y * x, out=jacobian[:, :, 2])
    weighted = jacobian * weight[:, :, None]
    hessian = weighted @ np.swapaxes(jacobian, -1, -2) + np.diag([0.1, 0.1, 0.01])
    step = np.linalg.solve(hessian, weighted @ residual[..., None])[..., 0]
    cosine, sine = np.cos(state[..., 2]), np.sin(state[..., 2])
    turned = (step[..., 0] * cosine - step[..., 1] * sine, step[..., 0] * sine + step[..., 1] * cosine)
    return np.asarray(state - np.stack([*turned, step[..., 2]], axis=-1))
