"""Placements: captures of a board that was not moved in between are not independent."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.results import Observation

SAME_PLACE_M = 0.03
SAME_TURN_RAD = np.radians(3.0)


def group_placements(observations: Sequence[Observation]) -> NDArray[np.intp]:
    """Number the board placements of captures; captures that stood in the same place share a number.

    A capture joins the first placement of its session whose first capture has its centre and normal nearby.

    Args:
        observations: with the camera's pose of the board.

    Returns:
        (F,) numbers from 0.
    """
    T = np.array([observation.image.T_cam_board for observation in observations]).reshape(-1, 4, 4)
    session = np.array([observation.session for observation in observations])
    numbers = np.zeros(len(observations), dtype=np.intp)
    firsts: list[int] = []
    for k, own in enumerate(T):
        apart = np.linalg.norm(T[firsts] - own, axis=1)
        is_same = (apart[:, 3] < SAME_PLACE_M) & (apart[:, 2] < SAME_TURN_RAD)
        is_same &= session[firsts] == session[k]
        if is_same.any():
            numbers[k] = np.argmax(is_same)
        else:
            numbers[k] = len(firsts)
            firsts.append(k)
    return numbers


def group_shared_placements(
    cameras: Sequence[Sequence[Observation]], order: Mapping[str, int]
) -> NDArray[np.intp]:
    """Number the board placements of captures that several cameras share.

    Captures in the same place for one camera are one placement, for any other cameras.

    Args:
        cameras: observations of each.
        order: place of each capture by name, 0 to F - 1.

    Returns:
        (F,) numbers from 0.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n_captures, links = len(order), []
    for k, own in enumerate(cameras):
        # Each placement of a camera is a node beside those of the captures.
        placement = group_placements(own) + n_captures * (k + 1)
        links += [(order[o.capture], number) for o, number in zip(own, placement, strict=True)]
    n_nodes = n_captures * (len(cameras) + 1)
    graph = coo_array((np.ones(len(links)), np.array(links).T), shape=(n_nodes, n_nodes))
    _, component = connected_components(graph, directed=False)
    _, first, inverse = np.unique(component[:n_captures], return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[inverse], dtype=np.intp)
