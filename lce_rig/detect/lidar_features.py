"""What the calibration needs from a registered board: plane, points, ring ends and measured size."""

from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array, pose
from lce_rig.core.results import LidarBoard
from lce_rig.detect.lidar_edges import SLACK_M, RingEnds, find_ring_ends, measure_size, median
from lce_rig.detect.lidar_segments import Indices, OrderedScan
from lce_rig.detect.lidar_template import (
    Placement,
    PlaneView,
    beams_about,
    plane_axes,
    rate,
    register,
    view_plane,
)

SURROUND_M = 0.20
MIN_POINTS = 12
EDGE_TOLERANCE_M = 0.012
BORDER_M = 0.06  # how bright the board is near its outline is asked of returns so near to it
SETTLED_M = 0.01  # an outline that moves less leaves the returns inside it, and so the plane, as they are


@dataclass(frozen=True)
class Beam:
    """The light spot of a LiDAR: half of it reaches over an edge before the board's return is lost.

    Attributes:
        aperture_m: width of the beam where it leaves the sensor.
        divergence_rad: full angle by which it widens.
    """

    aperture_m: float = 0.0127
    divergence_rad: float = 0.003

    def half_width_m(self, distance_m: float) -> float:
        """Compute half the width of the spot at a distance."""
        return (self.aperture_m + self.divergence_rad * distance_m) / 2


def fit_plane_to_ranges(points: Array, start: Array, scale_m: float, n_rounds: int = 3) -> Array:
    """Fit a plane to ranges: minimise sum rho_T(r_i - 1 / (m . u_i)) over m, n = -m / |m|, d = 1 / |m|.

    The beams' directions u_i are exact and the noise lies along them. Orthogonal least squares would turn the
    plane towards the sensor, by sigma^2 / spread^2 rad at 45 deg. rho_T is Tukey's biweight at 4.7 scales.

    Args:
        points: (N, 3) m, frame lidar.
        start: (4,) plane as (n, d).
        scale_m: noise of a range.
        n_rounds: Gauss-Newton rounds.

    Returns:
        (4,) plane as (n, d), n towards the LiDAR.
    """
    range_m = np.linalg.norm(points, axis=1)
    rays = points / range_m[:, None]
    m = -start[:3] / start[3]
    for _ in range(n_rounds):
        predicted = 1.0 / (rays @ m)
        residual = range_m - predicted
        weight = np.maximum(1.0 - (residual / (4.7 * scale_m)) ** 2, 0.0) ** 2
        jacobian = -rays * (predicted**2)[:, None]
        hessian = (jacobian * weight[:, None]).T @ jacobian
        m = m + np.linalg.solve(hessian + 1e-9 * np.eye(3), jacobian.T @ (weight * residual))
    return np.asarray(np.append(-m, 1.0) / np.linalg.norm(m))


