"""Events over their pictures: where they fell, in the colour of their sign, and in animations."""

import numpy as np

from lce_rig.core.data import Events, Image
from lce_rig.show.overlays.debug_image import BRIGHTER, DARKER, draw_events, recent_events
from tests.show.overlays.test_pictures import FOLDING, grey

MS = 1_000_000
IMAGE = Image("cam", "events", 500 * MS, grey(FOLDING))


def events_at(t_ms, x, y, polarity):
    t_ns = np.rint(np.array(t_ms) * MS).astype(np.int64)
    columns = np.array(x, np.uint16), np.array(y, np.uint16), np.array(polarity, bool)
    return Events("cam", t_ns, *columns, FOLDING.width_px, FOLDING.height_px)


def coloured(picture, colour):
    """List the pixels (x, y) of the sensor that are drawn in a colour as a whole."""
    factor = picture.shape[1] // FOLDING.width_px
    small = picture[factor // 2 :: factor, factor // 2 :: factor]
    return {(int(x), int(y)) for y, x in np.argwhere(np.all(small == colour, axis=-1))}


def test_events_are_drawn_where_they_fell_in_the_colour_of_most_of_them():
    events = events_at(
        [1, 2, 3, 4, 5, 6], [10, 345, 20, 20, 20, 30], [5, 259, 40, 40, 40, 7], [1, 0, 0, 1, 0, 1]
    )
    picture, factor = draw_events(IMAGE, events)
    assert picture.shape == (260 * factor, 346 * factor, 3)
    assert coloured(picture, BRIGHTER) == {(10, 5), (30, 7)}
    assert coloured(picture, DARKER) == {(345, 259), (20, 40)}


def test_events_off_a_picture_that_was_cut_are_left_out():
    cut = Image("cam", "events", None, grey(FOLDING)[:250])
    picture, _ = draw_events(cut, events_at([1, 2], [3, 4], [255, 4], [True, True]))
    assert coloured(picture, BRIGHTER) == {(4, 4)}


def test_only_events_shortly_before_the_picture_are_taken_along():
    shown = recent_events(IMAGE, events_at([300, 420, 499, 501], [1, 2, 3, 4], [1] * 4, [True] * 4))
    assert shown.x.tolist() == [2, 3]
    n = 20_000
    storm = events_at(list(np.linspace(410, 499, n)), [7] * n, [7] * n, [True] * n)
    shown = recent_events(IMAGE, storm)
    assert len(shown) == round(0.06 * 346 * 260) and shown.t_ns[-1] == storm.t_ns[-1]
