"""A board held or carried in front of the simulated sensors: optimisations do not change the data."""

import numpy as np
import pytest

from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import rotation_angle
from lce_rig.simulate.live_scene import LiveScene
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.placements import between

from .conftest import board_before_lidar, make_rig


@pytest.fixture(scope="module")
def live():
    scene = LiveScene(make_rig(), 3, SimulationOptions())
    scene.hold(board_before_lidar(2.2, yaw_deg=20.0))
    return scene


def samples(live, stamp_ns):
    image, scan = live.take(stamp_ns)
    assert isinstance(image, Image) and isinstance(scan, Scan)
    return image, scan


def test_moving_board_is_seen_at_its_pose(live):
    start, end = board_before_lidar(2.2, yaw_deg=20.0), board_before_lidar(2.6, yaw_deg=-10.0)
    live.pass_by(start, end, 0.5)
    on_its_way, _ = samples(live, 0)
    middle = live.T_world_board
    live.hold(middle)
    held, scan = samples(live, 0)
    difference = np.abs(on_its_way.pixels.astype(float) - held.pixels.astype(float))
    assert difference.mean() < 3.0, "edges and shadows alone are drawn more coarsely"
    assert len(scan.points) > 10_000
    assert np.allclose(middle[:3, 3], (start[:3, 3] + end[:3, 3]) / 2)
    assert np.degrees(rotation_angle(middle[:3, :3], between(start, end, 1.0)[:3, :3])) == pytest.approx(15.0)
