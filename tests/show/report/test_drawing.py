"""Drawings are small, link, take the page's colours, and are the same each time."""

import re

from lce_rig.show.report.drawing import BLUE, drawing, new_axes, style


def _bars(label: str = "bars"):
    with style():
        figure, (axes,) = new_axes(2.0)
        axes.set_title("<errors> & more")
        for bar in axes.bar([1, 2], [3, 4], color=BLUE):
            bar.set_url("#first")
        return drawing(figure, label)


def test_the_same_figure_gives_the_same_bytes():
    assert _bars() == _bars()


def test_it_names_no_address_and_no_font():
    text = _bars()
    assert "http" not in text and "font-family" not in text
    assert "_blank" not in text


def test_colours_are_the_page_s():
    text = _bars()
    assert "var(--blue)" in text
    assert not re.search(r"(fill|stroke): #", text)


def test_bars_link():
    assert _bars().count('xlink:href="#first"') == 2


def test_text_of_the_figure_and_its_label_are_escaped():
    text = _bars('a "label" <b>')
    assert "&lt;errors&gt; &amp; more" in text
    assert 'aria-label="a &#34;label&#34; &lt;b&gt;"' in text


def test_clipping_paths_of_two_drawings_have_different_names():
    names = [set(re.findall(r'<clipPath id="(\w+)"', _bars(label))) for label in ("one", "two")]
    assert names[0] and names[1] and not names[0] & names[1]
