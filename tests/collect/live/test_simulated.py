"""The simulated person avoids obstacles of the room."""

import numpy as np
import pytest

from lce_rig.collect.guidance.instructions import HeldPose, build_pose
from lce_rig.collect.guidance.sensor_model import SensorPlace
from lce_rig.collect.live.simulated import WALK_MPS, Person, Walker
from lce_rig.core.geometry import invert
from lce_rig.simulate import SimulationOptions
from lce_rig.simulate.live_scene import LiveScene
from tests.collect.live.replay import rig


@pytest.fixture(scope="module")
def scene():
    return LiveScene(rig(), 0, SimulationOptions.for_rig("rles"))


@pytest.fixture
def view():
    return SensorPlace.nominal(rig(), "davis", "lidar")


def walk(scene, view, wanted):
    """Stand in front, be sent somewhere and go: T_cam_board then, and how long it took."""
    T_world_cam = scene.stage.T_world_sensor["davis"]
    scene.hold(T_world_cam @ build_pose(view, HeldPose(0.0, 2.5, 0.0, 0.0, 0.0, 45.0)))
    walker = Walker(scene, Person(0.02, 1.0, 0.0), {"davis": view})
    walker.hear("davis", build_pose(view, wanted), 100.0)
    now_s, before = 100.0, np.eye(4)
    while not np.array_equal(before, scene.T_world_board):
        before, now_s = scene.T_world_board, now_s + 0.1
        walker.walk(now_s)
    now_s -= 0.1
    return invert(T_world_cam) @ scene.T_world_board, now_s - 100.0


def test_person_walks_to_target_placement(scene, view):
    reached, took_s = walk(scene, view, HeldPose(0.3, 3.0, 0.0, 10.0, 0.0, 45.0))
    wanted = build_pose(view, HeldPose(0.3, 3.0, 0.0, 10.0, 0.0, 45.0))
    assert np.linalg.norm(reached[:3, 3] - wanted[:3, 3]) < 0.15
    way_m = np.linalg.norm(wanted[:3, 3] - [0.0, 0.0, 2.5])
    assert took_s == pytest.approx(way_m / WALK_MPS, abs=0.4)


def test_person_blocked_by_wall_goes_partway(scene, view):
    reached, _ = walk(scene, view, HeldPose(0.0, 12.0, 0.0, 0.0, 0.0, 45.0))
    # The room ends nine metres ahead.
    assert 3.0 < reached[2, 3] < 9.0
