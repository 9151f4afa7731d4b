"""The jackknife covariance against sampling."""

import numpy as np

from lce_rig.solvers.covariance import jackknife_covariance, symmetric_inverse, systematic_covariance


def sample_regressions(n_groups, n_trials, seed=0):
    """Fit lines of 3 coefficients to groups whose residuals share one error: errors and covariances."""
    rng = np.random.default_rng(seed)
    design = rng.normal(size=(n_groups, 10, 3))
    errors, covariances = [], []
    for _ in range(n_trials):
        noise = rng.normal(size=(n_groups, 1)) + 0.1 * rng.normal(size=(n_groups, 10))
        hessians = design.swapaxes(1, 2) @ design
        right = (design.swapaxes(1, 2) @ noise[..., None])[..., 0]
        estimate = np.linalg.solve(hessians.sum(axis=0), right.sum(axis=0))
        gradients = (design.swapaxes(1, 2) @ (design @ estimate - noise)[..., None])[..., 0]
        errors.append(estimate)
        covariances.append(jackknife_covariance(gradients, hessians, np.zeros((3, 3))))
    return np.array(errors), np.array(covariances)


def test_normalised_errors_have_the_right_size_although_residuals_of_a_group_share_their_error():
    errors, covariances = sample_regressions(n_groups=25, n_trials=800)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    assert 2.3 < nees.mean() < 3.5  # 3 expected


def test_few_groups_are_not_trusted_too_far():
    errors, covariances = sample_regressions(n_groups=7, n_trials=800)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    assert np.median(nees) < 2.37  # the median of chi square with 3 degrees


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
    expected = systematic_covariance(sensitivities, 0.2, 0.3)
    np.testing.assert_allclose(sampled, expected, atol=0.02 * np.trace(expected))
