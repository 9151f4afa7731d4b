"""The experiments of the LCE-Calib paper with every method, its published figures beside them."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baselines import COMPARED, settings_of
from benchmarks.paper_plots import (
    frame_errors,
    in_order,
    label_of,
    level_rms,
    methods_of,
    plot_frames,
    plot_noise,
)
from benchmarks.paper_published import (
    ABLATION,
    LCE_CALIB,
    NOISE_DEG,
    NOISE_MGE_MM,
    NOISE_MM,
    NOISE_NORMAL_DEG,
    RECORDED,
)
from benchmarks.paper_recorded import Recording, errors_by_frames, open_recordings
from benchmarks.paper_runs import MIDDLE_LEVEL, Run, measure, simulated_runs
from benchmarks.paper_sets import LEVELS, N_CAPTURES, paper_set
from benchmarks.tables import print_head, print_row, rms
from lce_rig.calibrate import Algorithm1Parts, EstimateSettings
from lce_rig.calibrate.features import FeatureSettings
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.simulate.options import PAPER_RANGE_SIGMA_M


def _changed(**parts: Any) -> EstimateSettings:
    """Change parts of Algorithm 1; draws cost time and judge the solution, but do not change it."""
    return EstimateSettings("paper", n_draws=0, parts=Algorithm1Parts(**parts))


# The paper's switches by the names of its table III, then ours.
_VARIANTS: dict[str, EstimateSettings] = {
    "full (I = 100)": EstimateSettings("paper", n_draws=100),
    "without point projection": _changed(features=FeatureSettings(point_projection="none")),
    "without uncertainty model": _changed(use_uncertainty=False),
    "without point-to-plane": _changed(use_planes=False),
    "without point-to-line": _changed(use_ends=False),
    "I = 1": EstimateSettings("paper", n_draws=1),
    "I = 5": EstimateSettings("paper", n_draws=5),
    "projection along the normal": _changed(features=FeatureSettings(point_projection="normal")),
    "without half step": _changed(features=FeatureSettings(half_step=False)),
    "without edge shift": _changed(is_shift_free=False),
    "without refusal of outliers": _changed(reject_outliers=False),
}


def bench_paper(n_seeds: int, folder: Path, anew: Sequence[str] = (), only: str = "") -> None:
    """Run the experiments, print tables and draw figures.

    Args:
        n_seeds: simulated sets.
        folder: detections and results of simulated sets are kept in it, figures are written to it.
        anew: methods that have changed since their results were kept.
        only: "simulated" for simulated sets only, else recorded sets whose name contains this.
    """
    if only in ("", "simulated"):
        _bench_simulated(n_seeds, folder, anew)
    if only != "simulated" and os.environ.get("LCE_RIG_DATA"):
        _bench_recorded(open_recordings(folder, only), folder, anew or in_order(COMPARED))


def _bench_simulated(n_seeds: int, folder: Path, anew: Sequence[str]) -> None:
    runs = simulated_runs(folder, n_seeds, COMPARED, anew)
    normals_deg = _normals_deg(folder, n_seeds)
    _print_noise(runs, normals_deg)
    _print_frames(runs)
    plot_noise(folder / "paper_noise", runs, normals_deg)
    title = f"simulated, noise {100 * PAPER_RANGE_SIGMA_M[MIDDLE_LEVEL - 1]:.1f} cm: rms"
    plot_frames(folder / "paper_frames", {title: frame_errors(runs)})
    print(f"\nAblation of Algorithm 1, simulated at level {MIDDLE_LEVEL}: deg / mm, rms over sets\n")
    print_head("", "error")
    sets = [paper_set(folder / "sets", seed) for seed in range(n_seeds)]
    for variant, options in _VARIANTS.items():
        own = [measure(seen, variant, MIDDLE_LEVEL, k, N_CAPTURES, options) for k, seen in enumerate(sets)]
        deg, mm = (rms(np.array([getattr(run, name) for run in own])) for name in ("deg", "mm"))
        print_row(variant, f"{deg:.3f} / {mm:.2f}")


def _bench_recorded(recordings: Sequence[Recording], folder: Path, methods: Sequence[str]) -> None:
    still = [recording for recording in recordings if recording.name.startswith("rlfs")]
    for kind in ("rlfs", "rles"):
        _print_recorded([recording for recording in recordings if recording.name.startswith(kind)], methods)
    if still and "paper" in methods:
        _print_ablation(still)
    by_frames = {}
    for recording in still:
        n_all = len(recording.candidates())
        counts = [*range(6, n_all, 2), n_all]
        by_frames[f"{recording.name}: median EGT"] = counts, errors_by_frames(recording, counts, methods)
    if by_frames:
        plot_frames(folder / "paper_frames_recorded", by_frames)


def _normals_deg(folder: Path, n_seeds: int) -> dict[int, float]:
    """Average the errors of the LiDAR's normals by level."""
    errors: dict[int, list[float]] = {level: [] for level in LEVELS}
    for seed in range(n_seeds):
        for placement in paper_set(folder / "sets", seed).placements:
            for level in LEVELS:
                errors[level].append(placement.normal_error_deg(level))
    return {level: float(np.nanmean(own)) for level, own in errors.items()}


