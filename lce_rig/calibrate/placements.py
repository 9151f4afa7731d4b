"""Captures of a board that was not moved in between repeat each other: they are no independent evidence."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.results import Observation

SAME_PLACE_M = 0.03
SAME_TURN_RAD = np.radians(3.0)


def group_placements(observations: Sequence[Observation]) -> NDArray[np.intp]:
    """Number the board placements of captures; captures that stood in the same place share a number.

    A capture joins the first placement whose first capture has its centre and its normal nearby.

    Args:
        observations: with the camera's pose of the board.

    Returns:
        (F,) numbers from 0.
    """
    numbers = np.zeros(len(observations), dtype=np.intp)
    firsts: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    for k, observation in enumerate(observations):
        T = observation.image.T_cam_board
        for number, (centre, normal) in enumerate(firsts):
            is_near = np.linalg.norm(T[:3, 3] - centre) < SAME_PLACE_M
            if is_near and np.linalg.norm(T[:3, 2] - normal) < SAME_TURN_RAD:
                numbers[k] = number
                break
        else:
            numbers[k] = len(firsts)
            firsts.append((T[:3, 3], T[:3, 2]))
    return numbers
