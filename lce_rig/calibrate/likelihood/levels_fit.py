"""Noise levels from the data: the ones under which the data are most probable.

All unknowns are integrated out (restricted maximum likelihood), so that residuals which the fit itself made
small are not taken for small noise. The terms stay linearised: an evaluation is some small matrices, no
pass over points.
"""

from dataclasses import fields

import numpy as np

from lce_rig.calibrate.likelihood.levels import LOG_SIGMA, MOST_LOST, NO_LASER_M, Levels, Priors
from lce_rig.calibrate.likelihood.system import Terms, assemble
from lce_rig.core.geometry import Array

_STEP = 1e-3
_LOST = [field.name for field in fields(Levels)].index("lost_share")
# Levels lie within these factors of what is usual, e^-4.6 and e^3.
_BELOW, _ABOVE = -4.6, 3.0


def fit_levels(terms: Terms, start: Levels, usual: Levels, priors: Priors, n_rounds: int) -> Levels:
    """Find the levels that minimise -2 ln p(data | levels) - 2 ln p(levels).

    Args:
        terms: linearised near the optimum.
        start: levels to start from.
        usual: middle of what is believed of them.
        priors: of the constants.
        n_rounds: of the search, at most.
    """
    from scipy.optimize import minimize

    middle = usual.to_logs()
    free = np.arange(len(middle)) if usual.laser_m > NO_LASER_M else np.arange(len(middle) - 1)

    def cost(logs: Array) -> float:
        unlikely = float(np.sum(((logs - middle[free]) / LOG_SIGMA[free]) ** 2))
        return assemble(terms, _levels(logs, usual), priors).minus_2_log_evidence + unlikely

    highest = middle + _ABOVE
    highest[_LOST] = np.log(MOST_LOST)
    bounds = [(middle[i] + _BELOW, highest[i]) for i in free]
    options = {"maxiter": n_rounds, "eps": _STEP, "ftol": 1e-6}
    found = minimize(cost, start.to_logs()[free], method="L-BFGS-B", bounds=bounds, options=options)
    return _levels(found.x, usual)


def _levels(logs: Array, usual: Levels) -> Levels:
    """Complete the free levels; lasers without offsets have none."""
    return Levels.from_logs(logs if len(logs) == len(LOG_SIGMA) else np.append(logs, np.log(usual.laser_m)))
