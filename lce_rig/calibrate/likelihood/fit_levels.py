"""Noise levels from the data: those of maximum likelihood.

All unknowns are integrated out (restricted maximum likelihood), so that residuals reduced by the fit are
not mistaken for small noise. The terms stay linearised: an evaluation involves small matrices only, no
points.
"""

from dataclasses import replace

import numpy as np

from lce_rig.calibrate.likelihood.levels import LOG_SIGMA, MOST_LOST, NO_LASER_M, Levels, Priors
from lce_rig.calibrate.likelihood.system import Assembly, Terms
from lce_rig.core.geometry import Array

# Levels lie within these factors of the typical value, e^-4.6 and e^3.
_BELOW, _ABOVE = -4.6, 3.0


def fit_levels(terms: Terms, start: Levels, usual: Levels, priors: Priors, n_rounds: int) -> Levels:
    """Find the levels that minimise -2 ln p(data | levels) - 2 ln p(levels).

    Args:
        terms: linearised near the optimum.
        start: levels to start from.
        usual: centre of their prior; lasers without offsets there have none.
        priors: of the constants.
        n_rounds: of the search, at most.
    """
    from scipy.optimize import minimize

    names = [name for name in LOG_SIGMA if name != "laser_m" or usual.laser_m > NO_LASER_M]
    sigma = np.array([LOG_SIGMA[name] for name in names])
    middle = _logs(usual, names)
    assembly = Assembly(terms, priors)
    # Thousands of ranges and a few captures determine one level each: without a scale, the search zigzags.
    n_told = _count_measurements(terms, start)
    scale = np.sqrt(4 * np.array([n_told[name] for name in names]) + 2 / sigma**2)

    def levels_at(x: Array) -> Levels:
        return replace(usual, **dict(zip(names, np.exp(x / scale).tolist(), strict=True)))

    def cost(x: Array) -> tuple[float, Array]:
        evidence, slopes = assembly.evidence(levels_at(x), names)
        off = (x / scale - middle) / sigma
        return evidence + float(off @ off), (slopes + 2 * off / sigma) / scale

    highest = np.where(np.array(names) == "lost_share", np.log(MOST_LOST), middle + _ABOVE)
    bounds = list(zip((middle + _BELOW) * scale, highest * scale, strict=True))
    options = {"maxiter": n_rounds, "ftol": 1e-6}
    first = _logs(start, names) * scale
    found = minimize(cost, first, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return levels_at(found.x)


def _count_measurements(terms: Terms, levels: Levels) -> dict[str, float]:
    """Count, roughly, the measurements that tell of each level: n tell its logarithm to 1 / (2 n)^1/2."""
    n_returns = terms.ranges.n_returns
    n_ends, n_backed = len(terms.edges.rows), np.count_nonzero(terms.edges.is_backed)
    n_images = sum(len(images.capture) for images in terms.images)
    return {
        "range_m": float(n_returns.sum()),
        "ring_m": float(np.count_nonzero(n_returns)),
        # Only ring ends near the ends of their intervals show how blurred these are.
        "edge_rad": 0.3 * (n_ends - n_backed),
        "backed_rad": 0.3 * n_backed,
        "lost_share": 0.5 * levels.lost_share * n_ends,
        "own_shift_m": 0.3 * len(terms.own_shift_m),
        "tilt_rad": 2.0 * n_images,
        "spin_rad": 0.5 * n_images,
        "depth_m": float(n_images),
        "across_m": 2.0 * n_images,
        "laser_m": float(terms.n_rings),
    }


def _logs(levels: Levels, names: list[str]) -> Array:
    return np.log([getattr(levels, name) for name in names])