def _print_noise(runs: Sequence[Run], normals_deg: dict[int, float]) -> None:
    seeds = len({run.seed for run in runs})
    levels = [f"{100 * PAPER_RANGE_SIGMA_M[level - 1]:.1f} cm" for level in LEVELS]
    print(f"\nSimulated sets, {seeds} of {N_CAPTURES} frames at each level; rms over sets\n")
    print_head("", *levels)
    for name, what, digits, published in (
        ("deg", "rotation deg", 3, NOISE_DEG),
        ("mm", "translation mm", 2, NOISE_MM),
        ("paper_mge_mm", "MGE mm, as the paper counts", 1, NOISE_MGE_MM),
        ("mge_mm", "MGE mm", 1, {}),
    ):
        for method in methods_of(runs):
            values = [level_rms(runs, method, level, name) for level in LEVELS]
            print_row(f"{what}, {label_of(method)}", *(f"{value:.{digits}f}" for value in values))
        for source, figures in published.items():
            print_row(f"{what}, {source}", *(f"{figure:.{digits}f}" for figure in figures))
    print_row("normals deg, ours", *(f"{normals_deg[level]:.2f}" for level in LEVELS))
    for source, figures in NOISE_NORMAL_DEG.items():
        print_row(f"normals deg, {source}", *(f"{figure:.2f}" for figure in figures))


def _print_frames(runs: Sequence[Run]) -> None:
    counts, errors = frame_errors(runs)
    print(f"\nErrors against the number of frames at level {MIDDLE_LEVEL}, deg / mm, rms over sets\n")
    print_head("", *map(str, counts))
    for method, values in errors.items():
        print_row(label_of(method), *(f"{deg:.3f} / {mm:.2f}" for deg, mm in values))


def _print_recorded(recordings: Sequence[Recording], methods: Sequence[str]) -> None:
    if not recordings:
        return
    print("\nRecorded sets against their references\n")
    print_head("set", "method", "EGT deg", "EGT mm", "MGE mm", "MGE mm, as the paper counts", "detected")
    for recording in recordings:
        choices = [(channel,) for channel in recording.channels]
        if len(choices) > 1:
            choices.append(recording.channels)
        for channels in choices:
            name = recording.name if len(choices) == 1 else f"{recording.name} {' + '.join(channels)}"
            found = " + ".join(recording.count_found(channel) for channel in channels)
            for method in methods:
                cells = _cells(recording, channels, settings_of(method))
                print_row(name, label_of(method), *cells, found)
            published = RECORDED.get((recording.name, channels[0]), {}) if len(channels) == 1 else {}
            for source, run in published.items():
                print_row(
                    name,
                    source,
                    f"{run.deg:.3f}",
                    f"{1000 * run.m:.0f}",
                    "",
                    f"{1000 * run.mge_m:.0f}",
                    run.detected,
                )


def _cells(recording: Recording, channels: Sequence[str], options: EstimateSettings) -> list[str]:
    try:
        deg, mm, mge_mm, paper_mm = recording.errors(recording.estimate(channels, options))
    except NotEnoughDataError as error:
        return [f"refused: {error.what}", "", "", ""]
    return [f"{deg:.3f}", f"{mm:.1f}", f"{mge_mm:.1f}", f"{paper_mm:.1f}"]


def _print_ablation(recordings: Sequence[Recording]) -> None:
    names = [recording.name for recording in recordings]
    print("\nAblation of Algorithm 1 on recorded sets: EGT, deg / mm\n")
    print_head("", *names, *(f"{name}, {LCE_CALIB}" for name in names))
    for variant, options in _VARIANTS.items():
        cells = []
        for recording in recordings:
            deg, mm, *_ = _cells(recording, ("frames",), options)
            cells.append(f"{deg} / {mm}")
        for name in names:
            row = ("rlfs01", "rlfs02", "rlfs03").index(name)
            figures = ABLATION[variant][row] if variant in ABLATION else None
            cells.append("" if figures is None else f"{figures[0]:.3f} / {1000 * figures[1]:.0f}")
        print_row(variant, *cells)
