"""Choice of the pose nearest to another image's, among those that fit an image of a board."""

import numpy as np
import pytest

from lce_rig.core.board import Board
from lce_rig.core.geometry import difference, perturb, pose, rotation_angle, transform
from lce_rig.core.planar_pose import mirror_tilt, solve_planar_pose
from lce_rig.detect.events.search import nearest_pose
from lce_rig.detect.image.search import board_from_pose
from tests.detect.drawn_boards import DAVIS

OBLONG = Board(9, 6, 0.068, 0.8, 0.6, pattern_offset_m=(0.03, -0.01))
SQUARE = Board(6, 6, 0.068, 0.6, 0.6)


def looking(tilt_rad=(0.3, -0.2, 0.4), position=(0.1, -0.05, 2.0)):
    faced = pose(np.diag([1.0, -1.0, -1.0]), np.array(position))
    return perturb(faced, np.array([0, 0, 0, *tilt_rad]))


def seen(board, T_cam_board, noise_px=0.0, seed=0):
    corners, _ = DAVIS.project(transform(T_cam_board, board.corners()))
    return solved(board, corners + noise_px * np.random.default_rng(seed).standard_normal(corners.shape))


def solved(board, corners_px):
    return board_from_pose(corners_px, solve_planar_pose(corners_px, board.corners(), DAVIS))


@pytest.mark.parametrize(("board", "n_quarters"), [(OBLONG, 2), (SQUARE, 1), (SQUARE, 2), (SQUARE, 3)])
def test_turned_board_has_the_same_pose(board, n_quarters):
    reference = seen(board, looking(), 0.1)
    # A tenth of a second later the board has moved and rotated a little.
    later = seen(board, perturb(looking(), np.array([0.02, 0.01, 0.0, 0.05, -0.04, 0.03])), 0.1, seed=1)
    turned = np.rot90(later.corners_px.reshape(board.rows, board.cols, 2), n_quarters).reshape(-1, 2)
    from_elsewhere = solved(board, turned)
    assert rotation_angle(from_elsewhere.T_cam_board[:3, :3], later.T_cam_board[:3, :3]) > 1.5
    T, cov = nearest_pose(from_elsewhere, reference.T_cam_board, board, DAVIS)
    np.testing.assert_allclose(T, later.T_cam_board, atol=1e-6)
    np.testing.assert_allclose(cov, later.cov, rtol=1e-4, atol=1e-12)


def test_nearest_pose_takes_its_covariance():
    truth = looking((0.3, -0.25, 0.4), (0.0, 0.0, 3.5))
    found = seen(OBLONG, truth, 0.2)
    assert found.T_cam_board_alternative is not None
    mirrored = mirror_tilt(truth, OBLONG.corners().mean(axis=0))
    T, cov = nearest_pose(found, truth, OBLONG, DAVIS)
    T_other, cov_other = nearest_pose(found, mirrored, OBLONG, DAVIS)
    assert rotation_angle(T[:3, :3], truth[:3, :3]) < rotation_angle(T_other[:3, :3], truth[:3, :3])
    # The errors of many noisy pictures, each about the pose chosen in it, are what the covariance says.
    errors = []
    for seed in range(60):
        again = seen(OBLONG, truth, 0.2, seed)
        errors.append(difference(nearest_pose(again, mirrored, OBLONG, DAVIS)[0], T_other))
    assert np.std(errors, axis=0) == pytest.approx(np.sqrt(np.diag(cov_other)), rel=0.35)
    assert cov.shape == cov_other.shape == (6, 6)
