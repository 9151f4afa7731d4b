"""The pictures of the documentation follow the profile that they show."""

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
from figures.board import draw_board

from lce_rig.rig import load_rig


def test_the_drawn_board_has_the_profiles_dimensions():
    figure = draw_board(load_rig("rles"))
    words = " ".join(text.get_text() for axes in figure.axes for text in axes.texts)
    plt.close(figure)
    for figure_in_words in ("square_m 0.068", "width_m 0.800", "height_m 0.600", "[9, 6]"):
        assert figure_in_words in words
