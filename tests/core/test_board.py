"""The board's frame, corners and edges."""

import numpy as np

from lce_rig.core.board import Board

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


def test_a_pattern_looks_the_same_turned_when_its_squares_add_up_to_an_even_number():
    assert BOARD.is_symmetric
    assert not Board(9, 6, 0.068, 0.8, 0.6).is_symmetric
