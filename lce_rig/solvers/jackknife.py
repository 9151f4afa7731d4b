"""The jackknife: what an estimate would be without each group of residuals, and how far that scatters.

With half the gradient g_k and half the Hessian H_k of each group's cost at the minimum, and H their sum with
the prior's, leaving out group k moves the minimum to first order by

    m_k = (H - H_k)^-1 g_k                                                                               (1)

Groups are what errs independently: placements of the board, not captures that repeat one.
"""

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.solvers.covariance import symmetric_inverse


def sum_by_group(values: Array, group: NDArray[np.intp]) -> Array:
    """Add up what residuals of the same group say: (G, ...) for values (F, ...) and groups (F,) from 0."""
    sums = np.zeros((int(group.max()) + 1, *values.shape[1:]))
    np.add.at(sums, group, values)
    return sums


def leave_one_out_moves(gradients: Array, hessians: Array, information: Array) -> Array:
    """Compute (1) for all groups: (G, p).

    Dividing by H - H_k and not H corrects for the pull that each group has on its own residuals, which
    matters for few groups.

    Args:
        gradients: (G, p) g_k.
        hessians: (G, p, p) H_k.
        information: (p, p) H.
    """
    return np.asarray((symmetric_inverse(information - hessians) @ gradients[..., None])[..., 0])


def jackknife_scatter(moves: Array) -> Array:
    """Estimate the covariance (p, p) of an estimate from how leaving each group out moves it.

        cov = (G - 1) / G sum_k m_k m_k^T                                                                (2)

    Args:
        moves: (G, p) from the estimate with all groups, or from their mean.
    """
    n_groups = len(moves)
    return np.asarray((n_groups - 1) / n_groups * moves.T @ moves)


def jackknife_covariance(gradients: Array, hessians: Array, prior: Array) -> Array:
    """Compute the covariance of argmin sum_k f_k + prior from what leaving groups out does to it.

    No model of the noise enters, and errors within a group may be correlated in any way; unlike s^2 H^-1,
    which takes every residual for independent, (2) sees what a whole group has in common.

    The inverse of a covariance from few samples is too large: for normal errors in p unknowns it averages
    (G - 1) / (G - p - 2) times the true inverse (3). Multiplied by that factor, (2) gives normalised errors
    e^T cov^-1 e of the right size; below p + 4 groups the factor is held at (G - 1) / 2.

    Args:
        gradients: (G, p) half the gradient of each group's cost at the minimum.
        hessians: (G, p, p) half the Hessian of each (Gauss-Newton).
        prior: (p, p).

    Returns:
        (p, p).

    References:
        MacKinnon, White, "Some heteroskedasticity-consistent covariance matrix estimators", J. Econometrics,
        1985; Bell, McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage
        samples", Survey Methodology, 2002 (CR3).
    """
    n_groups, p = gradients.shape
    moves = leave_one_out_moves(gradients, hessians, hessians.sum(axis=0) + prior)
    correction = (n_groups - 1) / max(n_groups - p - 2, 2)  # equation (3)
    return np.asarray(correction * jackknife_scatter(moves))
