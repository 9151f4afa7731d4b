"""Check the likelihood's covariance against the spread over placements.

The spread of the optimum without each placement (`lce_rig.residuals.quadratics`) is independent of the noise
model. If it significantly exceeds the model's covariance, there are errors that the model lacks, and the
covariance is multiplied.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.extrinsics.likelihood.refine import JointEstimate
from lce_rig.residuals.quadratics import jackknife_scatter
from lce_rig.solvers.covariance import symmetric_inverse

# Number of its standard deviations by which the ratio of covariances must exceed 1 to be significant.
_SURE = 2.0


def inflate(
    joint: JointEstimate, placement: NDArray[np.intp], camera: int = 0, n_seen: int | None = None
) -> tuple[Array, float]:
    """Multiply a camera's covariance (6, 6) according to the spread over placements.

    Args:
        joint: of F captures.
        placement: (F,) number of each capture's placement.
        camera: its number.
        n_seen: number of placements that it saw; all if None.

    Returns:
        The covariance and the factor, 1 if model and spread agree.
    """
    cov = joint.cov[camera]
    n = int(placement.max()) + 1 if n_seen is None else n_seen
    ratio = float(np.trace(symmetric_inverse(cov) @ jackknife(joint, placement, camera))) / len(cov)
    # A mean of 6 chi squares over n - 1 freedoms each.
    chance = np.sqrt(2 / (len(cov) * max(n - 1, 1)))
    factor = ratio if ratio > 1 + _SURE * chance else 1.0
    return factor * cov, factor


def jackknife(joint: JointEstimate, placement: NDArray[np.intp], camera: int = 0) -> Array:
    """Compute the jackknife covariance (6, 6) of a camera's extrinsics over placements."""
    cost = replace(joint.cost, placement=placement)
    return jackknife_scatter(cost.moves() @ joint.to_extrinsics[camera].T)
