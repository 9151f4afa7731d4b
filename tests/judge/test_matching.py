"""A known extrinsic pairs the right candidate with the right pose."""

from dataclasses import replace

import numpy as np

from lce_rig.core.geometry import perturb
from lce_rig.core.results import Observation
from lce_rig.judge.session_check import match_candidates
from tests.calibrate.boards import BOARD, T_FORWARD, simulate


def test_match_candidates_any_order_is_equal():
    first, second = simulate(2, seed=0)
    for places in ([first.lidar, second.lidar], [second.lidar, first.lidar]):
        found = match_candidates(Observation.of("a", first.image, places), BOARD, T_FORWARD)
        assert found.lidar is first.lidar


def test_the_pose_that_the_scan_confirms_is_taken():
    item = simulate(1, seed=3)[0]
    right = item.image.T_cam_board
    wrong = perturb(right, np.array([0, 0, 0, 0.5, 0.3, 0]))
    swapped = replace(item.image, T_cam_board=wrong, T_cam_board_alternative=right)
    found = match_candidates(replace(item, pose=swapped), BOARD, T_FORWARD)
    np.testing.assert_array_equal(found.image.T_cam_board, right)
