"""The jackknife covariance against sampling, and its steps against estimates made without a group."""

import numpy as np

from lce_rig.calibrate.quadratics import Quadratics, jackknife_scatter, symmetric_inverse


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
        cost = Quadratics(gradients, hessians, np.zeros((3, 3)), np.zeros(3), np.arange(n_groups))
        covariances.append(cost.jackknife_covariance())
    return np.array(errors), np.array(covariances)


def test_quadratics_grouped_nees_is_near_3():
    errors, covariances = sample_regressions(n_groups=25, n_trials=800)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    assert 2.3 < nees.mean() < 3.5  # 3 expected


def test_few_groups_covariance_is_not_too_small():
    errors, covariances = sample_regressions(n_groups=7, n_trials=800)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    assert np.median(nees) < 2.37  # the median of chi square with 3 degrees


def test_leave_one_out_shifts_match_refits():
    rng = np.random.default_rng(1)
    group = np.array([0, 0, 1, 2, 2, 2, 3])
    A, b = rng.normal(size=(7, 5, 3)), rng.normal(size=(7, 5))

    def fit(is_used):
        return np.linalg.lstsq(A[is_used].reshape(-1, 3), b[is_used].ravel())[0]

    estimate = fit(group >= 0)
    gradients = np.einsum("fni,fn->fi", A, A @ estimate - b)
    hessians = np.swapaxes(A, 1, 2) @ A
    cost = Quadratics(gradients, hessians, np.zeros((3, 3)), np.zeros(3), group)
    moves = cost.moves()
    anew = np.array([fit(group != k) for k in range(4)])
    np.testing.assert_allclose(estimate + moves, anew, atol=1e-12)
    expected = 3 / 4 * (anew - estimate).T @ (anew - estimate)
    np.testing.assert_allclose(jackknife_scatter(moves), expected, atol=1e-12)


def test_inverse_singular_variance_is_finite():
    inverse = symmetric_inverse(np.diag([4.0, 1.0, 0.0]))
    np.testing.assert_allclose(np.diag(inverse)[:2], [0.25, 1.0])
    assert 1e6 < inverse[2, 2] < np.inf
