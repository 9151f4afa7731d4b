"""Covariance of an estimate: how its groups of residuals (captures) disagree, and what errors they share."""

import numpy as np

from lce_rig.core.geometry import Array

_RELATIVE_FLOOR = 1e-12


def jackknife_covariance(gradients: Array, hessians: Array, prior: Array) -> Array:
    """Compute the covariance of argmin sum_k f_k + prior from leave-one-out steps.

    The inverse of a covariance from few samples is too large: for normal errors in p unknowns it averages
    (F - 1) / (F - p - 2) times the true inverse (2). Multiplied by that factor, `jackknife_scatter` gives
    normalised errors e^T cov^-1 e of the right size; below p + 4 groups the factor is held at (F - 1) / 2.

    Args:
        gradients: (F, p) half the gradient of each group's cost at the minimum.
        hessians: (F, p, p) half the Hessian of each (Gauss-Newton).
        prior: (p, p).

    Returns:
        (p, p).
    """
    n_groups, p = gradients.shape
    correction = (n_groups - 1) / max(n_groups - p - 2, 2)  # equation (2)
    return np.asarray(correction * jackknife_scatter(gradients, hessians, prior))


def jackknife_scatter(gradients: Array, hessians: Array, prior: Array) -> Array:
    """Compute the scatter of argmin sum_k f_k + prior over leave-one-out steps.

    Leaving out group k moves the minimum by (H - H_k)^-1 g_k to first order, hence

        cov = (F - 1) / F sum_k (H - H_k)^-1 g_k g_k^T (H - H_k)^-1,   H = sum_k H_k + prior             (1)

    No model of the noise enters, and errors within a group may be correlated in any way; unlike s^2 H^-1,
    which takes every residual for independent, (1) sees what a whole group has in common. Dividing by H - H_k
    and not H corrects for the pull that each group has on its own residuals, which matters for few groups.

    Args:
        gradients: (F, p) half the gradient of each group's cost at the minimum.
        hessians: (F, p, p) half the Hessian of each (Gauss-Newton).
        prior: (p, p).

    Returns:
        (p, p), of rank F - 1 at most.

    References:
        MacKinnon, White, "Some heteroskedasticity-consistent covariance matrix estimators", J. Econometrics,
        1985; Bell, McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage
        samples", Survey Methodology, 2002 (CR3).
    """
    n_groups = len(gradients)
    remaining = hessians.sum(axis=0) + prior - hessians
    steps = -(symmetric_inverse(remaining) @ gradients[..., None])[..., 0]
    return np.asarray((n_groups - 1) / n_groups * steps.T @ steps)


def systematic_covariance(sensitivities: Array, sigma_each: float, sigma_common: float) -> Array:
    """Propagate errors that every group shares, and that no scatter between groups can show.

    Source r is off by e + e_r, with e the mean error of all L sources and e_r its own deviation from it, and
    moves the estimate by s_r for each unit. Independent deviations less their mean leave

        cov = sigma_each^2 sum_r (s_r - s) (s_r - s)^T + sigma_common^2 L^2 s s^T,   s = sum_r s_r / L

    Args:
        sensitivities: (p, L) s_r in columns.
        sigma_each: standard deviation of e_r, before their mean is taken off.
        sigma_common: standard deviation of e.

    Returns:
        (p, p).
    """
    common = sensitivities.sum(axis=1)
    each = sensitivities - sensitivities.mean(axis=1, keepdims=True)
    return np.asarray(sigma_each**2 * each @ each.T + sigma_common**2 * np.outer(common, common))


def symmetric_inverse(H: Array) -> Array:
    """Invert symmetric positive semi-definite H (..., p, p), with a floor under its eigenvalues."""
    values, vectors = np.linalg.eigh(H)
    floor = _RELATIVE_FLOOR * np.maximum(values[..., -1:], 1e-300)
    return np.asarray((vectors / np.maximum(values, floor)[..., None, :]) @ np.swapaxes(vectors, -1, -2))
