"""The board's frame, corners and edges."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lce_rig.core.board import Board
from lce_rig.core.pattern import dark_rectangles, is_dark, markers_of

BOARD = Board(cols=8, rows=6, square_m=0.07, width_m=0.767, height_m=0.626, pattern_offset_m=(0.002, -0.001))


def test_corners_run_in_rows_from_top_left():
    corners = BOARD.corners()
    assert corners.shape == (48, 3)
    np.testing.assert_allclose(corners.mean(axis=0), [0.002, -0.001, 0], atol=1e-12)
    np.testing.assert_allclose(corners[1] - corners[0], [0.07, 0, 0], atol=1e-12)
    np.testing.assert_allclose(corners[8] - corners[0], [0, -0.07, 0], atol=1e-12)


CHARUCO = replace(BOARD, type="charuco", marker_share=0.75, dictionary="5X5_100")
APRILGRID = Board(
    8, 6, 0.13, 0.767, 0.626, (0.01, -0.02), "aprilgrid", gap_share=0.3, dictionary="APRILTAG_36h11"
)


@pytest.mark.parametrize("board", [BOARD, CHARUCO, APRILGRID], ids=lambda board: board.type)
def test_pattern_dark_areas_meet_at_corners(board):
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (4000, 2))
    left, lower, width, height = dark_rectangles(board).T
    x, y = points[:, :1], points[:, 1:]
    is_in = (x > left) & (x < left + width) & (y > lower) & (y < lower + height)
    np.testing.assert_array_equal(is_dark(board, points), is_in.any(axis=1))
    corners, sign = board.corners()[:, :2], (-1) ** np.indices((board.rows, board.cols)).sum(axis=0).ravel()
    for step, dark in (([-1, 1], sign > 0), ([1, -1], sign > 0), ([1, 1], sign < 0), ([-1, -1], sign < 0)):
        np.testing.assert_array_equal(is_dark(board, corners + np.array(step) * 0.003), dark)


def test_a_charuco_board_is_printed_as_opencv_draws_it():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    drawn = cv2.aruco.CharucoBoard((9, 7), 0.07, 0.0525, dictionary).generateImage((504, 392))
    u, v = np.meshgrid((np.arange(504) + 0.5) / 800, (np.arange(392) + 0.5) / 800)
    points = np.stack([u - 0.315, 0.245 - v], axis=-1) + BOARD.pattern_offset_m
    np.testing.assert_array_equal(is_dark(CHARUCO, points), drawn < 128)


def test_an_aprilgrid_counts_its_tags_as_kalibr_does():
    markers = markers_of(APRILGRID)
    assert markers.ids.tolist() == list(range(12))
    centres = markers.corners.mean(axis=1)[:, :2] - APRILGRID.pattern_offset_m
    pitch = 1.3 * 0.13
    np.testing.assert_allclose(centres[0], [-1.5 * pitch, -pitch])
    np.testing.assert_allclose(centres[1] - centres[0], [pitch, 0], atol=1e-12)
    np.testing.assert_allclose(centres[4] - centres[0], [0, pitch], atol=1e-12)
    # Tag 0 of the family 36h11, from the upper left, within a border of two modules.
    bits = [0xD5D628584 >> (35 - k) & 1 for k in range(36)]
    np.testing.assert_array_equal(markers.is_white[0, 2:8, 2:8].ravel(), bits)
    np.testing.assert_allclose(markers.corners.min(axis=(0, 1)), APRILGRID.corners().min(axis=0), atol=1e-12)
