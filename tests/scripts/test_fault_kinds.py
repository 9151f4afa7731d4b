"""Faults are what they say: what is moved or bent stays a board, and sound sessions stay sound."""

import numpy as np
import pytest
from benchmarks.fault_kinds import KINDS, _bent, _moved
from benchmarks.fault_sessions import WRONG_PLATES_M, SimulatedScans

from lce_rig.core.geometry import exp_so3, fit_plane, invert, pose, transform
from lce_rig.rig import load_rig
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, random_pose, scan_board

RIG = load_rig("rlfs")


def scans(n: int = 8) -> SimulatedScans:
    rng = np.random.default_rng(0)
    poses, found = {}, {}
    while len(poses) < n:
        T_cam_board = random_pose(rng, Scenario(), BOARD)
        board = scan_board(invert(T_FORWARD) @ T_cam_board, rng, Scenario(), BOARD)
        if board is not None:
            name = f"{len(poses):06d}"
            poses[name], found[name] = T_cam_board, [board]
    resized = dict.fromkeys(WRONG_PLATES_M, found)
    return SimulatedScans(0, T_FORWARD, poses, found, resized, poses, found)


SCANS = scans()


def test_a_moved_board_keeps_its_points_on_its_plane() -> None:
    board = SCANS.scans["000000"][0]
    T = pose(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([0.3, 0.1, -0.2]))
    moved = _moved(board, T)
    before, after = (b.points @ b.plane[:3] + b.plane[3] for b in (board, moved))
    assert np.allclose(before, after)


@pytest.mark.parametrize("side", [0, 1])
def test_a_bent_board_is_bowed_by_5_mm_along_one_side(side: int) -> None:
    board = SCANS.scans["000001"][0]
    T_board_lidar = invert(SCANS.T_cam_board["000001"]) @ T_FORWARD
    lifted = transform(T_board_lidar, _bent(board, T_board_lidar, BOARD, side, 1).points)
    flat = transform(T_board_lidar, board.points)
    height = (lifted - flat)[:, 2]
    half_m = (BOARD.width_m, BOARD.height_m)[side] / 2
    assert np.allclose(height, 0.005 * (1 - (flat[:, side] / half_m) ** 2), atol=3e-4)
    assert fit_plane(lifted)[1] > 0.001


@pytest.mark.parametrize("kind", list(KINDS))
def test_every_kind_gives_detections_of_every_capture(kind: str) -> None:
    case = KINDS[kind](SCANS, RIG, np.random.default_rng(1))
    assert set(case.images) == set(case.scans) == set(SCANS.scans)
    is_other_truth = not np.allclose(case.T_cam_lidar, T_FORWARD)
    moved = ("camera nudged half-way", "cameras swapped")
    assert is_other_truth == (kind in moved)
