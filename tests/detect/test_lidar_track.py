"""Search for the board near a pose: from the previous scan, or predicted from an image."""

import numpy as np
import pytest
from scans import BOARD, board_plate, cast, person, place, room

from lce_rig.core.findings import Refusal
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.detect.lidar.search import Limits, find_lidar_boards, look_for_board

LIMITS = Limits(beam=Beam(0.0, 0.0))


def view(T, seed=0):
    return cast([board_plate(T), *person(T, 0.2), *room(13.0)], sigma_m=0.008, seed=seed)


def test_moving_board_is_tracked_in_every_scan():
    board = find_lidar_boards(view(place(2.5, 170)), BOARD, LIMITS)[0]
    for k in range(1, 12):
        T = place(2.5 - 0.04 * k, 170 + 1.5 * k, 45 + 2 * k, 3 * k)
        board = look_for_board(view(T, seed=k), BOARD, board.T_lidar_board, LIMITS)
        assert np.linalg.norm(board.T_lidar_board[:3, 3] - T[:3, 3]) < 0.03


def test_tracked_board_equals_full_search():
    found_deg, tracked_deg = [], []
    for seed in range(8):
        T = place(2.0 + 0.1 * seed, 40 - 10 * seed, 35, 25, 15)
        previous = find_lidar_boards(view(T, seed=100 + seed), BOARD, LIMITS)[0]
        full = find_lidar_boards(view(T, seed=seed), BOARD, LIMITS)[0]
        tracked = look_for_board(view(T, seed=seed), BOARD, previous.T_lidar_board, LIMITS)
        for errors, board in ((found_deg, full), (tracked_deg, tracked)):
            errors.append(np.degrees(np.linalg.norm(np.cross(board.plane[:3], T[:3, 2]))))
    assert np.sqrt(np.mean(np.square(tracked_deg))) < 1.1 * np.sqrt(np.mean(np.square(found_deg)))


@pytest.mark.parametrize("off_m", [0.0, 0.05])
def test_predicted_board_is_found(off_m):
    T = place(2.6, 60, 20, 15)
    T_predicted = T.copy()
    T_predicted[:3, 3] += off_m * T[:3, 0]
    found = look_for_board(view(T), BOARD, T_predicted, LIMITS)
    assert np.linalg.norm(found.T_lidar_board[:3, 3] - T[:3, 3]) < 0.02


def test_predicted_without_board_is_refused():
    T = place(2.6, 60, 20, 15)
    # On a wall, in the air, and where a plate of another size stands.
    for shapes in (room(5.4), room(13.0), [board_plate(T, scale=1.4), *room(13.0)]):
        refusal = look_for_board(cast(shapes, sigma_m=0.008), BOARD, T, LIMITS)
        assert refusal.code in ("lidar.not_where_expected", "lidar.nothing_where_expected")
    # A board elsewhere is not mistaken for the predicted one.
    refusal = look_for_board(view(place(2.6, 66, 20, 15)), BOARD, T, LIMITS)
    assert isinstance(refusal, Refusal)


def test_a_prediction_of_a_scan_without_returns_is_refused():
    empty = view(place(2.6, 60)).select(np.zeros(0, dtype=np.intp))
    refusal = look_for_board(empty, BOARD, place(2.6, 60), LIMITS)
    assert isinstance(refusal, Refusal) and refusal.code == "lidar.not_where_expected"
