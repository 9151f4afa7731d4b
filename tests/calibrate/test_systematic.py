"""Range errors common to all captures: their effect on the solution, and on the covariance."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.core.geometry import difference, sigma_sizes
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, claim, simulate

NO_DRAWS = EstimateSettings("paper")
LASER_SIGMA_M, OFFSET_SIGMA_M = 0.008, 0.005


def normalised_errors(options, n_seeds):
    """e^T cov^-1 e (n,) of LiDARs whose lasers err by 8 mm about a mean that is off by 5 mm."""
    nees = []
    for seed in range(n_seeds):
        offset_m = OFFSET_SIGMA_M * np.random.default_rng([seed, 2]).standard_normal()
        scenario = Scenario(laser_bias_sigma_m=LASER_SIGMA_M, range_offset_m=offset_m)
        estimate = fit_extrinsic(simulate(20, seed, scenario), BOARD, options)
        error = difference(estimate.T_cam_lidar, T_FORWARD)
        nees.append(error @ np.linalg.solve(claim(estimate), error))
    return np.array(nees)


@pytest.mark.long
@pytest.mark.parametrize("n_seeds", [12, pytest.param(40, marks=pytest.mark.slow)])
def test_known_range_errors_are_in_covariance(n_seeds):
    nees = normalised_errors(
        replace(NO_DRAWS, laser_bias_sigma_m=LASER_SIGMA_M, range_offset_sigma_m=OFFSET_SIGMA_M), n_seeds
    )
    # At most 6 expected: the difference from the likelihood's estimate counts in full. The mean of 40 samples
    # is good to 0.55, of 12 to 1.0.
    assert 1.5 < nees.mean() < 7.5


def test_range_offset_is_in_the_covariance():
    options = replace(NO_DRAWS, range_offset_sigma_m=0.02)
    estimate = fit_extrinsic(simulate(20, 3, Scenario(range_offset_m=0.02)), BOARD, options)
    error = difference(estimate.T_cam_lidar, T_FORWARD)
    assert 0.01 < np.linalg.norm(error[:3]) < 0.03
    assert 0.01 < sigma_sizes(claim(estimate))[1] < 0.03
    assert error @ np.linalg.solve(claim(estimate), error) < 16.8  # 99 % of chi square with 6 degrees


def test_algorithm_1_covers_likelihood():
    captures = simulate(20, 3, Scenario(range_offset_m=0.02))
    paper, likely = (fit_extrinsic(captures, BOARD, EstimateSettings(method)) for method in ("paper", "ml"))
    (apart,) = (each for each in paper.sensitivities if each.source == "algorithm_1")
    np.testing.assert_allclose(apart.moves[0], difference(paper.T_cam_lidar, likely.T_cam_lidar))
    np.testing.assert_array_equal(paper.cov, likely.cov)
    assert not [each for each in likely.sensitivities if each.source == "algorithm_1"]
