"""Measure a registered board for the calibration: plane, points, ring ends and size."""

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.data_sheets import VLP_16
from lce_rig.core.geometry import SIGMA_PER_MAD, Array
from lce_rig.core.results import LidarBoard, LidarQuality
from lce_rig.detect.lidar.segments import MAX_STEPS, Indices, OrderedScan
from lce_rig.detect.lidar.template import (
    Placement,
    PlaneView,
    beams_about,
    plane_axes,
    register,
    view_plane,
)

# Ring ends on a board, whether they are the board's border, and the size they imply.

_QUARTILE = 1.1503  # third quartile of |x| of a normal distribution, in its standard deviations
_MIN_SMEARED = 8  # minimum number of ring ends to measure a smear: a fit takes five freedoms
_CROSSING = 0.3  # minimum share of its gaps by which a ring crosses a side, for ends that show a smear
SIZE_PRIOR_M = 0.10  # prior standard deviation of a plate's sides: wide, so that ring ends determine them
SLACK_M = 0.05  # maximum distance of a measured border from the nominal one


class RingEnds(NamedTuple):
    """First and last return of each ring on the board, E of them.

    Attributes:
        beam: (E,) index in the plane view.
        side: (E,) -1 or +1.
        gap: (E, 2) from one beam to the next along the ring at that end, outwards, in the plane view, m.
        beyond: (E,) index in the scan of the next return outwards.
        behind_m: (E,) its distance behind the plane, inf if there is none.
        is_border: (E,) whether the surface itself ends there: no occluder before it, no plane behind it.
    """

    beam: Indices
    side: NDArray[np.int8]
    gap: Array
    beyond: Indices
    behind_m: Array
    is_border: NDArray[np.bool_]


def median(values: Array) -> float:
    """Compute the median several times faster than `numpy.median` for a few hundred values."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.sort(values)
    return float(ordered[low] + ordered[high]) / 2


def find_ring_ends(scan: OrderedScan, view: PlaneView, is_board: NDArray[np.bool_]) -> RingEnds:
    """Find the first and last board return of each ring and examine the beams beyond them.

    Args:
        scan: all returns.
        view: beams about the board.
        is_board: (M,) beams that return from it.
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
    """Find the n-th return beyond each ring end, cyclically, and whether it is a few firings away."""
    ring = scan.ring[member]
    start, end = np.searchsorted(scan.ring, ring), np.searchsorted(scan.ring, ring, side="right")
    other = start + np.mod(member - start + n * side.astype(np.intp), end - start)
    turn = np.abs(np.mod(scan.azimuth[other] - scan.azimuth[member] + np.pi, 2 * np.pi) - np.pi)
    return other, (turn < (n + MAX_STEPS) * scan.step_rad) & (other != member)


def measure_size(
    ends: RingEnds, uv: Array, placement: Placement, beyond_m: float
) -> tuple[Placement, Array, Array, Array]:
    """Fit a rectangle of free size to the ring ends by least squares of their distance from the nearest edge.

    An end lies half a step of the ring inside the edge on average, and half a light spot outside
    (`beyond_m`); both along the edge's normal. A weak prior determines sides without ring ends.

    Args:
        ends: ring ends.
        uv: (M, 2) of the plane view, m.
        placement: placement of the rectangle with the nominal size.
        beyond_m: reach of the light spot beyond an edge.

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
        scale = max(median(np.abs(residual[usable])) * SIGMA_PER_MAD, 0.003) if usable.any() else 0.01
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
        # The ends contradict each other and do not determine the size.
        return placement, np.full(2, SIZE_PRIOR_M), target, step_m
    cosine, sine = placement.axes[0]
    fitted = Placement(
        placement.u_m + float(cosine * x[0] - sine * x[1]),
        placement.v_m + float(sine * x[0] + cosine * x[1]),
        placement.angle_rad + float(x[2]),
        (float(half[0] + x[3]), float(half[1] + x[4])),
        placement.error_m,
    )
    return fitted, size_sigma_m, residual, step_m


def measure_smear(ends: RingEnds, side: Indices, residual_m: Array, step_m: Array) -> Array:
    """Measure the scatter of ring ends about the border beyond their steps: (E,) m, 0 for a sharp border.

    It is the third quartile of the distances, of all ends and of each side's. Few ends without their
    last returns therefore do not count, nor do those of rings that hardly cross the nearest side.

    Args:
        ends: ring ends.
        side: (E,) nearest side of the fitted rectangle.
        residual_m, step_m: residual and step of the ring ends, by `measure_size`.
    """
    smear_m = np.zeros(len(side))
    is_telling = ends.is_border & (step_m > _CROSSING * np.linalg.norm(ends.gap, axis=1))
    for among in (np.ones(len(side), dtype=np.bool_), *(side == k for k in range(4))):
        n = int(np.count_nonzero(is_telling & among))
        if n < _MIN_SMEARED:
            continue
        spread_m = float(np.percentile(np.abs(residual_m[is_telling & among]), 75)) / _QUARTILE
        # Without noise, ends are uniformly distributed over a step. The fit uses five degrees of freedom.
        sharp_m = 0.375 * median(step_m[is_telling & among]) / _QUARTILE
        excess_m = float(np.sqrt(max(spread_m**2 - sharp_m**2, 0.0) * n / (n - 5.0)))
        if excess_m > EDGE_TOLERANCE_M:
            smear_m[among] = np.maximum(smear_m[among], excess_m)
    return smear_m


MIN_POINTS = 12
EDGE_TOLERANCE_M = 0.012  # scatter of ring ends beyond their steps at a sharp border; a larger one is smear
BORDER_M = 0.06  # width inside the outline of the returns that measure the board's brightness there
SETTLED_M = 0.01  # movement of the outline too small to change the returns inside it, and so the plane


Distance = TypeVar("Distance", float, Array)


@dataclass(frozen=True)
class Beam:
    """Footprint of a LiDAR beam, a VLP-16's by default; half of it extends over the board's edge.

    Attributes:
        aperture_m: width of the beam at the sensor's exit.
        divergence_rad: full divergence angle.
        upright_rad: vertical divergence angle; None if equal to the horizontal one.
    """

    aperture_m: float = VLP_16.aperture_m
    divergence_rad: float = VLP_16.divergence_rad[0]
    upright_rad: float | None = None

    def half_width_m(self, distance_m: Distance) -> Distance:
        """Compute half the beam's width at one or several distances."""
        return (self.aperture_m + self.divergence_rad * distance_m) / 2

    def widths_m(self, distance_m: float | Array) -> Array:
        """Compute the beam's width and height (2,) at a distance, or (K, 2) at several (K, 1)."""
        upright_rad = self.divergence_rad if self.upright_rad is None else self.upright_rad
        return self.aperture_m + np.array([self.divergence_rad, upright_rad]) * distance_m


