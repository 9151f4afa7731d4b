"""Events of a short time as a field of the edges that passed."""

import numpy as np

from lce_rig.core.data import Events
from lce_rig.scene.edge_field import build_event_field

FOCAL_PX, WIDTH, HEIGHT = 250.0, 346, 260


def events_at(x, y):
    n = len(x)
    on = np.ones(n, dtype=np.bool_)
    return Events("cam", np.arange(n), x.astype(np.uint16), y.astype(np.uint16), on, WIDTH, HEIGHT)


def test_an_edge_that_moved_stands_out_and_is_near_its_pixels_only():
    y = np.repeat(np.arange(HEIGHT), 3)
    field = build_event_field(events_at(np.full(len(y), 200), y), FOCAL_PX)
    at, beside, far = field.sample(np.array([[200.0, 130.0], [206.0, 130.0], [40.0, 130.0]]))
    assert at > 1.0 > beside and abs(far) < 1e-6
    near = field.has_edges_near(np.array([[210.0, 130.0], [40.0, 130.0], [-500.0, 0.0]]), 15.0)
    assert near.tolist() == [True, False, False]


def test_no_events_are_no_edges():
    none = np.zeros(0)
    field = build_event_field(events_at(none, none), FOCAL_PX)
    assert not field.values.any()
