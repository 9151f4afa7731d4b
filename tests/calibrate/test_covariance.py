"""Errors that all groups share, and inverses of what is not quite invertible."""

import numpy as np

from lce_rig.calibrate.quadratics import symmetric_inverse
from lce_rig.calibrate.systematic import systematic_covariances


def test_a_direction_without_information_gets_a_large_finite_variance():
    inverse = symmetric_inverse(np.diag([4.0, 1.0, 0.0]))
    np.testing.assert_allclose(np.diag(inverse)[:2], [0.25, 1.0])
    assert 1e6 < inverse[2, 2] < np.inf


def test_shared_errors_scatter_the_estimate_as_their_covariance_says():
    rng = np.random.default_rng(3)
    sensitivities = rng.normal(size=(3, 5))
    own = 0.2 * rng.normal(size=(100_000, 5))
    sources = own - own.mean(axis=1, keepdims=True) + 0.3 * rng.normal(size=(100_000, 1))
    sampled = np.cov(sources @ sensitivities.T, rowvar=False)
    expected = sum(systematic_covariances(sensitivities, 0.2, 0.3))
    np.testing.assert_allclose(sampled, expected, atol=0.02 * np.trace(expected))
