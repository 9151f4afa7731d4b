"""A LiDAR's constant errors from sessions with extrinsics of their own."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.lidar_errors import WIDENED, estimate_lidar
from lce_rig.calibrate.likelihood.fit import maximise_likelihood
from lce_rig.calibrate.likelihood.levels import Levels, Priors
from lce_rig.core.geometry import difference, exp_so3, pose
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, simulate

BIASED = Scenario(laser_bias_sigma_m=0.008, footprint_m=0.003)
OPTIONS = EstimateSettings(laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005)
T_MOVED = pose(exp_so3(np.array([0.03, -0.05, 0.02])), np.array([0.05, 0.02, -0.03])) @ T_FORWARD


def true_ranges(seed):
    """Range errors of the simulated lasers about their mean, by ring."""
    bias = BIASED.laser_bias_sigma_m * np.random.default_rng([seed, 1]).standard_normal(16)
    return bias - bias.mean()


def observations(seed, part, T):
    found = find_consensus(simulate(24, seed, BIASED, T)[part], BOARD)
    return list(found.observations)


def measured(seed):
    """Two sessions of one LiDAR, between which it was remounted."""
    sessions = [observations(seed, slice(0, 8), T_FORWARD), observations(seed, slice(8, 16), T_MOVED)]
    return estimate_lidar(sessions, BOARD, [T_FORWARD, T_MOVED], OPTIONS)


def normalised(errors, seed):
    """Errors of the estimated ranges about their mean, in their standard deviations."""
    known = errors.found
    truth = true_ranges(seed)[known.rings]
    off = known.lasers[0] - known.lasers[0].mean() - (truth - truth.mean())
    return off / known.lasers_sigma[0]


@pytest.mark.long
def test_lidar_errors_match_deviations():
    errors = measured(3)
    assert errors.n_captures == (8, 8)
    assert errors.gain[0] > 2
    assert 0.2 < np.mean(normalised(errors, 3) ** 2) < 2.2
    for angle in (1, 2):
        assert np.abs(errors.found.lasers[angle] / errors.found.lasers_sigma[angle]).max() < 4


@pytest.mark.long
def test_known_laser_errors_sharpen_estimate():
    known = measured(3).found
    later = observations(3, slice(16, 24), T_FORWARD)
    plain, helped = (
        maximise_likelihood([later], BOARD, [T_FORWARD], Priors(known=k), replace(Levels(), laser_m=0.008))
        for k in (None, known)
    )
    sizes = [np.sqrt(np.trace(joint.cov[0][:3, :3])) for joint in (plain, helped)]
    assert sizes[1] < 0.97 * sizes[0]
    off = difference(helped.T_cam_lidar[0], T_FORWARD)
    assert off @ np.linalg.solve(helped.cov[0], off) < 22.5
    ranges = [
        joint.state.lasers[0] - joint.state.lasers[0].mean() - true_ranges(3)[joint.terms.scans.rings]
        for joint in (plain, helped)
    ]
    assert np.std(ranges[1]) < np.std(ranges[0])


@pytest.mark.slow
def test_lidar_errors_deviations_fit_scatter():
    squares = [np.mean((WIDENED[0] * normalised(measured(seed), seed)) ** 2) for seed in range(20)]
    # Simulated images lack the pose errors of recorded ones, which the noise levels' priors expect.
    assert 0.6 < np.mean(squares) < 1.25
