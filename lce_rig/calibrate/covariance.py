"""Covariance by errors that residuals share, and inverses of information; `jackknife` takes their scatter."""

import numpy as np

from lce_rig.core.geometry import Array

_RELATIVE_FLOOR = 1e-12


def systematic_covariances(
    sensitivities: Array, sigma_each: float, sigma_common: float
) -> tuple[Array, Array]:
    """Propagate errors common to all groups, which the scatter between groups cannot show.

    Source r is off by e + e_r, with e the mean error of all L sources and e_r its own deviation from it, and
    moves the estimate by s_r for each unit. Independent deviations less their mean leave

        cov = sigma_each^2 sum_r (s_r - s) (s_r - s)^T + sigma_common^2 L^2 s s^T,   s = sum_r s_r / L

    Args:
        sensitivities: (..., p, L) s_r in columns.
        sigma_each: standard deviation of e_r, before their mean is subtracted.
        sigma_common: standard deviation of e.

    Returns:
        Its two terms (..., p, p).
    """
    common = sensitivities.sum(axis=-1, keepdims=True)
    each = sensitivities - sensitivities.mean(axis=-1, keepdims=True)
    of_each = sigma_each**2 * each @ np.swapaxes(each, -1, -2)
    return of_each, sigma_common**2 * common @ np.swapaxes(common, -1, -2)


def symmetric_inverse(H: Array) -> Array:
    """Invert symmetric positive semi-definite H (..., p, p), with a floor under its eigenvalues."""
    values, vectors = np.linalg.eigh(H)
    floor = _RELATIVE_FLOOR * np.maximum(values[..., -1:], 1e-300)
    return np.asarray((vectors / np.maximum(values, floor)[..., None, :]) @ np.swapaxes(vectors, -1, -2))
