"""Outlines of where the board is and should be, and instructions, in a picture."""

import numpy as np

from lce_rig.verify.guidance_picture import draw_guidance

HERE = np.array([[100, 100], [160, 100], [160, 150], [100, 150], [100, 100]], dtype=np.float64)


def test_nothing_to_draw_leaves_the_picture_as_it_is():
    pixels = np.full((720, 1280, 3), 90, dtype=np.uint8)
    np.testing.assert_array_equal(draw_guidance(pixels, None, None), pixels)


def test_both_outlines_lie_where_they_belong_in_an_enlarged_picture():
    pixels = np.zeros((260, 346), dtype=np.uint8)
    drawn = draw_guidance(pixels, HERE + [120, 40], HERE)
    assert drawn.shape == (780, 1038, 3)
    for outline in (HERE, HERE + [120, 40]):
        for u, v in outline:
            around = drawn[int(3 * v) - 6 : int(3 * v) + 9, int(3 * u) - 6 : int(3 * u) + 9]
            assert around.max() > 200
    assert drawn[3 * 200, 3 * 60].max() == 0


def test_being_there_looks_different():
    pixels = np.zeros((720, 1280), dtype=np.uint8)
    away, there = (draw_guidance(pixels, HERE, HERE, is_there=flag) for flag in (False, True))
    assert np.any(away != there)
    green = there[100, 120]
    assert green[1] > 150
    assert green[1] > green[0] + 50


def test_instructions_are_written_below_one_another():
    pixels = np.full((720, 1280), 200, dtype=np.uint8)
    one = draw_guidance(pixels, None, None, ["one step left"])
    two = draw_guidance(pixels, None, None, ["one step left", "raise it 20 cm"])
    rows_one, rows_two = (np.flatnonzero(np.any(each != 200, axis=(1, 2))) for each in (one, two))
    assert rows_two.max() > rows_one.max() + 30


def test_an_outline_that_leaves_the_lens_is_interrupted():
    pixels = np.zeros((720, 1280), dtype=np.uint8)
    broken = HERE.copy()
    broken[2] = np.nan
    assert draw_guidance(pixels, broken, HERE).any()
