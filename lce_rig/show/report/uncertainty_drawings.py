"""The covariance of a result: its ellipsoids, its effect by distance, and its causes."""

from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np
from markupsafe import Markup

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.judge.findings import cause_words
from lce_rig.judge.reach import point_uncertainties
from lce_rig.show.report.drawing import BLUE, INK, ORANGE, drawing, new_axes

_DISTANCES_M = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0)
# Causes of less than this, in percent, are in the table only.
_LEAST_SHARE = 0.5
_CIRCLE = np.stack([np.cos(np.linspace(0, 2 * np.pi, 73)), np.sin(np.linspace(0, 2 * np.pi, 73))])
# From behind, from above, from the side: what a view shows to the right and vertically, axes of the camera.
_VIEWS = ((0, 1), (0, 2), (2, 1))
_AXES = ("x right", "y down", "z forward")


def principal_axes(cov: Array) -> tuple[Array, Array]:
    """Find the standard deviations (3,) along the principal axes (3, 3), columns, the largest first."""
    variances, directions = np.linalg.eigh(cov)
    order = np.argsort(variances)[::-1]
    directions = directions[:, order]
    # Eigenvectors have no sign of their own.
    largest = np.abs(directions).argmax(axis=0)
    directions = directions * np.sign(directions[largest, range(3)])
    return np.sqrt(np.maximum(variances[order], 0)), directions


def draw_ellipsoid(cov: Array, unit: str, label: str) -> Markup:
    """Draw a covariance (3, 3) from three sides: 1 and 2 standard deviations, and its principal axes."""
    sigmas, directions = principal_axes(cov)
    limit = 2.3 * float(np.sqrt(np.diag(cov).max()))
    figure, row = new_axes(1.65, 3, between_in=0.42)
    for axes, (right, down) in zip(row, _VIEWS, strict=True):
        shape = np.linalg.cholesky(cov[np.ix_([right, down], [right, down])] + 1e-12 * limit**2 * np.eye(2))
        for n_sigmas, width in ((1, 1.4), (2, 0.7)):
            axes.plot(*(n_sigmas * shape @ _CIRCLE), color=BLUE, linewidth=width)
        for sigma, direction in zip(sigmas, directions.T, strict=True):
            end = sigma * direction[[right, down]]
            axes.plot(*np.stack([-end, end]).T, color=ORANGE, linewidth=1)
        axes.set_xlim(-limit, limit)
        axes.set_ylim(limit if down == 1 else -limit, -limit if down == 1 else limit)
        axes.set_aspect("equal")
        axes.set_xlabel(f"{_AXES[right]}, {unit}")
        axes.set_title(f"{_AXES[down]}, {unit}")
        axes.locator_params(nbins=3)
    return drawing(figure, label)


def draw_by_distance(calibration: Calibration, lens: Intrinsics) -> Markup:
    """Draw the expected error of a LiDAR point in pixels and in centimetres by its distance."""
    points = point_uncertainties(calibration.T_cam_lidar, calibration.cov, lens, _DISTANCES_M)
    figure, (left, right) = new_axes(2.1, 2)
    _draw_reach(left, [p.centre_px for p in points], [p.corner_px for p in points], "error in the image, px")
    _draw_reach(
        right, [100 * p.centre_m for p in points], [100 * p.corner_m for p in points], "error in space, cm"
    )
    left.legend(loc="best", handlelength=1.2)
    return drawing(figure, "Error of a LiDAR point by its distance")


def _draw_reach(axes: Any, centre: Sequence[float], corner: Sequence[float], title: str) -> None:
    axes.plot(_DISTANCES_M, centre, color=BLUE, label="in the middle")
    axes.plot(_DISTANCES_M, corner, color=ORANGE, label="in the worst corner")
    axes.set_xlabel("distance, m")
    axes.set_title(title)
    axes.set_xlim(0, _DISTANCES_M[-1])
    axes.set_ylim(0, 1.1 * max(*centre, *corner))
    axes.grid()


def draw_causes(calibration: Calibration) -> Markup:
    """Draw what share of the variance each cause has, in rotation and in translation."""
    given = calibration.contributions
    squares = np.array([[c.sigma_rotation_deg, c.sigma_translation_m] for c in given]) ** 2
    shares = 100 * squares / np.maximum(squares.sum(axis=0), 1e-30)
    is_shown = shares.max(axis=1) >= _LEAST_SHARE
    shares = shares[is_shown]
    names = [
        cause_words(c.source).removeprefix("the ") for c, shown in zip(given, is_shown, strict=True) if shown
    ]
    at = np.arange(len(names))
    figure, (axes,) = new_axes(0.75 + 0.42 * len(names), left_in=2.0)
    axes.barh(at - 0.2, shares[:, 0], 0.38, color=BLUE, label="rotation")
    axes.barh(at + 0.2, shares[:, 1], 0.38, color=ORANGE, label="translation")
    axes.set_yticks(at, [fill(name, 28) for name in names], color=INK)
    axes.tick_params(axis="y", length=0)
    axes.invert_yaxis()
    axes.set_xlabel("share of the variance, %")
    axes.grid(axis="x")
    axes.set_axisbelow(True)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0, handlelength=1.2)
    return drawing(figure, "Causes of the uncertainty")
