"""The robust mean of poses."""

from collections.abc import Callable

import numpy as np

from lce_rig.core.geometry import Array, difference, perturb

_STEPS, _SETTLED = 20, 1e-10


def mean_pose(
    T: Array,
    information: Array,
    T_start: Array | None = None,
    weigh: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array]:
    """Find the pose of least sum_k w_k x_k^T W_k x_k, with x_k the tangent from it to pose k.

    Args:
        T: (K, 4, 4).
        information: (K, 6, 6) W_k.
        T_start: (4, 4) to start from; the first pose if None.
        weigh: weights w (K,) for squared distances x_k^T W_k x_k (K,), recomputed at each step, so that
            outliers do not shift the mean; 1 if None.

    Returns:
        (4, 4), and the weights (K,).
    """
    mean = T[0] if T_start is None else T_start
    weight = np.ones(len(T))
    for _ in range(_STEPS):
        apart = difference(T, mean)
        if weigh is not None:
            weight = weigh(np.einsum("ki,kij,kj->k", apart, information, apart))
        weighted = weight[:, None, None] * information
        step = np.linalg.solve(weighted.sum(axis=0), np.einsum("kij,kj->i", weighted, apart))
        mean = perturb(mean, step)
        if np.linalg.norm(step) < _SETTLED:
            break
    return mean, weight
