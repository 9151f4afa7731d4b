import pytest
from benchmarks.measured import MEASURED, measure
from figures_page import fill

FIGURES = {
    "a.rms": {"value": [0.0162, 0.7], "unit": "{:.3f} deg, {:.1f} mm"},
    "a.used": {"value": [18, 20], "unit": "{} of {}"},
}


def test_fill_figure_in_a_sentence_is_replaced():
    text = "rms <!-- figure: a.rms -->old<!-- / -->, <!-- figure: a.used --><!-- / -->."
    filled = (
        "rms <!-- figure: a.rms -->0.016 deg, 0.7 mm<!-- / -->, <!-- figure: a.used -->18 of 20<!-- / -->."
    )
    assert fill(text, FIGURES) == filled
    assert fill(filled, FIGURES) == filled


@pytest.mark.parametrize("mark", ["a: used, -, rms", "a.used, -, a.rms"])
def test_fill_row_leaves_other_cells(mark):
    head = f"| label <!-- row: {mark} -->"
    row = f"{head} | | kept | old | last |\n"
    assert fill(row, FIGURES) == f"{head} | 18 of 20 | kept | 0.016 deg, 0.7 mm | last |\n"


def test_fill_unknown_key_is_an_error():
    with pytest.raises(KeyError, match=r"b\.rms"):
        fill("<!-- figure: b.rms --><!-- / -->", FIGURES)


def test_measure_keeps_a_plain_key_and_few_digits():
    measure("wrong.Focal length 2 % too long.rms", "{:.1f} mm", 1 / 3)
    assert MEASURED["wrong.focal-length-2-too-long.rms"] == ([0.333333], "{:.1f} mm")
