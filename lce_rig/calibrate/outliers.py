"""Captures that disagree with what the others predict, and the size of the errors of those that agree."""

from collections.abc import Sequence

import numpy as np

from lce_rig.calibrate.options import Algorithm1Parts
from lce_rig.core.geometry import Array
from lce_rig.core.results import Refusal
from lce_rig.residuals.features import CaptureFeatures
from lce_rig.residuals.moments import Problem

_DEVIATIONS = 6.0
_TIMES_MEDIAN = 3.0
# A disagreement below this can be noise, however well the other captures agree.
_FLOOR_M = 0.02
_MAX_SHARE = 0.25
_SIGMA_FLOOR_M = 0.001


def reject_outliers(
    features: Sequence[CaptureFeatures], problem: Problem, T_start: Array, parts: Algorithm1Parts
) -> tuple[dict[str, Refusal], tuple[float, float]]:
    """Refuse captures whose plane or edges lie far from where the other captures predict them, worst first.

    Args:
        features: of the captures in `problem`.
        problem: their moments, weighted alike.
        T_start: (4, 4) planar initialisation.
        parts: of Algorithm 1; `reject_outliers` switches the refusal off.

    Returns:
        The refusals by capture; and the typical predicted plane and edge error of the captures kept, m.
    """
    kept = np.arange(problem.n_captures)
    refusals: dict[str, Refusal] = {}
    while True:
        selection = np.zeros((len(kept), problem.n_captures))
        selection[:, kept] = 1
        selection[np.arange(len(kept)), kept] = 0
        solutions = problem.solve(selection, T_start, parts.n_rounds)
        plane, edge = (error[np.arange(len(kept)), kept] for error in problem.errors(solutions.x))
        excess = np.maximum(_excess(plane), _excess(edge))
        worst = int(np.argmax(excess))
        n_refused = problem.n_captures - len(kept)
        is_done = not parts.reject_outliers or excess[worst] <= 1 or len(kept) <= 4
        if is_done or n_refused >= _MAX_SHARE * problem.n_captures:
            return refusals, (_typical(plane), _typical(edge))
        refusals[features[kept[worst]].capture] = _refusal(plane, edge, worst)
        kept = np.delete(kept, worst)


def _excess(errors: Array) -> Array:
    """Divide errors (F,) by the largest that still passes for noise."""
    median = float(np.median(errors))
    deviation = 1.4826 * float(np.median(np.abs(errors - median)))
    limit = max(median + _DEVIATIONS * deviation, _TIMES_MEDIAN * median, _FLOOR_M)
    return errors / limit


def _typical(errors: Array) -> float:
    return max(float(np.median(errors)), _SIGMA_FLOOR_M)


def _refusal(plane: Array, edge: Array, k: int) -> Refusal:
    return Refusal(
        "calibrate.outlier",
        figures={
            "plane_m": float(plane[k]),
            "edges_m": float(edge[k]),
            "plane_median_m": float(np.median(plane)),
            "edges_median_m": float(np.median(edge)),
        },
    )
