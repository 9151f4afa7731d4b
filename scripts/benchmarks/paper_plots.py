"""The figures of the paper's experiments, as PNG for documents and PDF for papers."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.baselines import COMPARED
from benchmarks.paper_published import (
    CORNERS,
    LCE_CALIB,
    NOISE_DEG,
    NOISE_MGE_MM,
    NOISE_MM,
    NOISE_NORMAL_DEG,
    ZHOU_MATLAB,
)
from benchmarks.paper_runs import FRAME_COUNTS, MIDDLE_LEVEL, Run
from benchmarks.paper_sets import LEVELS, N_CAPTURES
from benchmarks.tables import rms
from lce_rig.core.geometry import Array
from lce_rig.simulate.options import PAPER_RANGE_SIGMA_M

# Colours that the colour-blind tell apart (Okabe, Ito, 2008); published figures are grey.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_MARKERS = ("o", "s", "^", "D", "v", "P")
LABELS = {
    "paper": "Algorithm 1",
    "zhou": "lines and planes (Zhou 2018)",
    "corners": "corner to corner",
    "ml": "maximum likelihood",
}
_LINE: dict[str, Any] = {"linewidth": 1.4, "markersize": 4.0}
_PUBLISHED: dict[str, dict[str, Any]] = {
    LCE_CALIB: {"color": "0.3", "linestyle": "--"},
    ZHOU_MATLAB: {"color": "0.6", "linestyle": ":"},
    CORNERS: {"color": "0.6", "linestyle": "-."},
}
# Numbers of frames; and by method (n, 2) errors in deg and mm.
FrameErrors = tuple[Sequence[int], dict[str, Array]]
_NOISE_CM = 100 * np.array(PAPER_RANGE_SIGMA_M)


def plot_noise(path: Path, runs: Sequence[Run], normals_deg: Mapping[int, float]) -> None:
    """Draw errors against the level of noise: rotation, translation, MGE and normals.

    Args:
        path: without suffix.
        runs: of all methods, levels and seeds.
        normals_deg: by level, mean error of the LiDAR's normals.
    """
    figure = Figure(figsize=(7.2, 5.8), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    panels = (
        ("deg", "rotation error [deg]", NOISE_DEG),
        ("mm", "translation error [mm]", NOISE_MM),
        ("paper_mge_mm", "MGE, as the paper counts it [mm]", NOISE_MGE_MM),
        ("", "error of the LiDAR's normals [deg]", NOISE_NORMAL_DEG),
    )
    for panel, (name, title, published) in zip(axes.flat, panels, strict=True):
        for source, values in published.items():
            panel.plot(_NOISE_CM, values, label=source, linewidth=1.2, **_PUBLISHED[source])
        if name:
            for method in methods_of(runs):
                values = [level_rms(runs, method, level, name) for level in LEVELS]
                panel.plot(_NOISE_CM, values, **_style(method))
        else:
            values = [normals_deg[level] for level in LEVELS]
            panel.plot(_NOISE_CM, values, "o-", color="black", **_LINE, label="ours: boards found in scans")
        panel.set_title(title, fontsize=9)
        _scale(panel)
    for panel in axes[1]:
        panel.set_xlabel("range noise [cm]")
    _finish(figure, path)


def plot_frames(path: Path, columns: Mapping[str, FrameErrors]) -> None:
    """Draw errors against the number of frames.

    Args:
        path: without suffix.
        columns: title -> what to draw side by side.
    """
    figure = Figure(figsize=(1.2 + 3.6 * len(columns), 4.8), layout="constrained")
    axes = figure.subplots(2, len(columns), squeeze=False)
    for panels, (title, (counts, errors)) in zip(axes.T, columns.items(), strict=True):
        panels[0].set_title(title, fontsize=9)
        for row, (panel, unit) in enumerate(zip(panels, ("rotation [deg]", "translation [mm]"), strict=True)):
            for method, values in errors.items():
                panel.plot(counts, values[:, row], **_style(method))
            panel.set_ylabel(unit)
            _scale(panel)
        panels[1].set_xlabel("frames")
    _finish(figure, path)


def frame_errors(runs: Sequence[Run]) -> FrameErrors:
    """Compute rms errors at the middle level for each number of frames."""
    return FRAME_COUNTS, {
        method: np.array(
            [[level_rms(runs, method, MIDDLE_LEVEL, name, n) for name in ("deg", "mm")] for n in FRAME_COUNTS]
        )
        for method in methods_of(runs)
    }


def methods_of(runs: Sequence[Run]) -> list[str]:
    """Name the methods of runs in the order of `LABELS`, others after these."""
    return in_order({run.method for run in runs})


def in_order(methods: Iterable[str]) -> list[str]:
    """Sort names of methods as `LABELS` has them, others after these."""
    there = set(methods)
    return [name for name in LABELS if name in there] + sorted(there - set(LABELS))


def label_of(method: str) -> str:
    """Name a method as figures and tables do."""
    return f"ours: {LABELS.get(method, method)}"


def level_rms(
    runs: Sequence[Run], method: str, level: int, figure: str, n_captures: int = N_CAPTURES
) -> float:
    """Compute the rms over seeds of one figure; NaN where a seed was refused."""
    wanted = (method, level, n_captures)
    values = [getattr(run, figure) for run in runs if (run.method, run.level, run.n_captures) == wanted]
    return rms(np.array(values)) if values else float("nan")


def _style(method: str) -> dict[str, Any]:
    k = in_order(COMPARED).index(method)
    return {"marker": _MARKERS[k], "color": _COLOURS[k], "label": label_of(method), **_LINE}


def _scale(panel: Any) -> None:
    """Choose a logarithmic axis where the lines of a panel span a decade, else one from zero."""
    values = np.concatenate([line.get_ydata() for line in panel.lines])
    panel.grid(True, which="both", alpha=0.25, linewidth=0.5)
    if np.nanmax(values) < 10 * np.nanmin(values):
        panel.set_ylim(bottom=0)
        return
    panel.set_yscale("log")
    panel.yaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_minor_formatter(_few_ticks)
    panel.tick_params(axis="y", which="minor", labelsize=7)


def _few_ticks(value: float, _position: int) -> str:
    """Label 2 and 5 of each decade."""
    digit = round(value / 10 ** np.floor(np.log10(value) + 1e-9))
    return f"{value:g}" if digit in (2, 5) else ""


def _finish(figure: Figure, path: Path) -> None:
    """Put one legend under all panels, and write the figure as PNG and PDF."""
    entries: dict[str, Any] = {}
    for panel in figure.axes:
        handles, labels = panel.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    n_columns = int(figure.get_figwidth() / 2.4)
    figure.legend(
        entries.values(),
        entries.keys(),
        loc="outside lower center",
        ncols=n_columns,
        fontsize=8,
        frameon=False,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    for suffix in (".png", ".pdf"):
        figure.savefig(path.with_suffix(suffix), dpi=160)
