"""Residuals of a result by capture, ring, range and place in the image; and the corners' by the lens."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.show.report.board_drawings import image_axes
from lce_rig.show.report.drawing import BLUE, FAINT, INK, ORANGE, QUIET, drawing, new_axes
from lce_rig.show.report.evidence import Evidence

_CELLS = 14
_MIN_IN_CELL = 5
_MOST_LABELS = 10


def draw_by_capture(calibration: Calibration, links: Mapping[str, str]) -> Markup:
    """Draw two bars for each capture, planes and edges, which lead to its overlay."""
    residuals = calibration.residuals
    at = np.arange(len(residuals))
    figure, (axes,) = new_axes(2.4)
    for shift, colour, name, values in (
        (-0.2, BLUE, "planes", [r.plane_mean_m for r in residuals]),
        (0.2, ORANGE, "edges", [r.edge_mean_m for r in residuals]),
    ):
        bars = axes.bar(at + shift, 1000 * np.nan_to_num(values), 0.4, color=colour, label=name)
        for bar, residual in zip(bars, residuals, strict=True):
            bar.set_url(links[residual.capture])
    every = -(-len(residuals) // _MOST_LABELS)
    names = [r.capture.rpartition("/")[2].lstrip("0") or "0" for r in residuals]
    axes.set_xticks(at[::every], names[::every])
    axes.set_xlabel("capture")
    axes.set_title("mean distance, mm")
    axes.grid(axis="y")
    axes.set_axisbelow(True)
    axes.margins(x=0.01)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0, handlelength=1.2)
    return drawing(figure, "Residuals by capture")


def draw_by_ring(evidence: Evidence) -> Markup:
    """Draw how far each laser ring's points lie behind the camera's board planes on average."""
    rings = np.unique(evidence.ring)
    own_mm = [1000 * evidence.plane_m[evidence.ring == ring] for ring in rings]
    figure, (axes,) = new_axes(2.4)
    _zero(axes)
    axes.errorbar(
        rings, [own.mean() for own in own_mm], [own.std() for own in own_mm],
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


def draw_by_place(evidence: Evidence, lens: Intrinsics) -> Markup:
    """Draw the mean residual of the points in each cell of the image."""
    is_seen = lens.is_inside(evidence.points_px, -0.5)
    cells, means_mm = _cell_means(evidence.points_px[is_seen], 1000 * evidence.plane_m[is_seen, None], lens)
    figure, axes = image_axes(lens, below_in=0.6)
    size_px = lens.width_px / _CELLS
    grid = np.full((int(np.ceil(lens.height_px / size_px)), _CELLS), np.nan)
    for (u, v), value in zip(cells.astype(int), means_mm[:, 0], strict=True):
        grid[v, u] = value
    limit_mm = max(float(np.nanmax(np.abs(grid), initial=0.0)), 1.0)
    edges_u, edges_v = (size_px * np.arange(n + 1) - 0.5 for n in grid.shape[::-1])
    shown = axes.pcolormesh(edges_u, edges_v, grid, cmap="RdBu_r", vmin=-limit_mm, vmax=limit_mm)
    height_in = figure.get_size_inches()[1]
    place = figure.add_axes((0.25, 0.4 / height_in, 0.6, 0.1 / height_in))
    bar = figure.colorbar(shown, cax=place, orientation="horizontal")
    bar.set_label("behind the plane, mm")
    bar.outline.set_visible(False)
    return drawing(figure, "Residuals by place in the image")


def draw_corners(evidence: Evidence, lens: Intrinsics) -> Markup:
    """Draw the mean residual of the corners in each cell of the image as an arrow."""
    cells, means = _cell_means(
        evidence.corners_px, np.hstack([evidence.corners_px, evidence.corner_residuals_px]), lens
    )
    figure, axes = image_axes(lens)
    axes.plot(
        *evidence.corners_px[:: max(1, len(evidence.corners_px) // 1500)].T, ".", color=FAINT, markersize=1
    )
    if len(cells):
        usual_px = max(float(np.percentile(np.linalg.norm(means[:, 2:], axis=1), 90)), 1e-3)
        scale = usual_px / (lens.width_px / _CELLS)
        arrows = axes.quiver(
            *means.T, color=BLUE, angles="xy", scale_units="xy", scale=scale, width=0.004, zorder=3
        )
        axes.quiverkey(arrows, 0.92, 1.05, usual_px, f"{usual_px:.2g} px ", labelpos="W", labelcolor=INK)
    return drawing(figure, "Residuals of the corners in the image")


def _cell_means(pixels: Array, values: Array, lens: Intrinsics) -> tuple[Array, Array]:
    """Average values (N, K) over square cells of the image: cells (M, 2) by column and row, means (M, K)."""
    at = np.floor((pixels + 0.5) * _CELLS / lens.width_px)
    cells, index, counts = np.unique(at, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(cells), values.shape[1]))
    np.add.at(sums, index.ravel(), values)
    is_full = counts >= _MIN_IN_CELL
    return cells[is_full], (sums / counts[:, None])[is_full]
