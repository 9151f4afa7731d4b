"""Second-order cost per capture, from which the result of any subset of captures follows.

With half the gradient g_k and half the Hessian H_k of each capture's cost, and P and g_P those of the priors,
the optimum for weights w of the captures is

    x(w) = -(P + sum_k w_k H_k)^-1 (g_P + sum_k w_k g_k)                                                 (1)

All weightings of residuals (Algorithm 1, the likelihood, the validation) give this form, and all covariances
from the scatter between captures follow from it. Errors are independent between placements of the board, not
between captures that repeat one.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array


@dataclass(frozen=True, eq=False)
class Quadratics:
    """Costs of F captures, expanded about some values of p unknowns.

    Attributes:
        gradients: (F, p) g_k.
        hessians: (F, p, p) H_k.
        prior: (p, p) P.
        prior_gradient: (p,) g_P.
        placement: (F,) number of the board placement that a capture shows.
    """

    gradients: Array
    hessians: Array
    prior: Array
    prior_gradient: Array
    placement: NDArray[np.intp]

    @cached_property
    def groups(self) -> Array:
        """Incidence matrix (G, F): 1 where a capture shows a placement."""
        numbers = np.arange(int(self.placement.max()) + 1)
        return np.asarray(numbers[:, None] == self.placement, dtype=np.float64)

    @cached_property
    def information(self) -> Array:
        """Information (p, p) of all captures and priors."""
        return np.asarray(self.hessians.sum(axis=0) + self.prior)

    def solve(self, shares: Array) -> Array:
        """Compute (1) for B weightings (B, F) of the captures: unknowns (B, p)."""
        H = np.tensordot(shares, self.hessians, axes=1) + self.prior
        g = shares @ self.gradients + self.prior_gradient
        return np.asarray(-(symmetric_inverse(H) @ g[..., None])[..., 0])

    def optimum(self) -> Array:
        """Compute (1) for all captures: (p,)."""
        return np.asarray(self.solve(np.ones((1, len(self.gradients))))[0])

    def moves(self) -> Array:
        """Compute the leave-one-out shifts of an estimate at the optimum for each placement: (G, p).

            m_k = (P + sum_j H_j - H_k)^-1 g_k

        with sums over a placement's captures for g_k and H_k. No other gradient enters, so that an estimate
        short of its optimum increases the scatter.
        """
        H = np.tensordot(1 - self.groups, self.hessians, axes=1) + self.prior
        return np.asarray((symmetric_inverse(H) @ (self.groups @ self.gradients)[..., None])[..., 0])

    def covariance(self) -> Array:
        """Compute the covariance (p, p) of the unknowns from all captures, for independent errors."""
        return symmetric_inverse(self.information)

    def jackknife_covariance(self) -> Array:
        """Compute the leave-one-out covariance (p, p) of the optimum over placements.

        No model of the noise enters, and errors within a placement may be correlated in any way; unlike
        s^2 H^-1, which assumes independent residuals, it includes errors common to a whole placement.

        The inverse of a covariance from few samples is too large: for normal errors in p unknowns it averages
        (G - 1) / (G - p - 2) times the true inverse. Multiplied by that factor, the scatter gives normalised
        errors e^T cov^-1 e of the right size; below p + 4 placements the factor is held at (G - 1) / 2.

        References:
            MacKinnon, White, "Some heteroskedasticity-consistent covariance matrix estimators", J.
            Econometrics, 1985; Bell, McCaffrey, "Bias reduction in standard errors for linear regression with
            multi-stage samples", Survey Methodology, 2002 (CR3).
        """
        n_groups, p = len(self.groups), len(self.prior)
        correction = (n_groups - 1) / max(n_groups - p - 2, 2)
        return np.asarray(correction * jackknife_scatter(self.moves()))


def jackknife_scatter(moves: Array) -> Array:
    """Estimate the covariance (p, p) of an estimate from its leave-one-out shifts over G placements.

        cov = (G - 1) / G sum_k m_k m_k^T

    Args:
        moves: (G, p) from the estimate with all of them, or from their mean.
    """
    n_groups = len(moves)
    return np.asarray((n_groups - 1) / n_groups * moves.T @ moves)


def symmetric_inverse(H: Array) -> Array:
    """Invert symmetric positive semi-definite H (..., p, p), eigenvalues at least 1e-12 of the largest."""
    values, vectors = np.linalg.eigh(H)
    floor = 1e-12 * np.maximum(values[..., -1:], 1e-300)
    return np.asarray((vectors / np.maximum(values, floor)[..., None, :]) @ np.swapaxes(vectors, -1, -2))
