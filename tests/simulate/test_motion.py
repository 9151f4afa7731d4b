"""Hands move the board smoothly, at the speed asked for, and through its placements."""

import numpy as np
import pytest

from lce_rig.core.geometry import difference, exp_so3, invert, pose
from lce_rig.simulate.options import HandMotion
from lce_rig.simulate.placements import carry_board, sway_board
from lce_rig.simulate.scene import Raycaster, Scene
from tests.exact_lidar import EXACT

from .conftest import VLP16, board_before_lidar, simulate_scan

ANCHOR_NS = 1_700_000_000_050_000_000
BEFORE_NS = ANCHOR_NS + 1_000_000 * np.arange(-1000, 201, 5)


def sway(hand, seed):
    return sway_board(board_before_lidar(2.0), ANCHOR_NS, hand, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(4))
def test_a_swaying_board_passes_its_placement_exactly(seed):
    trajectory = sway(HandMotion(), seed)
    assert np.allclose(trajectory.at(ANCHOR_NS), board_before_lidar(2.0), atol=1e-12)
    assert trajectory.at(BEFORE_NS).shape == (len(BEFORE_NS), 4, 4)
    assert np.allclose(trajectory.at(BEFORE_NS)[7], trajectory.at(int(BEFORE_NS[7])), atol=1e-15)


@pytest.mark.parametrize("speed_mps", [0.0, 0.05, 0.3])
def test_speed_over_last_second_is_as_requested(speed_mps):
    for seed in range(4):
        trajectory = sway(HandMotion(speed_mps=(speed_mps, speed_mps), tremor_m=0.0), seed)
        rms_mps = np.sqrt(np.mean(trajectory.speed_mps(BEFORE_NS) ** 2))
        assert rms_mps == pytest.approx(speed_mps, rel=0.02, abs=1e-6)


def test_carried_board_rests_and_never_jumps():
    placements = [board_before_lidar(2.0), board_before_lidar(3.0, roll_deg=30.0, yaw_deg=25.0)]
    placements.append(
        pose(placements[0][:3, :3] @ exp_so3(np.array([0.3, -0.4, 0.1])), np.array([1.5, 0.7, 1.2]))
    )
    hand = HandMotion(speed_mps=(0.0, 0.0), tremor_m=0.0, rest_s=0.5)
    trajectory = carry_board(placements, ANCHOR_NS, hand, np.random.default_rng(0))
    for k, T in enumerate(placements):
        for t_ns in (trajectory.arrival_ns[k], trajectory.departure_ns[k]):
            assert np.allclose(trajectory.at(t_ns), T, atol=1e-9)
    times_ns = np.arange(ANCHOR_NS, trajectory.departure_ns[-1] + 1_000_000_000, 2_000_000)
    assert trajectory.speed_mps(times_ns).max() <= hand.carry_mps * 1.001
    step = difference(trajectory.at(times_ns[1:]), trajectory.at(times_ns[:-1]))
    assert np.linalg.norm(step[:, 3:], axis=1).max() / 0.002 < np.radians(61)


def moving_scan(board, T_world_lidar, trajectory, noise):
    stamp_ns = ANCHOR_NS - 50_000_000
    scene = Scene(Raycaster(()), [], board, trajectory.at(ANCHOR_NS))
    return simulate_scan(
        scene,
        T_world_lidar,
        VLP16,
        noise,
        np.random.default_rng(0),
        board_at=trajectory.at,
        stamp_ns=stamp_ns,
    )


def heights_m(scan, T_world_lidar, T_world_board):
    """Distance of each point from the plane of its pose (N, 4, 4), or of one pose for all."""
    T_board_lidar = invert(T_world_board) @ T_world_lidar
    along = np.broadcast_to(T_board_lidar[..., 2, :3], scan.points.shape)
    return np.einsum("nj,nj->n", along, scan.points) + T_board_lidar[..., 2, 3]


@pytest.mark.parametrize("seed", range(3))
def test_lidar_meets_a_board_at_each_firing(board, T_world_lidar, seed):
    trajectory = sway(HandMotion(speed_mps=(0.5, 0.5), turn_deg_s=40.0), seed)
    scan = moving_scan(board, T_world_lidar, trajectory, EXACT)
    assert scan.offset_ns is not None and scan.stamp_ns is not None and len(scan.points) > 500
    own = heights_m(scan, T_world_lidar, trajectory.at(scan.stamp_ns + scan.offset_ns))
    assert np.abs(own).max() < 1e-3
    at_stamp = heights_m(scan, T_world_lidar, trajectory.at(scan.stamp_ns))
    assert np.abs(at_stamp).max() > 5 * np.abs(own).max()
