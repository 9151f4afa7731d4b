"""Residuals of a result's boards, point by point, and their drawings."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.plane_and_ends import extract_features, plane_residuals
from lce_rig.calibrate.result import squares_scale, with_squares
from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.phrasing import significant
from lce_rig.core.planar_pose import refine_pose
from lce_rig.core.results import Observation
from lce_rig.detect.events.figures import outline_px
from lce_rig.show import svg
from lce_rig.show.svg import BLUE, FAINT, INK, ORANGE, QUIET, Axes

# Cells along the width of the image, and corners that one needs.
_CELLS, _MIN_IN_CELL = 14, 5


@dataclass(frozen=True, eq=False)
class Evidence:
    """The LiDAR's points on all boards, and the corners in all images.

    Attributes:
        observations: observations of the C captures used, by name.
        capture: (N,) index of each point's capture.
        plane_m: (N,) signed distance from the camera's board plane, positive behind it.
        ring: (N,) of each point.
        range_m: (C,) distance of each capture's board from the LiDAR.
        corners_px: (M, 2) measured corners.
        corner_residuals_px: (M, 2) measured less predicted from the board's best pose in its image.
    """

    observations: tuple[Observation, ...]
    capture: NDArray[np.intp]
    plane_m: Array
    ring: NDArray[np.int16]
    range_m: Array
    corners_px: Array
    corner_residuals_px: Array


def gather(calibration: Calibration, board: Board, lens: Intrinsics) -> Evidence | None:
    """Measure the residuals of every point and corner; None if the result was read from a file."""
    observations = tuple(calibration.observations[name] for name in sorted(calibration.observations))
    if not observations:
        return None
    T = calibration.T_cam_lidar
    corners = board.corners()
    squares = squares_scale(calibration.diagnostics)
    features = [extract_features(with_squares(o, squares), board, half_step=False) for o in observations]
    plane_m = [plane_residuals(f, T, o.surface.points) for f, o in zip(features, observations, strict=True)]
    residuals_px = []
    for o in observations:
        # A board that moved has its pose at the LiDAR's time; its corners are those of the image.
        T_cam_board, _ = refine_pose(o.image.T_cam_board, o.image.corners_px, corners, lens)
        residuals_px.append(o.image.corners_px - lens.project(transform(T_cam_board, corners))[0])
    corners_px = np.concatenate([o.image.corners_px for o in observations])
    is_seen = np.isfinite(corners_px[:, 0])
    return Evidence(
        observations,
        np.repeat(np.arange(len(observations)), [len(own) for own in plane_m]),
        np.concatenate(plane_m),
        np.concatenate([o.lidar.ring for o in observations]),
        np.array([o.lidar.quality.distance_m for o in observations]),
        corners_px[is_seen],
        np.concatenate(residuals_px)[is_seen],
    )


# Height of drawings of residuals.
_LOW = 173.0


def _image_axes(lens: Intrinsics) -> Axes:
    """Start a drawing with axes as the camera's image, pixels, v down."""
    width = svg.WIDTH - svg.LEFT - svg.RIGHT
    return Axes(
        svg.TOP + width * lens.height_px / lens.width_px + svg.BOTTOM,
        (-0.5, lens.width_px - 0.5),
        (lens.height_px - 0.5, -0.5),
        x_label="u, px",
        y_label="v, px",
        is_framed=True,
    )


def draw_in_image(evidence: Evidence, board: Board, lens: Intrinsics, links: Mapping[str, str]) -> Axes:
    """Draw the outline of every board into the plane of the image."""
    axes = _image_axes(lens)
    outlines = [outline_px(o.image.T_cam_board, board, lens) for o in evidence.observations]
    opacity = float(np.clip(4 / len(outlines), 0.07, 0.3))
    visible = [outline[np.isfinite(outline).all(axis=1)][::6] for outline in outlines]
    axes.polygons(visible, BLUE, opacity=opacity, links=[links[o.capture] for o in evidence.observations])
    return axes


