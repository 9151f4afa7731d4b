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
