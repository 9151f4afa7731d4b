"""Drawings of a fleet's report: robots that changed, in time; mountings beside the drawing."""

from typing import Any

import numpy as np
from markupsafe import Markup

from lce_rig.core.geometry import Array, difference
from lce_rig.fleet.changes import Sessions, references, rescaled
from lce_rig.fleet.history import Change, History
from lce_rig.fleet.siblings import Mounting
from lce_rig.fleet.table import covariances, poses
from lce_rig.scene.alignment import AXES, IS_ROTATION
from lce_rig.show.report.drawing import BLUE, FAINT, ORANGE, QUIET, RED, WIDTH_IN, drawing, new_axes, style
from lce_rig.words.extrinsics import motion_words

MATRICES = ("T_cam_lidar", "cov", "cov_shared")
"""Columns of the table that drawings in time require."""

_HEIGHT_IN = 3.05
_MOST_SESSIONS = 400


def in_time(history: History, table: Any, change: Change) -> Markup:
    """Draw each session of a camera and LiDAR along the axis that changed most, with its cumulative sum
    over all sessions.

    Bars are two standard deviations of what scatters between sessions, as measured over the fleet.
    """
    import pyarrow as pa

    axis = AXES.index(change.found.axes[0].axis)
    first, last = history.starts[change.series], history.starts[change.series + 1]
    # Long series: the sessions about the change.
    at = int(first) + change.found.session
    shown = np.arange(max(int(first), at - _MOST_SESSIONS // 2), min(int(last), at + _MOST_SESSIONS // 2))
    rows = table.select(MATRICES).take(pa.array(history.rows[shown]))
    T, cov = poses(rows["T_cam_lidar"]), covariances(rows["cov"])
    if not rows["cov_shared"].null_count:
        cov = cov - covariances(rows["cov_shared"])
    unit = float(np.degrees(1.0)) if IS_ROTATION[axis] else 1e3
    values = unit * difference(T, np.broadcast_to(T[0], T.shape))[:, axis]
    sigma = unit * history.scale[axis] * np.sqrt(np.maximum(cov[:, axis, axis], 0.0))
    cusum = _cusum(difference(T, np.broadcast_to(T[0], T.shape)), cov, history)[:, axis]
    days = _days([history.dates[int(k)].as_py() for k in shown])
    with style():
        figure, (upper,) = new_axes(_HEIGHT_IN, left_in=0.62, bottom_in=1.3, top_in=0.08)
        left_in, width_in = 0.62, WIDTH_IN - 0.62 - 0.1
        place = (left_in / WIDTH_IN, 0.4 / _HEIGHT_IN, width_in / WIDTH_IN, 0.8 / _HEIGHT_IN)
        lower = figure.add_axes(place, sharex=upper)
        upper.tick_params(labelbottom=False)
        upper.errorbar(days, values, 2 * sigma, fmt="o", ms=3, lw=0.8, color=BLUE, ecolor=FAINT)
        if change.found.kind == "odd":
            odd = at - shown[0]
            upper.plot(days[odd], values[odd], "o", ms=6, mfc="none", mec=RED)
        else:
            _mark(upper, days, change)
        upper.set_ylabel("deg" if IS_ROTATION[axis] else "mm")
        upper.grid(axis="y")
        lower.plot(days, cusum, color=ORANGE, lw=1)
        lower.axhline(0, color=FAINT, lw=0.6)
        if np.abs(cusum).max() > history.limits.cusum:
            lower.axhline(np.sign(cusum[-1]) * history.limits.cusum, color=QUIET, lw=0.8, ls="--")
        lower.set_ylabel("sum")
        _dates(lower)
        return drawing(figure, f"{change.robot} {change.camera} {change.lidar}: {motion_words(AXES[axis])}")


def _cusum(tangents: Array, cov: Array, history: History) -> Array:
    """Compute cumulative sums (N, 6) that do not begin anew where something changed."""
    n = len(tangents)
    none = np.zeros(n, np.intp)
    one = Sessions(np.array([0, n]), tangents, cov, np.zeros_like(cov), none, np.zeros(n))
    one = rescaled(one, history.scale)
    return references(one, one.starts, np.ones(n, bool), history.limits).cusum


def _mark(axes: Any, days: Array, change: Change) -> None:
    before, after = _days([change.before, change.after])
    if change.found.kind == "step":
        axes.axvspan(before, after, color=RED, alpha=0.25, lw=0)


def _days(dates: list[str]) -> Any:
    return np.array([each.removesuffix("Z") for each in dates], dtype="datetime64[s]")


def _dates(axes: Any) -> None:
    from matplotlib import dates

    module: Any = dates
    locator = module.AutoDateLocator(maxticks=6)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(module.ConciseDateFormatter(locator))


def beside_siblings(mounting: Mounting) -> Markup:
    """Draw each robot's deviation from its siblings' median by axis, in standard deviations."""
    z = np.clip(mounting.z, -12, 12)
    rng = np.random.default_rng(0)
    with style():
        figure, (axes,) = new_axes(2.4, left_in=0.6, top_in=0.08)
        for k in range(6):
            beyond = np.abs(mounting.z[:, k]) > mounting.limit
            height = k + 0.5 * (rng.random(len(z)) - 0.5)
            # Thousands of points would be most of the page.
            few = np.flatnonzero(~beyond)[:: max(1, len(z) // 300)]
            axes.plot(z[few, k], height[few], ".", ms=3, color=BLUE, alpha=0.5, mew=0)
            axes.plot(z[beyond, k], height[beyond], "o", ms=5, mfc="none", mec=RED)
        if np.isfinite(mounting.limit):
            for sign in (-1, 1):
                axes.axvline(sign * mounting.limit, color=QUIET, lw=0.8, ls="--")
        axes.set_yticks(
            range(6), [f"{'turn' if IS_ROTATION[k] else 'shift'} {AXES[k][-1]}" for k in range(6)]
        )
        axes.invert_yaxis()
        axes.set_xlabel("standard deviations from the siblings' median")
        return drawing(figure, f"{mounting.rig} {mounting.camera} {mounting.lidar} beside siblings")
