"""Noise levels from the data: the ones under which the data are most probable.

All unknowns are integrated out (restricted maximum likelihood), so that residuals which the fit itself made
small are not taken for small noise. The terms stay linearised: an evaluation is some small matrices, no
pass over points.
"""

from dataclasses import replace

import numpy as np

from lce_rig.calibrate.likelihood.levels import LOG_SIGMA, MOST_LOST, NO_LASER_M, Levels, Priors
from lce_rig.calibrate.likelihood.system import Assembly, Terms
from lce_rig.core.geometry import Array

_STEP = 1e-3
# Levels lie within these factors of what is usual, e^-4.6 and e^3.
_BELOW, _ABOVE = -4.6, 3.0


def fit_levels(terms: Terms, start: Levels, usual: Levels, priors: Priors, n_rounds: int) -> Levels:
    """Find the levels that minimise -2 ln p(data | levels) - 2 ln p(levels).

    Args:
        terms: linearised near the optimum.
        start: levels to start from.
        usual: middle of what is believed of them; lasers that have no offsets there have none.
        priors: of the constants.
        n_rounds: of the search, at most.
    """
    from scipy.optimize import minimize

    names = [name for name in LOG_SIGMA if name != "laser_m" or usual.laser_m > NO_LASER_M]
    sigma = np.array([LOG_SIGMA[name] for name in names])
    middle = _logs(usual, names)
    assembly = Assembly(terms, priors)

    def levels_at(logs: Array) -> Levels:
        return replace(usual, **dict(zip(names, np.exp(logs).tolist(), strict=True)))

    def cost(logs: Array) -> float:
        unlikely = float(np.sum(((logs - middle) / sigma) ** 2))
        return assembly.at(levels_at(logs)).minus_2_log_evidence + unlikely

    highest = np.where(np.array(names) == "lost_share", np.log(MOST_LOST), middle + _ABOVE)
    bounds = list(zip(middle + _BELOW, highest, strict=True))
    options = {"maxiter": n_rounds, "eps": _STEP, "ftol": 1e-6}
    return levels_at(minimize(cost, _logs(start, names), method="L-BFGS-B", bounds=bounds, options=options).x)


def _logs(levels: Levels, names: list[str]) -> Array:
    return np.log([getattr(levels, name) for name in names])