def draw_from_above(
    calibration: Calibration, evidence: Evidence, board: Board, lens: Intrinsics, links: Mapping[str, str]
) -> Axes:
    """Draw the plates around the LiDAR from above, with the camera's field of view."""
    # Left is +y of the LiDAR, up is +x.
    plates = [transform(o.lidar.T_lidar_board, board.outline())[:, 1::-1] for o in evidence.observations]
    shown = np.concatenate([*plates, np.zeros((1, 2))])
    far_m = float(np.linalg.norm(shown, axis=1).max())
    low, high = shown.min(axis=0) - 0.1 * far_m, shown.max(axis=0) + 0.1 * far_m
    axes = Axes(
        svg.WIDTH,
        (high[0], low[0]),
        (low[1], high[1]),
        x_label="left of the LiDAR, m",
        y_label="ahead, m",
        grid="xy",
        is_equal=True,
    )
    # The rays through the middles of the image's left and right borders.
    T_lidar_cam, middle = invert(calibration.T_cam_lidar), (lens.height_px - 1) / 2
    rays = lens.unproject(np.array([[0.0, middle], [lens.width_px - 1.0, middle]]))
    rays = rays[np.isfinite(rays).all(axis=1)]
    start = T_lidar_cam[:3, 3]
    ends = start + 2 * far_m * rays @ T_lidar_cam[:3, :3].T
    axes.lines(np.tile(start[1::-1], (len(rays), 1)), ends[:, 1::-1], ORANGE)
    axes.dots(start[None, 1::-1], ORANGE, size=4, shape="square")
    axes.polygons(plates, BLUE, opacity=0.5, links=[links[o.capture] for o in evidence.observations])
    axes.dots(np.zeros((1, 2)), INK, size=5)
    return axes


def draw_by_ring(evidence: Evidence) -> Axes:
    """Draw how far each laser ring's points lie behind the camera's board planes on average."""
    rings = np.unique(evidence.ring).astype(np.float64)
    behind_mm = [1000 * evidence.plane_m[evidence.ring == ring] for ring in rings]
    mean_mm = np.array([values.mean() for values in behind_mm])
    spread_mm = np.array([values.std() for values in behind_mm])
    # Few rings still have whole numbers at their ticks.
    axes = _residual_axes(
        svg.padded(rings, least=2.5), rings, mean_mm, spread_mm, "ring, as the scan numbers it"
    )
    axes.dots(np.stack([rings, mean_mm], axis=1), BLUE, size=5)
    return axes


def draw_by_range(evidence: Evidence, links: Mapping[str, str]) -> Axes:
    """Draw how far each board lies behind the camera's plane by its distance from the LiDAR."""
    n = len(evidence.observations)
    counts = np.bincount(evidence.capture, minlength=n)
    mean_mm = 1000 * np.bincount(evidence.capture, evidence.plane_m, n) / counts
    rms_mm = 1000 * np.sqrt(np.bincount(evidence.capture, evidence.plane_m**2, n) / counts)
    spread_mm = np.sqrt(np.maximum(rms_mm**2 - mean_mm**2, 0))
    x_limits = 0.0, 1.05 * float(evidence.range_m.max())
    axes = _residual_axes(x_limits, evidence.range_m, mean_mm, spread_mm, "distance from the LiDAR, m")
    axes.linked_dots(
        np.stack([evidence.range_m, mean_mm], axis=1),
        BLUE,
        size=5,
        links=[links[o.capture] for o in evidence.observations],
    )
    return axes


def _residual_axes(
    x_limits: tuple[float, float], x: Array, mean_mm: Array, spread_mm: Array, x_label: str
) -> Axes:
    """Start a drawing of residuals with a line at 0 and bars of one standard deviation."""
    low_mm, high_mm = mean_mm - spread_mm, mean_mm + spread_mm
    y_limits = svg.padded(low_mm, high_mm, np.zeros(1))
    axes = Axes(_LOW, x_limits, y_limits, x_label=x_label, y_label="behind the plane, mm", grid="y")
    axes.horizontal(0.0, QUIET)
    axes.lines(np.stack([x, low_mm], axis=1), np.stack([x, high_mm], axis=1), FAINT, width=1.2)
    return axes


def draw_corners(evidence: Evidence, lens: Intrinsics) -> Axes:
    """Draw the mean residual of the corners in each cell of the image as an arrow."""
    axes = _image_axes(lens)
    every = max(1, len(evidence.corners_px) // 1500)
    axes.dots(evidence.corners_px[::every], FAINT, size=1.4)
    _add_mean_arrows(axes, evidence.corners_px, evidence.corner_residuals_px, lens)
    return axes


def _add_mean_arrows(axes: Axes, corners_px: Array, residuals_px: Array, lens: Intrinsics) -> None:
    """Draw the mean residual of (N, 2) in each cell of the image; a typical arrow fills its cell."""
    cell_px = lens.width_px / _CELLS
    cells, index, counts = np.unique(
        np.floor((corners_px + 0.5) / cell_px), axis=0, return_inverse=True, return_counts=True
    )
    sums = np.zeros((len(cells), 4))
    np.add.at(sums, index.ravel(), np.hstack([corners_px, residuals_px]))
    means = (sums / counts[:, None])[counts >= _MIN_IN_CELL]
    if not len(means):
        return
    usual_px = max(float(np.percentile(np.linalg.norm(means[:, 2:], axis=1), 90)), 1e-3)
    longer = cell_px / usual_px
    axes.arrows(means[:, :2], longer * means[:, 2:], BLUE, unit=cell_px, key=f"{significant(usual_px)} px")
