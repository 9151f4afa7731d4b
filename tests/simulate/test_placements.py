"""The board is put where both sensors see it."""

import numpy as np
import pytest

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.simulate.poses import CameraView, count_rings, seen_share

from .conftest import LENSES, VLP16, board_before_lidar


@pytest.fixture
def view(T_world_lidar: Array, T_world_cam: Array) -> CameraView:
    return CameraView("cam", LENSES["radtan"], T_world_cam, "lidar", VLP16, T_world_lidar)


@pytest.mark.parametrize("distance_m, share", [(4.0, 1.0), (2.0, 1.0), (1.0, 0.58), (0.6, 0.36)])
def test_near_boards_reach_out_of_the_lidars_field(
    view: CameraView, board: Board, distance_m: float, share: float
) -> None:
    # Half the diamond's diagonal is 0.495 m; the field ends 16 deg above and below the horizon.
    expected = min(1.0, np.radians(16) / np.arctan(0.495 / distance_m))
    assert expected == pytest.approx(share, abs=0.06)
    assert seen_share(view, board, board_before_lidar(distance_m)) == pytest.approx(expected, abs=0.02)


def test_rings_on_a_board_follow_its_distance(view: CameraView, board: Board) -> None:
    # A diamond of 0.99 m holds a ring every 2 deg, save near its two tips.
    assert count_rings(view, board, board_before_lidar(2.0)) in (13, 14)
    assert count_rings(view, board, board_before_lidar(4.0)) in (6, 7)