def fit_plane_to_ranges(points: Array, start: Array, distance_m: float) -> tuple[Array, float]:
    """Fit a plane to ranges: minimise sum rho_T(r_i - 1 / (m . u_i)) over m, n = -m / |m|, d = 1 / |m|.

    The beams' directions u_i are exact and the noise lies along them. Orthogonal least squares would rotate
    the plane towards the sensor, by sigma^2 / spread^2 rad at 45 deg. rho_T is Tukey's biweight at 4.7 scales
    of the returns' scatter about the first plane.

    Args:
        points: (N, 3) m, frame lidar.
        start: (4,) plane as (n, d).
        distance_m: distance of the plate's middle.

    Returns:
        (4,) plane as (n, d), n towards the LiDAR, and a robust standard deviation of the returns from it, m.
    """
    height_m = points @ start[:3] + start[3]
    scale_m = SIGMA_PER_MAD * median(np.abs(height_m - median(height_m))) + 0.001
    scale_m = scale_m * distance_m / start[3]
    range_m = np.linalg.norm(points, axis=1)
    rays = points / range_m[:, None]
    m = -start[:3] / start[3]
    for _ in range(3):  # Gauss-Newton
        predicted = 1.0 / (rays @ m)
        residual = range_m - predicted
        weight = np.maximum(1.0 - (residual / (4.7 * scale_m)) ** 2, 0.0) ** 2
        jacobian = -rays * (predicted**2)[:, None]
        hessian = (jacobian * weight[:, None]).T @ jacobian
        m = m + np.linalg.solve(hessian + 1e-9 * np.eye(3), jacobian.T @ (weight * residual))
    plane = np.append(-m, 1.0) / np.linalg.norm(m)
    return plane, SIGMA_PER_MAD * median(np.abs(points @ plane[:3] + plane[3]))


def refine(
    scan: OrderedScan,
    plane: Array,
    centre: Array,
    placement: Placement,
    limit_m: float,
    max_beyond: float = np.inf,
    dark_m: float = 0.0,
    *,
    may_be_hidden: bool = False,
) -> tuple[PlaneView, Placement] | None:
    """Fit the plane to single returns inside the outline, and the outline to the beams around it.

    Args:
        scan: all returns.
        plane: (4,) first guess.
        centre: (3,) m, origin of the placement in the plane.
        placement: first guess of the outline.
        limit_m: largest error of an outline; a worse one is not improved further.
        max_beyond: most returns in the plane beyond the outline, per return inside, for further work.
        dark_m, may_be_hidden: see `PlaneView`.

    Returns:
        The beams about the plate and the outline among them, with its error; None if too few returns lie
        on the plane inside the outline, or too many beyond it.
    """
    # Returns around it on the same plane show that it is not a plate.
    radius_m = float(np.hypot(*placement.half_m)) + 0.20
    tolerance_m = 4.0 * scan.sigma_m + 0.01
    near = beams_about(scan, centre + plane_axes(plane[:3]) @ [placement.u_m, placement.v_m], 1.3 * radius_m)
    for k in range(3):
        centre = centre + plane_axes(plane[:3]) @ [placement.u_m, placement.v_m]
        placement = replace(placement, u_m=0.0, v_m=0.0)
        view = view_plane(scan.points, near, plane, centre, radius_m, tolerance_m, dark_m)
        away = placement.distance_m(view.uv[view.is_on])
        on = view.member[view.is_on][away < 0.0]
        if len(on) < 10 or (k == 0 and np.count_nonzero(away > SLACK_M) > max_beyond * len(on)):
            return None
        points = scan.points[on].astype(np.float64)
        plane, spread_m = fit_plane_to_ranges(points, plane, float(np.linalg.norm(centre)))
        tolerance_m = 3.5 * spread_m + 0.004
        view = view_plane(scan.points, near, plane, view.origin, radius_m, tolerance_m, dark_m)
        view = replace(view, may_be_hidden=may_be_hidden)
        registered = register(scan, view, placement)
        if registered is None:
            return None
        placement, centre = registered, view.origin
        if placement.error_m > 1.5 * limit_m or np.hypot(placement.u_m, placement.v_m) < SETTLED_M:
            break
    return view, placement


