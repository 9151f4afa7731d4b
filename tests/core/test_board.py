"""The board's frame, corners and edges."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lce_rig.core.board import Board
from lce_rig.core.pattern import dark_rectangles, is_dark, markers_of

BOARD = Board(cols=8, rows=6, square_m=0.07, width_m=0.767, height_m=0.626, pattern_offset_m=(0.002, -0.001))


def test_corners_run_row_by_row_from_the_top_left_around_the_pattern_offset():
    corners = BOARD.corners()
    assert corners.shape == (48, 3)
    np.testing.assert_allclose(corners.mean(axis=0), [0.002, -0.001, 0], atol=1e-12)
    np.testing.assert_allclose(corners[1] - corners[0], [0.07, 0, 0], atol=1e-12)
    np.testing.assert_allclose(corners[8] - corners[0], [0, -0.07, 0], atol=1e-12)


def test_the_outline_is_counter_clockwise_around_the_normal():
    outline = BOARD.outline()
    area = np.cross(outline[1] - outline[0], outline[2] - outline[1])
    np.testing.assert_allclose(area, [0, 0, 0.767 * 0.626])


def test_every_edge_lies_on_the_outline_with_its_normal_outwards():
    points, normals = BOARD.edges()
    for k in range(4):
        side = np.roll(BOARD.outline(), -k, axis=0)[:2]
        np.testing.assert_allclose((side - points[k]) @ normals[k], 0, atol=1e-12)
        assert points[k] @ normals[k] > 0


def test_the_distance_from_the_outline_counts_inside_outside_and_beyond_a_corner():
    w, h = BOARD.width_m / 2, BOARD.height_m / 2
    points = np.array(
        [[w - 0.01, 0, 0], [w + 0.02, 0, 0.5], [0, -h + 0.03, 0], [w + 0.03, h + 0.04, 0], [0, 0, 0]]
    )
    np.testing.assert_allclose(BOARD.outline_distance(points), [0.01, 0.02, 0.03, 0.05, h], atol=1e-12)


def test_the_nearest_edge_is_the_one_that_holds_the_nearest_point_of_the_outline():
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (500, 2))
    middles, normals = BOARD.edges()
    edge = BOARD.nearest_edge(points)
    inside = np.sum((middles[edge, :2] - points) * normals[edge, :2], axis=1)
    np.testing.assert_allclose(BOARD.inside_nearest_edge(points), inside, atol=1e-12)
    outline = BOARD.outline()[:, :2]
    ways = np.roll(outline, -1, axis=0) - outline
    along = np.sum((points[:, None] - outline) * ways, axis=2) / np.sum(ways**2, axis=1)
    feet = outline + np.clip(along, 0, 1)[..., None] * ways
    distances = np.linalg.norm(points[:, None] - feet, axis=2)
    nearest = np.take_along_axis(distances, BOARD.nearest_edge(points)[:, None], axis=1)[:, 0]
    np.testing.assert_allclose(nearest, distances.min(axis=1), atol=1e-12)
    np.testing.assert_allclose(nearest, BOARD.outline_distance(points), atol=1e-12)
    assert BOARD.nearest_edge(np.array([1.0, 1.0])) == 2


CHARUCO = replace(BOARD, type="charuco", marker_share=0.75, dictionary="5X5_100")
APRILGRID = Board(
    8, 6, 0.13, 0.767, 0.626, (0.01, -0.02), "aprilgrid", gap_share=0.3, dictionary="APRILTAG_36h11"
)


@pytest.mark.parametrize("board", [BOARD, CHARUCO, APRILGRID], ids=lambda board: board.type)
def test_the_print_is_its_dark_rectangles_and_has_a_crossing_at_every_corner(board):
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
