"""Events of a short time as a field of the edges that passed."""

import numpy as np

from lce_rig.core.data import Events
from lce_rig.scene.edge_pyramid import build_event_pyramid

FOCAL_PX, WIDTH, HEIGHT = 250.0, 346, 260


def events_at(x, y):
    n = len(x)
    on = np.ones(n, dtype=np.bool_)
    return Events("cam", np.arange(n), x.astype(np.uint16), y.astype(np.uint16), on, WIDTH, HEIGHT)


def test_moved_edge_stands_out_near_its_pixels_only():
    y = np.repeat(np.arange(HEIGHT), 3)
    pyramid = build_event_pyramid(events_at(np.full(len(y), 200), y), FOCAL_PX)
    upright, _ = pyramid.levels[-1]
    at, beside, far = upright.sample(np.array([[200.0, 130.0], [206.0, 130.0], [40.0, 130.0]]))[:, 0]
    assert at > 1.0 > beside and abs(far) < 1e-6
    near = pyramid.has_edges_near(np.array([[210.0, 130.0], [40.0, 130.0], [-500.0, 0.0]]), 15.0)
    assert near.tolist() == [True, False, False]


def test_no_events_are_no_edges():
    none = np.zeros(0)
    pyramid = build_event_pyramid(events_at(none, none), FOCAL_PX)
    assert not any(layer.values.any() for pair in pyramid.levels for layer in pair)
