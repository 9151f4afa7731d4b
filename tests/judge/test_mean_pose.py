"""The pose about which others scatter, against its definition."""

import numpy as np

from lce_rig.core.geometry import difference, perturb
from lce_rig.judge.relative_pose import mean_pose
from tests.calibrate.boards import T_FORWARD

RNG = np.random.default_rng(0)
FACTORS = RNG.normal(size=(12, 6, 6)) * [1, 1, 1, 5, 5, 5]
INFORMATION = np.swapaxes(FACTORS, 1, 2) @ FACTORS


def scattered(size=0.01):
    return perturb(np.broadcast_to(T_FORWARD, (12, 4, 4)), size * RNG.normal(size=(12, 6)))


def cost(T, mean):
    apart = difference(T, mean)
    return np.einsum("ki,kij,kj->", apart, INFORMATION, apart)


def test_no_pose_nearby_has_a_smaller_sum_of_squared_distances():
    T = scattered()
    mean, weights = mean_pose(T, INFORMATION)
    np.testing.assert_array_equal(weights, np.ones(12))
    for tangent in 1e-4 * np.concatenate([np.eye(6), -np.eye(6)]):
        assert cost(T, perturb(mean, tangent)) > cost(T, mean)


def test_a_pose_that_weighs_nothing_where_it_is_far_does_not_move_the_mean():
    T = scattered()
    T[3] = perturb(T[3], np.array([0.3, 0, 0, 0, 0.2, 0]))
    mean, weights = mean_pose(T, INFORMATION, T[0], lambda chi2: (chi2 < 1e-2 * chi2.max()).astype(float))
    assert weights[3] == 0
    others = np.arange(12) != 3
    expected, _ = mean_pose(T[others], INFORMATION[others] * weights[others, None, None])
    np.testing.assert_allclose(mean, expected, atol=1e-6)
