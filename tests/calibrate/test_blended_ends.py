"""Ring ends before something close behind: by how much the board ends sooner there is found and made good."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import CalibrateOptions, calibrate
from lce_rig.core.geometry import difference
from tests.calibrate.boards import BOARD, T_FORWARD, simulate

OPTIONS = CalibrateOptions(n_draws=0)


def held(capture, sooner_m, is_behind):
    """Let a person stand behind ring ends of one capture: the board ends sooner there."""
    lidar = capture.lidar[0]
    axis = lidar.T_lidar_board[:3, :2]
    local = (lidar.edge_points - lidar.T_lidar_board[:3, 3]) @ axis
    beyond = np.abs(local) - [BOARD.width_m / 2, BOARD.height_m / 2]
    nearest = np.argmax(beyond, axis=1)
    outwards = np.sign(np.take_along_axis(local, nearest[:, None], axis=1)) * axis.T[nearest]
    ends = lidar.edge_points - sooner_m * is_behind[:, None] * outwards
    return replace(
        capture,
        lidar=[replace(lidar, edge_points=ends, edge_behind_m=np.where(is_behind, 0.2, np.inf))],
    )


def sides(captures, pick):
    return [held(c, 0.008, pick(k, c.lidar[0].edge_side)) for k, c in enumerate(captures)]


def error_m(captures):
    return float(np.linalg.norm(difference(calibrate(captures, BOARD, OPTIONS).T_cam_lidar, T_FORWARD)[:3]))


def test_what_the_board_ends_sooner_before_a_person_is_found_and_made_good():
    captures = sides(simulate(20, 3), lambda k, side: (side > 0) & (k % 4 != 0))
    found = calibrate(captures, BOARD, OPTIONS)
    assert found.diagnostics["blended_ends_sooner_m"] == pytest.approx(0.008, abs=0.003)
    unaware = [
        replace(c, lidar=[replace(c.lidar[0], edge_behind_m=np.full(len(c.lidar[0].edge_side), np.inf))])
        for c in captures
    ]
    corrected, as_measured = error_m(captures), error_m(unaware)
    assert corrected < 0.002
    assert corrected < 0.6 * as_measured


def test_a_few_such_ring_ends_are_left_as_they_are():
    captures = sides(simulate(12, 1), lambda k, side: (side > 0) & (k == 0))
    assert calibrate(captures, BOARD, OPTIONS).diagnostics["blended_ends_sooner_m"] == 0


def test_clean_edges_are_left_as_they_are():
    assert calibrate(simulate(12, 1), BOARD, OPTIONS).diagnostics["blended_ends_sooner_m"] == 0
