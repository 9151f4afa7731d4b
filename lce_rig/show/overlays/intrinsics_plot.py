"""One page about measured intrinsics: what the corners determine, and where they determine nothing."""

from collections.abc import Sequence
from textwrap import wrap
from typing import Any

import numpy as np

from lce_rig.core.geometry import Array
from lce_rig.lens.difference import LensCertainty
from lce_rig.lens.lens_estimate import IntrinsicsEstimate
from lce_rig.show.overlays.canvas import Picture

_INK, _GREY, _FAINT, _SHADE = "#22262b", "#5b636b", "#9aa3ad", "#e9ecef"
_BLUE, _ORANGE = "#1f6fb4", "#d9730d"
# The standard deviation map covers 0.01 to 10 px; beyond, the intrinsics are unusable.
_CERTAIN_PX, _UNKNOWN_PX = 0.01, 10.0
_CELLS, _MIN_IN_CELL = 16, 4
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
    _draw_residuals(figure.add_subplot(grid[0]), estimate)
    _draw_certainty(figure, figure.add_subplot(grid[1]), estimate, certainty)
    for row, line in enumerate(reversed(notes)):
        figure.text(0.035, (0.15 + 0.2 * row) / height, line, fontsize=10, color=_INK)
    canvas.draw()
    rgba = np.asarray(canvas.buffer_rgba())
    return np.ascontiguousarray(rgba[..., 2::-1])


def _frame(axis: Any, estimate: IntrinsicsEstimate, title: str, note: str) -> None:
    """Lay out an axis as the image: pixels, v down."""
    lens = estimate.intrinsics
    axis.set_xlim(-0.5, lens.width_px - 0.5)
    axis.set_ylim(lens.height_px - 0.5, -0.5)
    axis.set_aspect("equal")
    axis.set_xlabel("u, px", color=_INK)
    axis.set_ylabel("v, px", color=_INK)
    _style(axis, title, note)


def _style(axis: Any, title: str, note: str) -> None:
    axis.annotate(
        title, (0, 1), (0, 21), xycoords="axes fraction", textcoords="offset points", fontsize=12, color=_INK
    )
    axis.annotate(
        note, (0, 1), (0, 7), xycoords="axes fraction", textcoords="offset points", fontsize=9.5, color=_GREY
    )
    axis.tick_params(colors=_INK, labelsize=9)
    for spine in axis.spines.values():
        spine.set_color(_FAINT)


def _draw_residuals(axis: Any, estimate: IntrinsicsEstimate) -> None:
    note = f"mean of each cell with at least {_MIN_IN_CELL} corners; nothing was seen in the blank area"
    _frame(axis, estimate, "Residuals over the image", note)
    corners, residuals = estimate.corners_px, estimate.residuals_px
    axis.plot(*corners.T, ".", color=_FAINT, markersize=1.6, alpha=0.7, zorder=1)
    cell_px = estimate.intrinsics.width_px / _CELLS
    cells, index, counts = np.unique(
        np.floor(corners / cell_px), axis=0, return_inverse=True, return_counts=True
    )
    sums = np.zeros((len(cells), 4))
    np.add.at(sums, index.ravel(), np.concatenate([corners, residuals], axis=1))
    means = (sums / counts[:, None])[counts >= _MIN_IN_CELL]
    if len(means):
        _arrows(axis, means[:, :2], means[:, 2:], cell_px)


def _arrows(axis: Any, at: Array, vectors_px: Array, reach_px: float) -> None:
    """Draw arrows scaled so that a typical one fills its cell, with a key of a round length."""
    lengths = np.linalg.norm(vectors_px, axis=1)
    usual = max(float(np.percentile(lengths, 90)), 1e-6)
    magnification = reach_px / usual
    shown = vectors_px * np.minimum(1.0, 2.0 * usual / np.maximum(lengths, 1e-12))[:, None] * magnification
    arrows = axis.quiver(
        *at.T, *shown.T, color=_BLUE, angles="xy", scale_units="xy", scale=1.0, width=0.0026, zorder=3
    )
    # The key is 1, 2 or 5 times a power of ten, not above the usual length.
    power = 10.0 ** np.floor(np.log10(usual))
    key_px = float(max(step for step in (1.0, 2.0, 5.0) if step * power <= usual * (1 + 1e-9)) * power)
    axis.quiverkey(
        arrows,
        1.0 - 1.2 / _CELLS,
        1.105,
        key_px * magnification,
        f"{key_px:g} px  ",
        labelpos="W",
        labelcolor=_INK,
        fontproperties={"size": 9},
    )


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
