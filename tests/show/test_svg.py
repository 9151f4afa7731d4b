"""Drawings as SVG: round ticks inside the limits, marks at their places, text escaped."""

import re

import numpy as np
import pytest

from lce_rig.show.svg import BLUE, BOTTOM, LEFT, RIGHT, TOP, WIDTH, Axes, padded, round_step, round_ticks


def _axes(x_limits=(0.0, 10.0), y_limits=(-1.0, 1.0), **options):
    return Axes(200.0, x_limits, y_limits, **({"x_label": "x, m", "y_label": "y, mm"} | options))


def _floats(text):
    return [float(each) for each in re.findall(r"-?[\d.]+", text)]


@pytest.mark.parametrize(
    ("span", "step"), [(5.0, 1.0), (5.01, 2.0), (10.0, 2.0), (1279.0, 500.0), (0.024, 0.005), (0.3, 0.1)]
)
def test_round_step_of_span_is_1_2_or_5(span, step):
    assert round_step(span) == pytest.approx(step)


def test_round_ticks_reach_both_ends():
    assert round_ticks(-0.1, 0.2, 0.1) == [
        (-0.1, "−0.1"), (0.0, "0.0"), (pytest.approx(0.1), "0.1"), (pytest.approx(0.2), "0.2"),
    ]  # fmt: skip


def test_round_ticks_near_zero_have_no_negative_zero():
    assert [label for _, label in round_ticks(-1e-12, 4.9, 2.0)] == ["0", "2", "4"]


@pytest.mark.parametrize("scale", [1e-4, 0.03, 1.0, 777.0, 2e5])
def test_round_ticks_of_any_limits_lie_inside(scale):
    low, high = -0.37 * scale, 1.13 * scale
    ticks = round_ticks(low, high, round_step(high - low))
    assert 2 <= len(ticks) <= 6
    assert all(low <= value <= high for value, _ in ticks)
    shown = [float(label.replace("−", "-")) for _, label in ticks]
    assert shown == pytest.approx([value for value, _ in ticks])


def test_padded_skips_nan_and_widens_equal_values():
    assert padded(np.array([0.0, np.nan]), np.array([[20.0]])) == (-1.0, 21.0)
    assert padded(np.array([3.0])) == (2.0, 4.0)
    assert padded(np.array([np.nan])) == (0.0, 1.0)
    assert padded(np.array([3, 4]), least=2.5) == (0.5, 6.5)


def test_limits_lie_at_the_corners_of_the_axes():
    corners = [[LEFT, 200 - BOTTOM], [WIDTH - RIGHT, TOP]]
    assert _axes().at([[0, -1], [10, 1]]) == pytest.approx(np.array(corners))
    # Descending limits mirror both axes.
    mirrored = _axes((10.0, 0.0), (1.0, -1.0))
    assert mirrored.at([[10, 1], [0, -1]]) == pytest.approx(np.array(corners))


def test_equal_axes_have_one_scale_and_square_cells():
    axes = _axes((0.0, 2.0), (0.0, 7.0), is_equal=True, grid="xy")
    (origin, right, up) = axes.at([[0, 0], [1, 0], [0, 1]])
    assert right[0] - origin[0] == pytest.approx(origin[1] - up[1])
    labels = re.findall(r"<text[^>]*>([^<]*)</text>", axes.markup("", "n"))
    assert labels == ["0", "1", "2", *"01234567", "x, m", "y, mm"]


def test_marks_lie_where_their_data_do():
    axes = _axes()
    middle = LEFT + (WIDTH - LEFT - RIGHT) / 2, TOP + (200 - TOP - BOTTOM) / 2
    axes.dots(np.array([[5.0, 0.0]]), BLUE, size=3)
    axes.linked_dots(np.array([[5.0, 0.0]]), BLUE, size=4, links=["#a"])
    axes.lines(np.array([[5.0, 0.0]]), np.array([[10.0, 1.0]]), BLUE)
    axes.polygons([np.array([[5.0, 0.0], [10.0, 1.0], [10.0, 0.0]])], BLUE, opacity=0.5, links=["#b"])
    text = axes.markup("", "n")
    (circle,) = re.findall(r'<a href="#a"><circle cx="([\d.]+)" cy="([\d.]+)" r="2.00"/></a>', text)
    assert tuple(map(float, circle)) == pytest.approx(middle, abs=0.01)
    (dot,) = re.findall(r'"M([\d. ]+)h0"', text)
    assert _floats(dot) == pytest.approx(middle, abs=0.01)
    line, shape = re.findall(r'<path d="(M[^"]*L[^"]*)"', text)
    assert _floats(line) == pytest.approx([*middle, WIDTH - RIGHT, TOP], abs=0.01)
    assert _floats(shape)[:4] == _floats(line) and len(_floats(shape)) == 6


@pytest.mark.parametrize("vector", [(3.0, 0.0), (0.0, -0.5), (0.01, 0.0), (0.0, 0.0)])
def test_arrows_point_from_tail_to_tip(vector):
    axes = _axes()
    axes.arrows(np.array([[5.0, 0.0]]), np.array([vector]), BLUE, unit=1.0, key="1 px")
    (path,) = re.findall(r'<g style="fill: [^"]*"><path d="([^"]*)"', axes.markup("", "n"))
    outline = np.array(_floats(path)).reshape(-1, 2)
    tail, tip = axes.at([[5.0, 0.0], np.add((5.0, 0.0), vector)])
    assert outline[[0, 6]].mean(axis=0) == pytest.approx(tail, abs=0.01)
    assert outline[3] == pytest.approx(tip, abs=0.01)


def test_text_is_escaped():
    axes = _axes(x_label="a < b & c")
    axes.linked_dots(np.zeros((1, 2)), BLUE, size=1, links=['#"><script>'])
    text = axes.markup('by "<ring>"', "n")
    assert "a &lt; b &amp; c" in text
    assert "<script" not in text and "<ring" not in text


def test_far_and_missing_marks_lie_outside():
    axes = _axes()
    axes.dots(np.array([[np.nan, 0.0], [np.inf, 0.0]]), BLUE, size=1)
    assert "nan" not in axes.markup("", "n") and "inf" not in axes.markup("", "n")
    axes.lines(np.array([[0.0, 0.0]]), np.array([[1e300, -1e300]]), BLUE)
    assert max(map(len, re.findall(r"\d+", axes.markup("", "n")))) <= 5


def test_the_same_marks_give_the_same_bytes():
    drawn = []
    for _ in range(2):
        axes = _axes(grid="y")
        axes.horizontal(0.0, BLUE)
        drawn.append(axes.markup("one", "n"))
    assert drawn[0] == drawn[1]
