"""The paper's experiments: what is kept is read back, and errors are counted as the paper does."""

from dataclasses import replace

import numpy as np
from benchmarks.paper_plots import level_rms
from benchmarks.paper_published import RECORDED
from benchmarks.paper_runs import Run, paper_mge_m, read_runs, write_runs

from lce_rig.calibrate.consensus import find_consensus
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, simulate


def test_kept_runs_are_read_back_with_refusals(tmp_path):
    nan = float("nan")
    runs = [Run("paper", 5, 30, 0, 0.1, 2.0, 20.0, 3.0), Run("zhou", 10, 6, 3, nan, nan, nan, nan)]
    assert read_runs(tmp_path / "runs.csv") == []
    write_runs(tmp_path / "runs.csv", runs)
    assert repr(read_runs(tmp_path / "runs.csv")) == repr(runs)


def test_errors_are_summed_over_the_seeds_of_one_method_level_and_number_of_frames():
    run = Run("paper", 5, 30, 0, 3.0, 0.0, 0.0, 0.0)
    others = [replace(run, method="zhou"), replace(run, level=4), replace(run, n_captures=6)]
    runs = [run, replace(run, seed=1, deg=4.0), *(replace(other, deg=100.0) for other in others)]
    assert np.isclose(level_rms(runs, "paper", 5, "deg"), np.sqrt(12.5))
    assert np.isnan(level_rms(runs, "corners", 5, "deg"))


def test_range_noise_is_no_part_of_the_papers_error_and_edges_count_half():
    def errors_mm(range_sigma_m):
        seen = find_consensus(simulate(10, 0, Scenario(range_sigma_m=range_sigma_m, step_deg=0.4)), BOARD)
        return 1e3 * paper_mge_m(T_FORWARD, seen.observations, BOARD)

    # Ring ends lie between nothing and one step of 0.4 deg inside the border, 9 mm on average at 2.5 m.
    assert 3.0 < errors_mm(0.001) < 6.5
    # Noise of 3 cm shifts planes by little: 24 mm would be its mean distance from them.
    assert errors_mm(0.03) < 14.0


def test_published_figures_are_in_metres():
    assert all(0 < run.m < 0.1 and 0 < run.mge_m < 0.1 for rows in RECORDED.values() for run in rows.values())
