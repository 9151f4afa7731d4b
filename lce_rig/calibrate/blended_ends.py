"""Ring ends where something stands close behind the board, and what becomes of them.

There a beam that the board fills in part comes back as a blend of both surfaces, off the board's plane, and
the board seems to end sooner: by 2 to 4 mm on recordings, by up to 10 mm in simulation with a person behind
the board (docs/method.md). A few such ring ends among many do less harm than their loss would.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.results import LidarBoard, Observation

BLENDS_M = 0.35
"""Echoes from surfaces nearer to each other than this blend into one."""
# So large a share of all ring ends biases a result by more than the others' noise.
_HARMFUL_SHARE = 0.25
# A capture that has fewer others keeps all it has.
_MIN_ENDS = 4


def is_blended(lidar: LidarBoard) -> NDArray[np.bool_]:
    """Tell of each ring end (M,) whether something stands close behind the board."""
    return np.asarray(lidar.edge_behind_m < BLENDS_M)


def blended_share(observations: Sequence[Observation]) -> float:
    """Compute the share of blended ring ends, 0 where there are no ring ends."""
    blended = np.concatenate([is_blended(observation.lidar) for observation in observations])
    return float(blended.mean()) if len(blended) else 0.0


def without_blended_ends(observations: Sequence[Observation]) -> list[Observation]:
    """Leave blended ring ends out where they are a harmful share of all."""
    if blended_share(observations) < _HARMFUL_SHARE:
        return list(observations)
    return [_clean(observation) for observation in observations]


def _clean(observation: Observation) -> Observation:
    lidar = observation.lidar
    keep = ~is_blended(lidar)
    if np.count_nonzero(keep) < _MIN_ENDS:
        return observation
    ends = {
        name: getattr(lidar, name)[keep]
        for name in ("edge_points", "edge_ring", "edge_side", "edge_behind_m")
    }
    return replace(observation, lidar=replace(lidar, **ends))
