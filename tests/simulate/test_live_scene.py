"""A board held or carried before the simulated sensors: what is spared changes nothing that is measured."""

import numpy as np
import pytest

from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import pose, rotation_angle
from lce_rig.simulate.lidar import sweep_again, sweep_scene
from lce_rig.simulate.live_scene import LiveScene
from lce_rig.simulate.options import LidarNoise, SimulationOptions
from lce_rig.simulate.placements import between
from lce_rig.simulate.room import build_carrier
from lce_rig.simulate.scene import Scene

from .conftest import VLP16, board_before_lidar, make_rig

FAR_BELOW = pose(np.eye(3), np.array([0.0, 0.0, -1e6]))


@pytest.mark.parametrize(("distance_m", "yaw_deg", "carrier"), [(1.3, 20.0, "person"), (3.5, -25.0, "stand")])
def test_beams_that_cannot_meet_the_board_need_not_be_sent_again(
    room, board, T_world_lidar, distance_m, yaw_deg, carrier
):
    T = board_before_lidar(distance_m, yaw_deg=yaw_deg)
    bodies = build_carrier(carrier, board, T, np.random.default_rng(3))  # type: ignore[arg-type]
    scene, noise = Scene(room.raycaster, bodies, board, T), LidarNoise()
    empty = Scene(room.raycaster, (), board, FAR_BELOW)
    at_once = sweep_scene(scene, T_world_lidar, VLP16, noise, np.random.default_rng(5))
    of_room = sweep_scene(empty, T_world_lidar, VLP16, noise, np.random.default_rng(5))
    again = sweep_again(of_room, scene, T_world_lidar, VLP16, noise)
    assert np.count_nonzero(again.returns.surface == scene.board_index) > 100
    assert np.array_equal(again.azimuth_rad, at_once.azimuth_rad)
    assert np.array_equal(again.is_rim, at_once.is_rim) and again.is_rim.any()
    for name in ("range_m", "energy", "reflectivity", "surface"):
        assert np.array_equal(getattr(again.returns, name), getattr(at_once.returns, name))


@pytest.fixture(scope="module")
def live():
    scene = LiveScene(make_rig(), 3, SimulationOptions())
    scene.hold(board_before_lidar(2.2, yaw_deg=20.0))
    return scene


def samples(live, stamp_ns):
    image, scan = live.take(stamp_ns)
    assert isinstance(image, Image) and isinstance(scan, Scan)
    return image, scan


def test_a_board_on_its_way_is_seen_where_it_is(live):
    start, end = board_before_lidar(2.2, yaw_deg=20.0), board_before_lidar(2.6, yaw_deg=-10.0)
    live.pass_by(start, end, 0.5)
    on_its_way, _ = samples(live, 0)
    middle = live.T_world_board
    live.hold(middle)
    held, scan = samples(live, 0)
    difference = np.abs(on_its_way.pixels.astype(float) - held.pixels.astype(float))
    assert difference.mean() < 3.0, "edges alone are drawn more coarsely"
    assert len(scan.points) > 10_000
    assert np.allclose(middle[:3, 3], (start[:3, 3] + end[:3, 3]) / 2)
    assert np.degrees(rotation_angle(middle[:3, :3], between(start, end, 1.0)[:3, :3])) == pytest.approx(15.0)