def refine(
    scan: OrderedScan,
    plane: Array,
    centre: Array,
    placement: Placement,
    limit_m: float,
    max_beyond: float = np.inf,
) -> tuple[PlaneView, Placement] | None:
    """Fit the plane to the single returns inside the outline, and the outline to the beams about it.

    Args:
        scan: all returns.
        plane: (4,) first guess.
        centre: (3,) m, the point of the plane the placement is counted from.
        placement: first guess of the outline.
        limit_m: largest error of an outline; what is far worse is not improved further.
        max_beyond: most returns in the plane beyond the outline, per return inside, to look closer.

    Returns:
        The beams about the plate and the outline among them, with its error; None where too few returns lie
        on the plane inside the outline, or too many beyond it.
    """
    radius_m = float(np.hypot(*placement.half_m)) + SURROUND_M
    tolerance_m = 4.0 * scan.sigma_m + 0.01
    near = beams_about(scan, centre + plane_axes(plane[:3]) @ [placement.u_m, placement.v_m], 1.3 * radius_m)
    for k in range(3):
        centre = centre + plane_axes(plane[:3]) @ [placement.u_m, placement.v_m]
        placement = replace(placement, u_m=0.0, v_m=0.0)
        view = view_plane(scan, near, plane, centre, radius_m, tolerance_m)
        if k == 0:
            error_m = rate(scan, view, placement)
            if error_m > 2.0 * limit_m:
                return view, replace(placement, error_m=error_m)
        away = placement.distance_m(view.uv[view.is_on])
        on = view.member[view.is_on][away < 0.0]
        if len(on) < 10 or (k == 0 and np.count_nonzero(away > SLACK_M) > max_beyond * len(on)):
            return None
        points = scan.points[on].astype(np.float64)
        height = points @ plane[:3] + plane[3]
        scale_m = 1.4826 * median(np.abs(height - median(height))) + 0.001
        plane = fit_plane_to_ranges(points, plane, scale_m * float(np.linalg.norm(centre)) / plane[3])
        height = points @ plane[:3] + plane[3]
        tolerance_m = 3.5 * 1.4826 * median(np.abs(height)) + 0.004
        view = view_plane(scan, near, plane, view.origin, radius_m, tolerance_m)
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
    """Collect the returns inside the outline, keep the ring ends that are the board's own, and sum up.

    Args:
        scan: all returns, ordered.
        source: the scan they come from.
        board: nominal size.
        view: beams about the board.
        placement: of the nominal rectangle.
        beam: light spot of the LiDAR.

    Returns:
        The board, None where hardly a return lies inside the outline.
    """
    distance_m = float(np.linalg.norm(view.origin))
    beyond_m = beam.half_width_m(distance_m)
    away = placement.distance_m(view.uv)
    # A plate somewhat larger than it should be is to be measured, not cut to size.
    ends = find_ring_ends(scan, view, view.is_on & (away <= beyond_m + SLACK_M))
    fitted, size_sigma_m, residual, step_m = measure_size(ends, view.uv, placement, beyond_m)
    away = fitted.distance_m(view.uv)
    is_board = view.is_on & (away <= beyond_m + EDGE_TOLERANCE_M)
    if is_board.sum() < MIN_POINTS:
        return None
    limit_m = step_m / 2 + EDGE_TOLERANCE_M + 0.5 * beyond_m
    is_good = ends.is_border & (np.abs(residual) <= limit_m)
    order = np.lexsort((ends.side, scan.ring[view.member[ends.beam]]))
    order = order[is_good[order]]
    kept, edge = view.member[is_board], view.member[ends.beam[order]]
    border = kept[away[is_board] > -BORDER_M]
    points = scan.points[kept].astype(np.float64)
    height = points @ view.plane[:3] + view.plane[3]
    low_m, high_m = np.percentile(height, [2.5, 97.5])
    rms_m = float(np.sqrt(np.mean(height**2)))
    incidence = np.arccos(np.clip(view.plane[3] / distance_m, 0.0, 1.0))
    # How much of the light spot counts is not known.
    quality = _size_figures(2 * np.asarray(fitted.half_m), np.hypot(size_sigma_m, beyond_m), board) | {
        "n_rings": float(1 + np.count_nonzero(np.diff(scan.ring[kept]))),
        "n_points": float(len(kept)),
        "n_ring_ends": float(len(edge)),
        "n_ring_ends_dropped": float(len(ends.beam) - len(edge)),
        "thickness_m": float(high_m - low_m),
        "plane_rms_m": rms_m,
        "edge_rms_m": float(np.sqrt(np.mean(residual[is_good] ** 2))) if is_good.any() else float("nan"),
        "template_m": placement.error_m,
        "beyond_share": float((view.is_on & (away > SLACK_M)).sum()) / max(1, len(kept)),
        "distance_m": distance_m,
        "incidence_deg": float(np.degrees(incidence)),
        "range_noise_m": scan.sigma_m,
    }
    return LidarBoard(
        points=points,
        ring=scan.ring[kept],
        edge_points=scan.points[edge].astype(np.float64),
        edge_ring=scan.ring[edge],
        edge_side=ends.side[order],
        edge_behind_m=ends.behind_m[order],
        edge_echo=_echo_shares(scan, source, ends, view, border)[order],
        azimuth_step_rad=scan.step_rad,
        plane=view.plane,
        sigma_m=rms_m,
        T_lidar_board=_pose_of(view, fitted),
        offset_ns=None if source.offset_ns is None else source.offset_ns[scan.index[kept]],
        quality=quality,
    )


def _size_figures(size_m: Array, sigma_m: Array, board: Board) -> dict[str, float]:
    """State width and height (2,) with their sigmas (2,), and how large they are beside the nominal ones."""
    weight = 1.0 / sigma_m**2
    ratio = (weight * size_m / [board.width_m, board.height_m]).sum() / weight.sum()
    return {
        "width_m": float(size_m[0]),
        "height_m": float(size_m[1]),
        "width_sigma_m": float(sigma_m[0]),
        "height_sigma_m": float(sigma_m[1]),
        "size_ratio": float(ratio),
    }


def _echo_shares(scan: OrderedScan, source: Scan, ends: RingEnds, view: PlaneView, border: Indices) -> Array:
    """Compute the share (E,) of the power that comes from behind where a beam meets it and the board alike.

    Intensities are those of surfaces; what is received from them falls with the square of the range.

    Args:
        scan: all returns.
        source: the scan they come from; where it has no intensities all surfaces count as alike.
        ends: ring ends.
        view: beams about the board.
        border: returns from near the board's outline.
    """
    intensity = source.intensity[scan.index].astype(np.float64)
    end = view.member[ends.beam]
    of_board = float(np.median(intensity[border])) if len(border) else 0.0
    brightness = intensity[ends.beyond] / of_board if of_board > 0 else np.ones(len(end))
    echo = brightness * (scan.range_m[end] / scan.range_m[ends.beyond]) ** 2
    return np.where(np.isfinite(ends.behind_m), echo / (1 + echo), 0.0)


def _pose_of(view: PlaneView, placement: Placement) -> Array:
    """Compute T_lidar_board of a placement, y upwards where the rectangle leaves the choice."""
    direction = np.array([np.cos(placement.angle_rad), np.sin(placement.angle_rad)])
    if direction[0] < 0:
        direction = -direction
    x = view.axes @ direction
    normal = view.plane[:3]
    R = np.stack([x, np.cross(normal, x), normal], axis=1)
    return pose(R, view.origin + view.axes @ [placement.u_m, placement.v_m])
