"""One page on drift: a scene's edges under two extrinsics, and the score along each axis."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lce_rig.core.calibration import MOTIONS, AxisDrift, State
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.geometry import transform
from lce_rig.core.phrasing import motion_words
from lce_rig.scene.depth_edges import DepthEdges
from lce_rig.scene.drift import Drift
from lce_rig.scene.findings import STATES
from lce_rig.show.overlays import canvas
from lce_rig.show.overlays.canvas import BLACK, INK, MAGENTA, Picture

_PAGE_PX = 1600
_COLOURS = {"unchanged": "#2a7d3f", "changed": "#c0392b", "unknown": "#7a7f85"}
_BOARD = "#b8860b"
_CHART_DPI = 100


def draw_drift(
    drift: Drift,
    image: Image,
    edges: DepthEdges,
    intrinsics: Intrinsics,
    title: str,
    states: Mapping[str, State],
    board: Sequence[AxisDrift] = (),
) -> Picture:
    """Draw one capture's depth edges under both extrinsics side by side, above the score along each axis.

    Args:
        drift: the scene's opinion.
        image: of the capture.
        edges: of its scan.
        intrinsics: of the camera.
        title: one line.
        states: the verdict on each axis, the board's opinion included.
        board: the board's opinion on each axis, if there is one.

    Returns:
        BGR (H, W, 3).
    """
    half = _PAGE_PX // 2
    panels = []
    for name, T in (("deployed", drift.T_cam_lidar), ("best fit", drift.T_best)):
        picture, factor = canvas.enlarged(image.pixels)
        pixels, _ = intrinsics.project(transform(T, edges.points))
        at = (pixels[intrinsics.is_inside(pixels)] + 0.5) * factor - 0.5
        canvas.draw_discs(picture, at, MAGENTA, 2.2e-3 * picture.shape[1], BLACK)
        picture = canvas.fitted(picture, half, round(half * picture.shape[0] / picture.shape[1]))
        strip = canvas.panel(half, 40)
        canvas.draw_text(strip, f"{title}  {name}", 12, 27, 13, INK)
        panels.append(np.vstack([strip, picture]))
    # Between images as white as the page, such as those of events.
    panels[0][:, -2:] = BLACK
    page = np.hstack(panels)
    return np.vstack([page, _draw_curves(drift, states, board)]) if drift.curves else page


def _draw_curves(drift: Drift, states: Mapping[str, State], board: Sequence[AxisDrift]) -> Picture:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(_PAGE_PX / _CHART_DPI, 5.2), dpi=_CHART_DPI, facecolor="white")
    chart: Any = FigureCanvasAgg(figure)
    grid = figure.subplots(2, 3)
    # Rotations above translations.
    order = [*range(3, 6), *range(3)]
    for axes, index in zip(grid.ravel(), order, strict=True):
        verdict, curve = drift.axes[index], drift.curves[MOTIONS[index]]
        state = states[MOTIONS[index]]
        unit, scale = ("deg", np.degrees(1.0)) if verdict.unit == "deg" else ("mm", 1000.0)
        shown = 1.0 if verdict.unit == "deg" else 1000.0
        axes.plot(scale * curve.offsets, curve.total, color=_COLOURS[state])
        axes.axvline(0.0, color="black", linewidth=0.8)
        if np.isfinite(verdict.smallest):
            axes.axvspan(
                -shown * verdict.smallest, shown * verdict.smallest, color=_COLOURS[verdict.state], alpha=0.12
            )
        if board:
            low, high = axes.get_ylim()
            axes.errorbar(
                shown * board[index].change,
                low + 0.1 * (high - low),
                xerr=shown * board[index].sigma,
                fmt="D",
                color=_BOARD,
                markersize=4,
                capsize=3,
            )
        axes.set_xlim(scale * curve.offsets[0], scale * curve.offsets[-1])
        by_board = "" if state == verdict.state else " (board)"
        axes.set_title(f"{motion_words(MOTIONS[index])}: {STATES[state]}{by_board}", fontsize=8)
        axes.set_xlabel(unit, fontsize=8)
        axes.tick_params(labelsize=8)
    of_board = "; diamond: by the board, 1 standard deviation" if board else ""
    figure.suptitle(
        f"score of the scene along each axis; shaded: changes too small to be seen{of_board}", fontsize=10
    )
    figure.tight_layout()
    chart.draw()
    return np.ascontiguousarray(np.asarray(chart.buffer_rgba())[..., 2::-1])