def build_board(
    scan: OrderedScan, source: Scan, board: Board, view: PlaneView, placement: Placement, beam: Beam
) -> LidarBoard | None:
    """Collect the returns inside the outline, keep ring ends on the board's border, and measure the board.

    Args:
        scan: all returns, ordered.
        source: the scan they come from.
        board: nominal size.
        view: beams about the board.
        placement: placement of the nominal rectangle.
        beam: light spot of the LiDAR.

    Returns:
        The board; None if hardly any return lies inside the outline.
    """
    distance_m = float(np.linalg.norm(view.origin))
    beyond_m = beam.half_width_m(distance_m)
    away = placement.distance_m(view.uv)
    # Measure a slightly larger plate at its full size, not truncated to the nominal one.
    ends = find_ring_ends(scan, view, view.is_on & (away <= beyond_m + SLACK_M))
    fitted, size_sigma_m, residual, step_m = measure_size(ends, view.uv, placement, beyond_m)
    away = fitted.distance_m(view.uv)
    is_board = view.is_on & (away <= beyond_m + EDGE_TOLERANCE_M)
    if is_board.sum() < MIN_POINTS:
        return None
    local = fitted.local(view.uv[ends.beam])
    axis = (np.abs(local) - fitted.half_m).argmax(axis=1)
    side_of_fit = 2 * axis + (local[np.arange(len(axis)), axis] < 0)
    smear_m = measure_smear(ends, side_of_fit, residual, step_m)
    limit_m = step_m / 2 + EDGE_TOLERANCE_M + 0.5 * beyond_m + 3 * smear_m
    is_good = ends.is_border & (np.abs(residual) <= limit_m)
    order = np.lexsort((ends.side, scan.ring[view.member[ends.beam]]))
    order = order[is_good[order]]
    kept, edge = view.member[is_board], view.member[ends.beam[order]]
    border = kept[away[is_board] > -BORDER_M]
    points = scan.points[kept].astype(np.float64)
    height = points @ view.plane[:3] + view.plane[3]
    rms_m = float(np.sqrt(np.mean(height**2)))
    # The effective beam width is unknown.
    size_m, sigma_m = 2 * np.asarray(fitted.half_m), np.hypot(size_sigma_m, beyond_m)
    quality = LidarQuality(
        width_m=float(size_m[0]),
        height_m=float(size_m[1]),
        width_sigma_m=float(sigma_m[0]),
        height_sigma_m=float(sigma_m[1]),
        n_rings=1 + int(np.count_nonzero(np.diff(scan.ring[kept]))),
        n_points=len(kept),
        n_ring_ends=len(edge),
        n_ring_ends_dropped=len(ends.beam) - len(edge),
        plane_rms_m=rms_m,
        edge_rms_m=float(np.sqrt(np.mean(residual[is_good] ** 2))) if is_good.any() else float("nan"),
        template_m=placement.error_m,
        beyond_share=float((view.is_on & (away > SLACK_M)).sum()) / max(1, len(kept)),
        distance_m=distance_m,
    )
    # Fraction of the power from the background if a beam hits it and the board equally. Intensities
    # are those of surfaces; the power received falls with the square of the range.
    intensity = source.intensity[scan.index].astype(np.float64)
    of_board = float(np.median(intensity[border])) if len(border) else 0.0
    end = view.member[ends.beam]
    brightness = intensity[ends.beyond] / of_board if of_board > 0 else np.ones(len(end))
    echo = brightness * (scan.range_m[end] / scan.range_m[ends.beyond]) ** 2
    echo = np.where(np.isfinite(ends.behind_m), echo / (1 + echo), 0.0)
    return LidarBoard(
        points=points,
        ring=scan.ring[kept],
        edge_points=scan.points[edge].astype(np.float64),
        edge_ring=scan.ring[edge],
        edge_side=ends.side[order],
        edge_behind_m=ends.behind_m[order],
        edge_echo=echo[order],
        azimuth_step_rad=scan.step_rad,
        plane=view.plane,
        sigma_m=rms_m,
        T_lidar_board=view.pose_of(fitted),
        offset_ns=None if source.offset_ns is None else source.offset_ns[scan.index[kept]],
        quality=quality,
        edge_sigma_m=smear_m[order] if smear_m.any() else None,
    )
