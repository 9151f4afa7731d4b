"""Boards of two sensors: access to an image or a scan checks the kind of sensor."""

import numpy as np
import pytest

from lce_rig.core.results import BoardPose, ImageBoard, LidarBoard, Observation, PatternBoard
from tests.calibrate.boards import BOARD, simulate


def test_observation_of_lidars_has_no_image():
    seen = simulate(1, 0)[0]
    pair = Observation("a", BoardPose(seen.pose.T_cam_board, seen.pose.cov, None, np.inf), seen.surface)
    assert isinstance(pair.lidar, LidarBoard) and not isinstance(pair.pose, ImageBoard)
    with pytest.raises(TypeError, match="a: the first sensor is not a camera"):
        _ = pair.image


def test_observation_of_cameras_has_no_scan():
    seen = simulate(1, 0)[0]
    pair = Observation("a", seen.pose, PatternBoard.of(seen.image, BOARD.corners()))
    assert isinstance(pair.image, ImageBoard) and not isinstance(pair.surface, LidarBoard)
    with pytest.raises(TypeError, match="a: the second sensor is not a LiDAR"):
        _ = pair.lidar


def test_pattern_board_corners_lie_in_its_plane():
    image = simulate(1, 0)[0].image
    board = PatternBoard.of(image, BOARD.corners())
    assert len(board.points) == len(BOARD.corners())
    assert np.allclose(board.points @ board.plane[:3] + board.plane[3], 0.0, atol=1e-12)
    assert board.plane[3] > 0
