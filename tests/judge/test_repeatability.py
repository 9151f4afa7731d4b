"""Repeated calibrations: correct ones agree, and an outlier is reported with its difference."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.calibration import Calibration, Diagnostics
from lce_rig.core.geometry import exp_so3, perturb, pose
from lce_rig.judge.repeatability import compare_calibrations
from lce_rig.lens.difference import turn_of_lens
from tests.calibrate.boards import CAMERA
from tests.saved_results import made_calibration

TRUTH = pose(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([0.1, -0.06, -0.08]))
# Translation and rotation are correlated, as they are behind a rotation about far boards.
ROOT = np.diag([2e-3, 2e-3, 4e-3, 1e-3, 1e-3, 8e-4]) @ (np.eye(6) + 0.5 * np.eye(6, k=4))
COV = ROOT @ ROOT.T


def calibration(T, cov=COV, **diagnostics) -> Calibration:
    return made_calibration(T, cov, diagnostics=Diagnostics(**diagnostics))


def sessions(n, seed, factor=1.0, cov=COV):
    """Draw calibrations scattered by `factor` times their covariance."""
    rng = np.random.default_rng(seed)
    root = factor * np.linalg.cholesky(cov)
    return {f"day{k}": calibration(perturb(TRUTH, root @ rng.standard_normal(6)), cov) for k in range(n)}


def test_repeat_spread_matches_covariance():
    compared = [compare_calibrations(sessions(3, seed)) for seed in range(100)]
    chi2 = np.array([one.chi2 for one in compared])
    assert all(one.dof == 12 for one in compared)
    assert np.mean(chi2) == pytest.approx(12, abs=4 * np.sqrt(2 * 12 / 100))
    assert np.mean([one.p for one in compared]) == pytest.approx(0.5, abs=0.1)
    assert np.mean([one.agrees for one in compared]) > 0.96
    distances = np.array([[pair.distance**2 for pair in one.differences] for one in compared])
    assert np.mean(distances) == pytest.approx(6, rel=0.12)
    spread = np.mean([one.spread_translation_m**2 for one in compared])
    assert spread == pytest.approx(np.mean([one.reported_translation_m**2 for one in compared]), rel=0.15)


def test_repeat_lens_turn_is_no_difference():
    """Sessions with lenses of their own are compared as they draw points."""
    moved = replace(CAMERA, cx_px=CAMERA.cx_px + 4.0)
    turn = -turn_of_lens(CAMERA)[:, 2] * 4.0
    assert np.degrees(np.linalg.norm(turn)) > 0.2
    turned = perturb(TRUTH, np.append(np.zeros(3), turn))
    first, second = (
        replace(calibration(T), intrinsics=lens) for T, lens in ((TRUTH, CAMERA), (turned, moved))
    )
    assert compare_calibrations({"monday": first, "tuesday": second}).max_rotation_deg < 0.005
    same_lens = compare_calibrations({"monday": first, "tuesday": replace(second, intrinsics=CAMERA)})
    assert same_lens.max_rotation_deg == pytest.approx(np.degrees(np.linalg.norm(turn)), rel=1e-6)


def test_repeat_detects_optimistic_uncertainty():
    compared = compare_calibrations(sessions(4, 2, factor=4.0))
    assert not compared.agrees
    assert compared.ratio == pytest.approx(4, rel=0.4)
    assert compared.odd_one is None
    assert (compared.finding.code, compared.finding.action) == ("repeat.disagree", "")
    assert compared.finding.figure("ratio") == compared.ratio


def test_repeat_mean_ignores_the_order():
    """The mean is weighted by the covariances."""
    sure = calibration(perturb(TRUTH, np.full(6, 1e-3)), 1e-4 * COV)
    rough = calibration(perturb(TRUTH, np.full(6, -1e-3)), COV)
    compared = compare_calibrations({"sure": sure, "rough": rough})
    assert np.allclose(compared.T_cam_lidar, TRUTH, atol=1e-5)
    assert np.allclose(compared.deviations, [np.full(6, 1e-3), np.full(6, -1e-3)], atol=1e-5)
    swapped = compare_calibrations({"rough": rough, "sure": sure})
    assert swapped.chi2 == pytest.approx(compared.chi2, rel=1e-6)
    assert np.allclose(swapped.T_cam_lidar, compared.T_cam_lidar, atol=1e-9)


@pytest.mark.parametrize("correlation", [-1.0, 0.0, 0.7])
def test_repeat_same_captures_mostly_agree(correlation):
    """For any correlation of the two results."""
    root = np.linalg.cholesky(COV)
    rng = np.random.default_rng(5)
    n_refused = 0
    for _ in range(300):
        one, own = rng.standard_normal((2, 6))
        other = correlation * one + np.sqrt(1 - correlation**2) * own
        group = {
            name: calibration(perturb(TRUTH, root @ noise)) for name, noise in (("a", one), ("b", other))
        }
        compared = compare_calibrations(group, are_independent=False)
        n_refused += not compared.agrees
    # Errors of opposite sign reach the bound in 1 % of cases; allow 3 sigma of the count.
    assert n_refused <= 3 + 3 * np.sqrt(3)
