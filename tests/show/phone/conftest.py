"""States of a collection, and a page that shows them."""

from urllib.parse import urlsplit

import numpy as np
import pytest

from lce_rig.collect.guidance.planner import Coverage
from lce_rig.collect.live.state import Cue, Drawing, LiveState, StreamState
from lce_rig.show.phone.preview import Preview

WIDTH_PX, HEIGHT_PX = 640, 360
PRESENT_PX = np.array([[100, 80], [200, 80], [200, 180], [100, 180], [100, 80]], float)
WANTED_PX = np.array([[400, 100], [560, 100], [560, 260], [400, 260], [400, 100]], float)


def picture(level=60):
    """Grey, with the board's place brighter: (360, 640, 3)."""
    pixels = np.full((HEIGHT_PX, WIDTH_PX, 3), level, np.uint8)
    pixels[80:180, 100:200] = 200
    return pixels


def state(**changes):
    """A collection in its middle."""
    given = {
        "rig": "rlfs",
        "session": "session",
        "elapsed_s": 83.4,
        "phase": "moving",
        "headline": "one step left, 0.5 m closer",
        "detail": "rotation 0.21° -> 0.15°",
        "hold_s": None,
        "n_captures": 7,
        "n_wanted": 15,
        "streams": (
            StreamState("cam.frames", 30.0, 0, True, "", "0.06 px"),
            StreamState("lidar", 10.0, 3, False, "2 rings, 4 are needed: lower it", ""),
        ),
        "drawing": Drawing("cam", picture(), PRESENT_PX, WANTED_PX),
        "coverage": Coverage(0.8, 0.4, 0.6, 0.5, 1.0),
        "sigma_deg": 0.2,
        "sigma_mm": 4.0,
        "target_deg": 0.1,
        "target_mm": 5.0,
        "cues": (Cue(1, "tick"), Cue(2, "captured")),
        "log": ("captured 000005", "captured 000006"),
        "notes": ("no trigger: boards must stand still",),
    }
    return LiveState(**(given | changes))


@pytest.fixture
def preview():
    """A page for this computer alone, on any free port."""
    with Preview(port=0) as opened:
        yield opened


def port_of(preview):
    return urlsplit(preview.urls[0]).port or 0
