"""One page about measured intrinsics: what the corners determine, and where they determine nothing."""

from collections.abc import Sequence
from textwrap import wrap
from typing import Any

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.core.phrasing import significant
from lce_rig.lens.difference import LensCertainty
from lce_rig.lens.lens_estimate import IntrinsicsEstimate
from lce_rig.show.overlays.canvas import Picture

_INK, _GREY, _FAINT, _SHADE = "#22262b", "#5b636b", "#9aa3ad", "#e9ecef"
_BLUE, _ORANGE = "#1f6fb4", "#d9730d"
# Cells along the width of the image, and corners that one needs.
_CELLS, _MIN_IN_CELL = 14, 5
# The standard deviation map covers 0.01 to 10 px; beyond, the intrinsics are unusable.
_CERTAIN_PX, _UNKNOWN_PX = 0.01, 10.0
_DPI = 110


def draw_intrinsics(
    estimate: IntrinsicsEstimate,
    certainty: LensCertainty,
    *,
    title: str,
    weaknesses: Sequence[str] = (),
) -> Picture:
    """Draw residuals and certainty over the image.

    Args:
        estimate: of the lens.
        certainty: of the same.
        title: of the page.
        weaknesses: sentences to print below.

    Returns:
        BGR (H, W, 3).
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    notes = [line for text in weaknesses for line in wrap(f"- {text}", 190, subsequent_indent="  ")]
    below = 0.2 * len(notes)
    height = 6.2 + below
    figure: Any = Figure(figsize=(15, height), dpi=_DPI, facecolor="white")
    canvas: Any = FigureCanvasAgg(figure)
    figure.text(0.035, 1 - 0.3 / height, title, fontsize=16, color=_INK, fontweight="bold", va="center")
    n = len({view.capture for view in estimate.views})
    summary = (
        f"{estimate.model.name}, {len(estimate.views)} images of {n} captures.   Corners lie "
        f"{estimate.rms_px:.3f} px rms from their prediction, {estimate.held_out_rms_px:.3f} px on "
        "held-out captures."
    )
    figure.text(0.035, 1 - 0.65 / height, summary, fontsize=11, color=_INK, va="center")
    lowest, highest = (0.7 + below) / height, 1 - 1.45 / height
    grid = figure.add_gridspec(1, 2, left=0.05, right=0.92, top=highest, bottom=lowest, wspace=0.16)
    note = f"mean of each cell with at least {_MIN_IN_CELL} corners; nothing was seen in the blank area"
    residuals = figure.add_subplot(grid[0])
    _frame(residuals, estimate, "Residuals over the image", note)
    residuals.plot(*estimate.corners_px.T, ".", color=_FAINT, markersize=1.6, alpha=0.7, zorder=1)
    add_mean_arrows(residuals, estimate.corners_px, estimate.residuals_px, estimate.intrinsics)
    _draw_certainty(figure, figure.add_subplot(grid[1]), estimate, certainty)
    for row, line in enumerate(reversed(notes)):
        figure.text(0.035, (0.15 + 0.2 * row) / height, line, fontsize=10, color=_INK)
    canvas.draw()
    rgba = np.asarray(canvas.buffer_rgba())
    return np.ascontiguousarray(rgba[..., 2::-1])


def _frame(axis: Any, estimate: IntrinsicsEstimate, title: str, note: str) -> None:
    """Lay out an axis as the image: pixels, v down."""
    lens = estimate.intrinsics
    axis.set(xlim=(-0.5, lens.width_px - 0.5), ylim=(lens.height_px - 0.5, -0.5), aspect="equal")
    axis.set_xlabel("u, px", color=_INK)
    axis.set_ylabel("v, px", color=_INK)
    for text, up_pt, size_pt, colour in ((title, 21, 12, _INK), (note, 7, 9.5, _GREY)):
        axis.annotate(
            text,
            (0, 1),
            (0, up_pt),
            xycoords="axes fraction",
            textcoords="offset points",
            fontsize=size_pt,
            color=colour,
        )
    axis.tick_params(colors=_INK, labelsize=9)
    for spine in axis.spines.values():
        spine.set_color(_FAINT)


def add_mean_arrows(axes: Any, corners_px: Array, residuals_px: Array, lens: Intrinsics) -> None:
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
        *means.T, color=_BLUE, angles="xy", scale_units="xy", scale=scale, width=0.004, zorder=3
    )
    label = f"{significant(usual_px)} px "
    axes.quiverkey(arrows, 0.92, 1.11, usual_px, label, labelpos="W", labelcolor=_INK)


def _draw_certainty(figure: Any, axis: Any, estimate: IntrinsicsEstimate, certainty: LensCertainty) -> None:
    from matplotlib.colors import LogNorm

    covered = 100 * float(certainty.is_covered.mean())
    note = f"boards were seen inside the orange line: {covered:.0f} % of the image"
    _frame(axis, estimate, "Standard deviation of the intrinsics", note)
    lens = estimate.intrinsics
    extent = (-0.5, lens.width_px - 0.5, lens.height_px - 0.5, -0.5)
    sigma = np.clip(certainty.sigma_px, _CERTAIN_PX, _UNKNOWN_PX)
    axis.set_facecolor(_SHADE)
    norm = LogNorm(_CERTAIN_PX, _UNKNOWN_PX)
    shown = axis.imshow(sigma, extent=extent, norm=norm, cmap="YlGnBu_r", interpolation="bilinear")
    u, v = certainty.pixels[..., 0], certainty.pixels[..., 1]
    axis.contour(u, v, certainty.is_covered.astype(float), [0.5], colors=[_ORANGE], linewidths=2)
    levels = [level for level in (0.1, 1.0) if np.nanmin(sigma) < level < np.nanmax(sigma)]
    if levels:
        lines = axis.contour(u, v, sigma, levels, colors=[_INK], linewidths=0.8)
        axis.clabel(lines, fmt=lambda value: f"{value:g} px", fontsize=9)
    bar = figure.colorbar(shown, cax=axis.inset_axes((1.02, 0.0, 0.025, 1.0)))
    bar.set_label("standard deviation of a pixel", color=_INK)
    bar.ax.tick_params(colors=_INK, labelsize=9)
    bar.set_ticks([0.01, 0.1, 1.0, 10.0], labels=["0.01 px", "0.1 px", "1 px", "10 px"])
