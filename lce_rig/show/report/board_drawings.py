"""Where the boards were: in the image, around the LiDAR from above, by range and angle."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.detect.events.figures import outline_px
from lce_rig.show.report.drawing import BLUE, FAINT, INK, ORANGE, QUIET, WIDTH_IN, drawing, new_axes
from lce_rig.show.report.evidence import Evidence

_LINE = 0.8


def image_axes(lens: Intrinsics, below_in: float = 0.0) -> tuple[Any, Any]:
    """Start a figure with axes as the camera's image, pixels, v down; `below_in` stays free below them."""
    left_in, right_in, bottom_in, top_in = 0.42, 0.1, 0.42 + below_in, 0.25
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
    figure, axes = image_axes(lens)
    outlines = [outline_px(o.image.T_cam_board, board, lens) for o in evidence.observations]
    alpha = float(np.clip(4 / len(outlines), 0.07, 0.3))
    visible = [outline[np.isfinite(outline).all(axis=1)][::6] for outline in outlines]
    _add_shapes(axes, visible, [links[o.capture] for o in evidence.observations], alpha)
    return drawing(figure, "Outlines of the boards in the image")


def draw_from_above(
    calibration: Calibration, evidence: Evidence, board: Board, lens: Intrinsics, links: Mapping[str, str]
) -> Markup:
    """Draw the plates about the LiDAR as seen from above, with the camera's field of view."""
    from matplotlib.patches import Circle

    # Left is +y of the LiDAR, up is +x.
    plates = [transform(o.lidar.T_lidar_board, board.outline())[:, 1::-1] for o in evidence.observations]
    shown = np.concatenate([*plates, np.zeros((1, 2))])
    far_m = float(np.linalg.norm(shown, axis=1).max())
    low, high = shown.min(axis=0) - 0.1 * far_m, shown.max(axis=0) + 0.1 * far_m
    wide_m, high_m = high - low
    missing_m = max(0.5 * wide_m - high_m, 0.0) / 2, max(high_m - wide_m, 0.0) / 2
    low, high = low - missing_m[::-1], high + missing_m[::-1]
    wide_m, high_m = high - low
    figure, (axes,) = new_axes(WIDTH_IN * high_m / wide_m, left_in=0, right_in=0, bottom_in=0, top_in=0)
    # The direction with most room shows the circles' radii.
    signs = np.concatenate([-np.eye(2), np.eye(2)])
    radial = signs[int(np.argmax([-low[0], -low[1], high[0], high[1]]))]
    step_m = next(step for step in (0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 1e6) if far_m / step <= 6)
    for radius_m in np.arange(step_m, 1.5 * far_m, step_m):
        axes.add_patch(Circle((0, 0), radius_m, fill=False, edgecolor=FAINT, linewidth=0.6))
        axes.text(
            *(radius_m * radial), f"{radius_m:g} m", color=QUIET, ha="center", va="center", clip_on=True
        )
    _draw_camera(axes, calibration, lens, far_m)
    _add_shapes(axes, plates, [links[o.capture] for o in evidence.observations], 0.5)
    axes.plot(0, 0, "o", color=INK, markersize=4)
    axes.set_xlim(high[0], low[0])
    axes.set_ylim(low[1], high[1])
    axes.set_axis_off()
    return drawing(figure, "Boards around the LiDAR, from above")


def _draw_camera(axes: Any, calibration: Calibration, lens: Intrinsics, far_m: float) -> None:
    """Draw the rays through the middles of the image's left and right borders."""
    T_lidar_cam = invert(calibration.T_cam_lidar)
    middle = (lens.height_px - 1) / 2
    rays = lens.unproject(np.array([[0.0, middle], [lens.width_px - 1.0, middle]]))
    start = T_lidar_cam[:3, 3]
    for ray in rays[np.isfinite(rays).all(axis=1)]:
        end = start + 2 * far_m * T_lidar_cam[:3, :3] @ ray
        axes.plot([start[1], end[1]], [start[0], end[0]], color=ORANGE, linewidth=_LINE)
    axes.plot(start[1], start[0], "s", color=ORANGE, markersize=3)


def draw_ranges_and_angles(evidence: Evidence, links: Mapping[str, str]) -> Markup:
    """Draw each board's distance from the LiDAR and the angle at which the beam meets it."""
    figure, (axes,) = new_axes(2.4)
    angle_deg = np.array([o.lidar.quality.incidence_deg for o in evidence.observations])
    _scatter(axes, evidence.range_m, angle_deg, [links[o.capture] for o in evidence.observations])
    axes.set_xlim(0, 1.1 * float(evidence.range_m.max()))
    axes.set_ylim(0, max(60.0, 1.1 * float(angle_deg.max())))
    axes.set_xlabel("distance from the LiDAR, m")
    axes.set_title("angle to the beam, deg")
    axes.grid()
    return drawing(figure, "Distance and angle of the boards")


def _add_shapes(axes: Any, shapes: Sequence[Array], links: list[str], alpha: float) -> None:
    """Add polygons (N, 2), each a link."""
    from matplotlib.collections import PolyCollection

    drawn = PolyCollection(shapes, facecolors=BLUE, edgecolors=BLUE, alpha=alpha, linewidths=_LINE)
    drawn.set_urls(links)
    axes.add_collection(drawn, autolim=False)


def _scatter(axes: Any, x: Array, y: Array, links: list[str]) -> None:
    points = axes.scatter(x, y, s=26, color=BLUE, alpha=0.8, linewidths=0)
    points.set_urls(links)
