"""Residuals of a result's boards, point by point, and their drawings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
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
from lce_rig.show.page import BLUE, FAINT, INK, ORANGE, QUIET, WIDTH_IN, drawing, new_axes

# Cells along the width of the image, and corners that one needs.
_CELLS, _MIN_IN_CELL = 14, 5


@dataclass(frozen=True, eq=False)
class Evidence:
    """The LiDAR's points on all boards, and the corners in all images.

    Attributes:
        observations: of the C captures used, by name.
        capture: (N,) index of each point's capture.
        plane_m: (N,) signed distance from the camera's board plane, positive behind it.
        ring: (N,) of each point.
        range_m: (C,) distance of each capture's board from the LiDAR.
        corners_px: (M, 2) as measured.
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
    plane_m = [plane_residuals(f, T, o.lidar.points) for f, o in zip(features, observations, strict=True)]
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


_LINE = 0.8


def _image_axes(lens: Intrinsics) -> tuple[Any, Any]:
    """Start a figure with axes as the camera's image, pixels, v down."""
    left_in, right_in, bottom_in, top_in = 0.42, 0.1, 0.42, 0.25
    image_in = (WIDTH_IN - left_in - right_in) * lens.height_px / lens.width_px
    figure, (axes,) = new_axes(
        image_in + bottom_in + top_in, left_in=left_in, right_in=right_in, bottom_in=bottom_in, top_in=top_in
    )
    axes.set_xlim(-0.5, lens.width_px - 0.5)
    axes.set_ylim(lens.height_px - 0.5, -0.5)
    axes.set_xlabel("u, px")
    axes.set_title("v, px")
    for spine in axes.spines.values():
        spine.set_visible(True)
    return figure, axes


def draw_in_image(evidence: Evidence, board: Board, lens: Intrinsics, links: Mapping[str, str]) -> Markup:
    """Draw the outline of every board into the plane of the image."""
    figure, axes = _image_axes(lens)
    outlines = [outline_px(o.image.T_cam_board, board, lens) for o in evidence.observations]
    alpha = float(np.clip(4 / len(outlines), 0.07, 0.3))
    visible = [outline[np.isfinite(outline).all(axis=1)][::6] for outline in outlines]
    _add_shapes(axes, visible, [links[o.capture] for o in evidence.observations], alpha)
    return drawing(figure, "Outlines of the boards in the image")


def draw_from_above(
    calibration: Calibration, evidence: Evidence, board: Board, lens: Intrinsics, links: Mapping[str, str]
) -> Markup:
    """Draw the plates about the LiDAR as seen from above, with the camera's field of view."""
    # Left is +y of the LiDAR, up is +x.
    plates = [transform(o.lidar.T_lidar_board, board.outline())[:, 1::-1] for o in evidence.observations]
    shown = np.concatenate([*plates, np.zeros((1, 2))])
    far_m = float(np.linalg.norm(shown, axis=1).max())
    figure, (axes,) = new_axes(WIDTH_IN)
    # The rays through the middles of the image's left and right borders.
    T_lidar_cam, middle = invert(calibration.T_cam_lidar), (lens.height_px - 1) / 2
    rays = lens.unproject(np.array([[0.0, middle], [lens.width_px - 1.0, middle]]))
    start = T_lidar_cam[:3, 3]
    for ray in rays[np.isfinite(rays).all(axis=1)]:
        end = start + 2 * far_m * T_lidar_cam[:3, :3] @ ray
        axes.plot([start[1], end[1]], [start[0], end[0]], color=ORANGE, linewidth=_LINE)
    axes.plot(start[1], start[0], "s", color=ORANGE, markersize=3)
    _add_shapes(axes, plates, [links[o.capture] for o in evidence.observations], 0.5)
    axes.plot(0, 0, "o", color=INK, markersize=4)
    low, high = shown.min(axis=0) - 0.1 * far_m, shown.max(axis=0) + 0.1 * far_m
    axes.set(xlim=(high[0], low[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("left of the LiDAR, m")
    axes.set_title("ahead, m")
    axes.grid()
    return drawing(figure, "Boards around the LiDAR, from above")


def _add_shapes(axes: Any, shapes: Sequence[Array], links: list[str], alpha: float) -> None:
    """Add polygons (N, 2), each a link."""
    from matplotlib.collections import PolyCollection

    drawn = PolyCollection(shapes, facecolors=BLUE, edgecolors=BLUE, alpha=alpha, linewidths=_LINE)
    drawn.set_urls(links)
    axes.add_collection(drawn, autolim=False)


def draw_by_ring(evidence: Evidence) -> Markup:
    """Draw how far each laser ring's points lie behind the camera's board planes on average."""
    rings = np.unique(evidence.ring)
    behind_mm = [1000 * evidence.plane_m[evidence.ring == ring] for ring in rings]
    figure, (axes,) = new_axes(2.4)
    _zero(axes)
    axes.errorbar(
        rings, [values.mean() for values in behind_mm], [values.std() for values in behind_mm],
        fmt="o", color=BLUE, ecolor=FAINT, markersize=4, elinewidth=1.2,
    )  # fmt: skip
    axes.set_xlabel("ring, as the scan numbers it")
    axes.set_title("behind the plane, mm")
    return drawing(figure, "Residuals by ring")


def draw_by_range(evidence: Evidence, links: Mapping[str, str]) -> Markup:
    """Draw how far each board lies behind the camera's plane by its distance from the LiDAR."""
    n = len(evidence.observations)
    counts = np.bincount(evidence.capture, minlength=n)
    mean_mm = 1000 * np.bincount(evidence.capture, evidence.plane_m, n) / counts
    rms_mm = 1000 * np.sqrt(np.bincount(evidence.capture, evidence.plane_m**2, n) / counts)
    spread_mm = np.sqrt(np.maximum(rms_mm**2 - mean_mm**2, 0))
    figure, (axes,) = new_axes(2.4)
    _zero(axes)
    axes.errorbar(evidence.range_m, mean_mm, spread_mm, fmt="none", ecolor=FAINT, elinewidth=1.2)
    points = axes.scatter(evidence.range_m, mean_mm, s=20, color=BLUE, zorder=3, linewidths=0)
    points.set_urls([links[o.capture] for o in evidence.observations])
    axes.set_xlim(0, 1.05 * float(evidence.range_m.max()))
    axes.set_xlabel("distance from the LiDAR, m")
    axes.set_title("behind the plane, mm")
    return drawing(figure, "Residuals by range")


def _zero(axes: Any) -> None:
    axes.axhline(0, color=QUIET, linewidth=0.8)
    axes.grid(axis="y")


def draw_corners(evidence: Evidence, lens: Intrinsics) -> Markup:
    """Draw the mean residual of the corners in each cell of the image as an arrow."""
    figure, axes = _image_axes(lens)
    every = max(1, len(evidence.corners_px) // 1500)
    axes.plot(*evidence.corners_px[::every].T, ".", color=FAINT, markersize=1)
    _add_mean_arrows(axes, evidence.corners_px, evidence.corner_residuals_px, lens)
    return drawing(figure, "Residuals of the corners in the image")


def _add_mean_arrows(axes: Any, corners_px: Array, residuals_px: Array, lens: Intrinsics) -> None:
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
    scale = usual_px / cell_px
    arrows = axes.quiver(
        *means.T, color=BLUE, angles="xy", scale_units="xy", scale=scale, width=0.004, zorder=3
    )
    label = f"{significant(usual_px)} px "
    axes.quiverkey(arrows, 0.92, 1.11, usual_px, label, labelpos="W", labelcolor=INK)
