"""Do placements disagree by more than the likelihood says they may?

The spread of the optimum without each placement (`lce_rig.residuals.quadratics`) knows nothing of the noise
model; where it exceeds the model's covariance by more than chance allows, errors are at work that the model
does not have, and the covariance is multiplied.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.extrinsics.likelihood.refine import JointEstimate
from lce_rig.residuals.quadratics import jackknife_scatter
from lce_rig.solvers.covariance import symmetric_inverse

# So many standard deviations of its own must the ratio of covariances lie above 1 to count.
_SURE = 2.0


def inflate(
    joint: JointEstimate, placement: NDArray[np.intp], camera: int = 0, n_seen: int | None = None
) -> tuple[Array, float]:
    """Multiply a camera's covariance (6, 6) by what the spread over placements shows.

    Args:
        joint: of F captures.
        placement: (F,) number of each capture's placement.
        camera: its number.
        n_seen: placements that it saw; all if None.

    Returns:
        The covariance and the factor, 1 where model and spread agree.
    """
    cov = joint.cov[camera]
    n = int(placement.max()) + 1 if n_seen is None else n_seen
    ratio = float(np.trace(symmetric_inverse(cov) @ jackknife(joint, placement, camera))) / len(cov)
    # A mean of 6 chi squares over n - 1 freedoms each.
    chance = np.sqrt(2 / (len(cov) * max(n - 1, 1)))
    factor = ratio if ratio > 1 + _SURE * chance else 1.0
    return factor * cov, factor


def jackknife(joint: JointEstimate, placement: NDArray[np.intp], camera: int = 0) -> Array:
    """Compute the jackknife covariance (6, 6) of a camera's extrinsic over placements."""
    cost = replace(joint.cost, placement=placement)
    return jackknife_scatter(cost.moves() @ joint.to_extrinsics[camera].T)
