"""Text in drawings is escaped, and drawings of one page do not share names."""

import re

from lce_rig.show.report.page import BLUE, drawing, new_axes, style


def _bars(label: str = "bars"):
    with style():
        figure, (axes,) = new_axes(2.0)
        axes.set_title("<errors> & more")
        for bar in axes.bar([1, 2], [3, 4], color=BLUE):
            bar.set_url("#first")
        return drawing(figure, label)


def test_text_of_the_figure_and_its_label_are_escaped():
    text = _bars('a "label" <b>')
    assert "&lt;errors&gt; &amp;" in text
    assert "&#34;label&#34; &lt;b&gt;" in text


def test_clipping_paths_of_two_drawings_have_different_names():
    names = [set(re.findall(r'<clipPath id="(\w+)"', _bars(label))) for label in ("one", "two")]
    assert names[0] and names[1] and not names[0] & names[1]
