"""The truth of a simulation states when the LiDAR scanned the board, and its pose at that time."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import invert, perturb, transform
from lce_rig.simulate import (
    HandMotion,
    SimulatedCapture,
    SimulationOptions,
    board_time_ns,
    capture_truth,
    rig_truth,
    truth_extrinsics,
)
from lce_rig.simulate.placements import hold_board, sway_board

from .conftest import board_before_lidar, make_rig

STAMP_NS = 1_700_000_000_000_000_000
T_WORLD_BOARD = board_before_lidar(2.0)


@pytest.fixture(scope="module")
def rig():
    return make_rig()


def scan_of(T_lidar_board, offset_ns, on_board):
    """Points all over the plate, and as many 1 m behind it, at their firing times (N,)."""
    rng = np.random.default_rng(0)
    points_board = rng.uniform([-0.35, -0.25, -0.01], [0.35, 0.25, 0.01], (len(offset_ns), 3))
    points_board[~on_board, 2] += 1.0
    points = transform(T_lidar_board, points_board[:, None])[:, 0].astype(np.float32)
    n = len(points)
    return Scan("lidar", STAMP_NS, points, np.zeros(n, np.float32), np.zeros(n, np.int16), offset_ns)


def capture_of(trajectory, on_board):
    offset_ns = np.linspace(30_000_000, 70_000_000, len(on_board)).astype(np.int64)
    T_world_sensor = {"lidar": np.eye(4), "cam": perturb(np.eye(4), np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.1]))}
    T_lidar_board = trajectory.at(STAMP_NS + offset_ns)
    image = Image("cam", "frames", STAMP_NS + 150_000_000, np.zeros((2, 2), np.uint8))
    scan = scan_of(T_lidar_board, offset_ns, on_board)
    return SimulatedCapture(0, [image], [scan], {}, {}, ("cam", "lidar"), [], trajectory, T_world_sensor)


@pytest.mark.parametrize("share", [0.2, 0.9])
def test_board_time_is_the_mean_of_returns(rig, share):
    hand = HandMotion(speed_mps=(0.6, 0.6))
    swaying = sway_board(T_WORLD_BOARD, STAMP_NS, hand, np.random.default_rng(1))
    on_board = np.arange(500) < 500 * share
    for trajectory in (hold_board(T_WORLD_BOARD), swaying):
        capture = capture_of(trajectory, on_board)
        (scan,) = capture.scans
        expected_ns = STAMP_NS + scan.offset_ns[on_board].mean()
        assert board_time_ns(rig, capture, scan) == pytest.approx(expected_ns, abs=1)


def test_board_time_no_returns_is_middle(rig):
    capture = capture_of(hold_board(T_WORLD_BOARD), np.zeros(50, np.bool_))
    assert board_time_ns(rig, capture, capture.scans[0]) == STAMP_NS + 50_000_000
    capture = capture_of(hold_board(T_WORLD_BOARD), np.ones(50, np.bool_))
    timeless = replace(capture.scans[0], offset_ns=None)
    assert board_time_ns(rig, capture, timeless) == STAMP_NS + 50_000_000


def test_truth_poses_are_at_sensor_times(rig):
    swaying = sway_board(T_WORLD_BOARD, STAMP_NS, HandMotion(speed_mps=(0.3, 0.3)), np.random.default_rng(2))
    capture = capture_of(swaying, np.ones(50, np.bool_))
    truth = capture_truth(rig, capture, SimulationOptions(motion="moving", frame_offset_s=0.12))
    lidar, camera = truth["boards"]["lidar"], truth["boards"]["cam"]
    assert camera["t_ns"] == STAMP_NS + 30_000_000
    assert np.allclose(lidar["T_sensor_board"], swaying.at(lidar["t_ns"]))
    assert np.allclose(
        camera["T_sensor_board"], invert(capture.T_world_sensor["cam"]) @ swaying.at(camera["t_ns"])
    )
    assert truth["speed_mps"] == pytest.approx(swaying.speed_mps(lidar["t_ns"]), abs=1e-5)
    blind = replace(capture, images=[])
    assert capture_truth(rig, blind, SimulationOptions())["boards"]["cam"]["t_ns"] == lidar["t_ns"]


def test_the_rigs_truth_names_every_pair_and_the_clocks(rig):
    options = SimulationOptions(motion="moving", frame_offset_s=-0.12, event_offset_s=0.015)
    truth = rig_truth(rig, 4, options)
    assert np.array_equal(truth["T_cam_lidar"], truth_extrinsics(rig, 4, options)["cam", "lidar"])
    assert [(pair["camera"], pair["lidar"]) for pair in truth["pairs"]] == [("cam", "lidar")]
    assert (truth["seed"], truth["frame_offset_s"], truth["event_offset_s"]) == (4, -0.12, 0.015)
