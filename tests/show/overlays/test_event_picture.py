"""Events over their images."""

import numpy as np

from lce_rig.core.data import Events, Image
from lce_rig.show.overlays.debug_image import recent_events
from tests.show.overlays.test_pictures import FOLDING, grey

MS = 1_000_000
IMAGE = Image("cam", "events", 500 * MS, grey(FOLDING))


def events_at(t_ms, x, y, polarity):
    t_ns = np.rint(np.array(t_ms) * MS).astype(np.int64)
    columns = np.array(x, np.uint16), np.array(y, np.uint16), np.array(polarity, bool)
    return Events("cam", t_ns, *columns, FOLDING.width_px, FOLDING.height_px)


def test_recent_events_are_just_before_image():
    shown = recent_events(IMAGE, events_at([300, 420, 499, 501], [1, 2, 3, 4], [1] * 4, [True] * 4))
    assert shown.x.tolist() == [2, 3]
    n = 20_000
    storm = events_at(list(np.linspace(410, 499, n)), [7] * n, [7] * n, [True] * n)
    shown = recent_events(IMAGE, storm)
    assert len(shown) == round(0.06 * 346 * 260) and shown.t_ns[-1] == storm.t_ns[-1]
