"""A robust line through readings of two clocks, some of them delayed."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array

_SHARP = 0.1
_OUTLIER_SIGMAS = 3.5
_N_ROUNDS = 10
_N_STRETCHES = 8
_MIN_INLIERS = 3


@dataclass(frozen=True, eq=False)
class LineFit:
    """Readings in the order of time, and the line

        y_i = offset + drift x_i + a e_i + noise_i,      a ~ 0 +- 1 / sqrt(3)                              (1)
        sigma_i^2 = (e_0^2 + e_i^2) / 3,      e_0 the tenth part quantile of e                             (2)

    with e_i the delay that could have put reading i wrong by up to +-e_i.

    Attributes:
        x_s: (N,) time on the source's clock.
        y_ns: (N,) the reference's time minus the source's.
        excess_ns: (N,) e_i; 0 for edges.
        floor_ns: no reading is better than this.
        origin_s: what was taken off x to centre it.
    """

    x_s: Array
    y_ns: Array
    excess_ns: Array
    floor_ns: float
    origin_s: float = 0.0

    @property
    def sigma_ns(self) -> Array:
        """The readings' standard deviations (N,) before their scatter is known (2)."""
        usual_ns = max(float(np.quantile(self.excess_ns, _SHARP)), np.sqrt(3) * self.floor_ns)
        return np.asarray(np.sqrt((usual_ns**2 + self.excess_ns**2) / 3))

    def select(self, keep: NDArray[np.bool_]) -> "LineFit":
        """Keep the readings of a mask."""
        return replace(self, x_s=self.x_s[keep], y_ns=self.y_ns[keep], excess_ns=self.excess_ns[keep])

    def centred(self) -> "LineFit":
        """Move the origin of x to the readings' weighted mean, where offset and drift are independent."""
        mean_s = float(np.average(self.x_s, weights=self.sigma_ns**-2.0))
        return replace(self, x_s=self.x_s - mean_s, origin_s=self.origin_s + mean_s)

    def solve(self) -> tuple[Array, Array]:
        """Find offset ns, drift ns/s and a, and the residuals (N,) in sigmas."""
        design, value, information = self._normal()
        line = np.linalg.solve(information, design.T @ value)
        return line, value - design @ line

    def covariance(self, are_delayed: bool) -> Array:
        """Compute the covariance (2, 2) of offset and drift.

        Edges err each by itself. Delays stay as they are for a while, and then are others: readings of one
        stretch of time err together. How much that matters, the jackknife over stretches tells: where its
        covariance is r > 1 times that of independent readings, that one is multiplied by r.

        References:
            `lce_rig.residuals.quadratics.Quadratics.jackknife_covariance`, which has the factor as well.
        """
        design, value, information = self._normal()
        inverse = np.linalg.inv(information)
        residual = value - design @ (inverse @ (design.T @ value))
        n, p = len(value), 2
        scatter = max(float(residual @ residual) / (n - p), (self.floor_ns / float(self.sigma_ns.min())) ** 2)
        independent = scatter * inverse[:p, :p]
        if not are_delayed or n < 3 * _N_STRETCHES:
            return np.asarray(independent)
        stretches = np.array_split(np.arange(n), _N_STRETCHES)
        gradients = np.array([design[part].T @ residual[part] for part in stretches])
        hessians = np.array([design[part].T @ design[part] for part in stretches])
        steps = np.linalg.solve(information - hessians, gradients[..., None])[:, :p, 0]
        jackknife = (_N_STRETCHES - 1) / (_N_STRETCHES - p - 2) * (steps.T @ steps)
        ratio = float(np.trace(np.linalg.solve(independent, jackknife))) / p
        return np.asarray(max(ratio, 1.0) * independent)

    def inliers(self) -> NDArray[np.bool_]:
        """Find the readings (N,) within 3.5 times the typical residual of their line, each by its sigma."""
        sigma_ns = self.sigma_ns
        residual = self.y_ns - median_slope(self.x_s, self.y_ns) * self.x_s
        residual = (residual - np.median(residual)) / sigma_ns
        keep = np.ones(len(residual), dtype=np.bool_)
        for _ in range(_N_ROUNDS):
            scale = max(1.4826 * float(np.median(np.abs(residual))), 1.0)
            found = np.abs(residual) <= _OUTLIER_SIGMAS * scale
            if found.sum() < _MIN_INLIERS or np.ptp(self.x_s[found]) == 0 or np.array_equal(found, keep):
                break
            keep = found
            line, _ = self.select(keep).solve()
            residual = (self.y_ns - line[0] - line[1] * self.x_s - line[2] * self.excess_ns) / sigma_ns
        return keep

    def _normal(self) -> tuple[Array, Array, Array]:
        """Build the weighted design (N, 3), the values (N,), and the information (3, 3) with that on a."""
        design = np.column_stack([np.ones(len(self.x_s)), self.x_s, self.excess_ns]) / self.sigma_ns[:, None]
        return design, self.y_ns / self.sigma_ns, design.T @ design + np.diag([0.0, 0.0, 3.0])


def median_slope(x: Array, y: Array) -> float:
    """Compute the median slope between points half the data apart; bears a quarter of outliers.

    References:
        Theil, "A rank-invariant method of linear and polynomial regression analysis", 1950 (method I).
    """
    half = len(x) // 2
    dx = x[half:] - x[: len(x) - half]
    return float(np.median((y[half:] - y[: len(y) - half])[dx > 0] / dx[dx > 0])) if (dx > 0).any() else 0.0
