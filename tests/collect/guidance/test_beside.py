"""Placements for one pair of sensors that help another pair, too."""

import numpy as np
import pytest

from lce_rig.collect.guidance.planner import Beside, Planner
from lce_rig.collect.guidance.sensor_model import SensorModel, SensorPlace
from lce_rig.collect.live.guide import Guide
from lce_rig.core.geometry import invert
from lce_rig.rig import load_rig

NONE = np.zeros((0, 4, 4))


@pytest.fixture(scope="module")
def planners():
    """Planners of both cameras of a rig with the LiDAR."""
    rig = load_rig("two_cameras")
    return {
        name: Planner(
            SensorPlace(SensorModel.of(rig, name, "lidar"), rig.nominal(name, "lidar").to_matrix()),
            n_places=80,
        )
        for name in ("left", "right")
    }


def test_placement_beside_another_camera_helps_it_too(planners):
    left, right = planners["left"], planners["right"]
    held = left.candidates[:: len(left.candidates) // 5][:5]
    T_right_left = right.view.T_cam_lidar @ invert(left.view.T_cam_lidar)
    alone = left.guide(held).T_cam_board
    both = left.guide(held, beside=[Beside(right, T_right_left, NONE)]).T_cam_board
    after = right.shortfall_after(NONE, T_right_left @ np.stack([alone, both]))
    assert after[1] <= after[0]
    best, chosen = left.shortfall_after(held, np.stack([alone, both]))
    assert chosen < 1.5 * best


def test_placement_out_of_sight_leaves_the_shortfall(planners):
    right = planners["right"]
    behind = right.candidates[0].copy()
    behind[:3, 3] *= -1
    unseen, seen = right.shortfall_after(right.candidates[:3], np.stack([behind, right.candidates[9]]))
    assert seen < unseen


def test_guide_without_captures_needs_most():
    rig = load_rig("two_cameras")
    left, right = (Guide(rig, (name, "frames"), "lidar") for name in ("left", "right"))
    left.add("000000", np.eye(4))
    assert right.need > left.need
