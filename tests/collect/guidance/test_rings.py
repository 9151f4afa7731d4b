"""Rings on a board, worked out beforehand, against a scan of it."""

import numpy as np

from lce_rig.collect.guidance.evidence import cross_board
from lce_rig.core.geometry import invert, transform
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, scan_board
from tests.collect.guidance.boards import model, placements


def test_rings_and_their_points_are_those_of_a_scan():
    poses = invert(T_FORWARD) @ placements(20, seed=1)
    rings = cross_board(model(), poses)
    rng = np.random.default_rng(2)
    for k, T_lidar_board in enumerate(poses):
        scan = scan_board(T_lidar_board, rng, Scenario(range_sigma_m=0.0), BOARD)
        counts = np.bincount(scan.ring, minlength=16)
        is_long = counts > 10
        # One more or less at either end, and what lies between two samples of the prediction.
        assert np.all(np.abs(rings.n_points[k] - counts)[is_long] <= 2 + 0.05 * counts[is_long])


def test_rings_end_where_a_scan_s_rings_end():
    poses = invert(T_FORWARD) @ placements(20, seed=3)
    rings = cross_board(model(), poses)
    rng = np.random.default_rng(4)
    for k, T_lidar_board in enumerate(poses):
        scan = scan_board(T_lidar_board, rng, Scenario(range_sigma_m=0.0), BOARD)
        ends = transform(invert(T_lidar_board), scan.edge_points)[:, :2]
        step_m = rings.spacing_m[k, scan.edge_ring]
        predicted = rings.ends[k, scan.edge_ring]
        miss = np.linalg.norm(predicted - ends[:, None], axis=-1).min(axis=1)
        assert np.all(miss <= 1.5 * step_m + 0.02)


def test_a_board_outside_the_vertical_field_has_no_rings():
    above = np.eye(4)
    above[:3, :3] = [[0, 0, -1], [-1, 0, 0], [0, 1, 0]]
    above[:3, 3] = [2.0, 0.0, 2.0]
    assert cross_board(model(), above[None]).n_rings[0] == 0


def test_no_boards_have_no_rings():
    assert cross_board(model(), np.zeros((0, 4, 4))).n_points.shape == (0, 16)
