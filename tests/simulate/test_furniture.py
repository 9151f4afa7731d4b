"""Drawn furniture: pieces that stand apart, leave the rig and the boards their place, and follow the seed."""

from itertools import combinations

import numpy as np
import pytest

from lce_rig.simulate import SimulationOptions, simulate_captures
from lce_rig.simulate.furniture import draw_furniture

from .conftest import make_rig

LOW, HIGH = np.array([-4.0, -3.0, 0.0]), np.array([9.0, 3.2, 3.0])


@pytest.mark.parametrize("seed", range(5))
def test_pieces_stand_in_the_room_apart_from_each_other_and_from_the_rig(seed: int) -> None:
    _, obstacles = draw_furniture(LOW, HIGH, np.random.default_rng(seed))
    assert 5 <= len(obstacles) <= 15
    for low, high in obstacles:
        assert np.all(low[:2] >= LOW[:2]) and np.all(high[:2] <= HIGH[:2]) and low[2] > -0.02
        nearest = np.clip([0.0, 0.0], low[:2], high[:2])
        assert np.hypot(*nearest) > 1.0
    for one, other in combinations(obstacles, 2):
        assert np.any(one[0][:2] > other[1][:2]) or np.any(one[1][:2] < other[0][:2])


def test_boards_are_placed_where_no_furniture_stands() -> None:
    rig = make_rig()
    options = SimulationOptions(is_furnished=True)
    for capture in simulate_captures(rig, n_captures=3, seed=4, options=options):
        T_lidar_board = capture.T_lidar_board["lidar"]
        away = (capture.scans[0].points - T_lidar_board[:3, 3]) @ T_lidar_board[:3, :3]
        half_m = np.array([rig.board.width_m, rig.board.height_m]) / 2
        on_board = np.all(np.abs(away) < [*(half_m - 0.05), 0.1], axis=1)
        assert on_board.sum() > 100
