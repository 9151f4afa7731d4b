"""reconstruct, as a user types it."""

import cv2
import numpy as np

from lce_rig.core.data import Events
from lce_rig.core.event_file import encode_events


def recording(path, duration_s=1.2):
    """A vertical edge that sweeps over a small sensor and back, written as npz."""
    rng = np.random.default_rng(0)
    n = int(200_000 * duration_s)
    t_us = np.sort(rng.integers(0, int(duration_s * 1e6), n))
    column = 30 + 25 * np.sin(2 * np.pi * t_us * 1e-6 * 2.0)
    moves_right = np.cos(2 * np.pi * t_us * 1e-6 * 2.0) > 0
    events = Events(
        "events",
        t_us.astype(np.int64) * 1000,
        np.clip(column + rng.normal(0, 0.4, n), 0, 63).astype(np.uint16),
        rng.integers(0, 48, n).astype(np.uint16),
        moves_right,
        64,
        48,
    )
    path.write_bytes(encode_events(events))
    return path


def test_pictures_and_their_stamps_are_written_and_the_warm_up_is_told(lce_rig, tmp_path):
    outcome = lce_rig("reconstruct", recording(tmp_path / "sweep.npz"), "-o", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    lines = (tmp_path / "out" / "stamps.csv").read_text().splitlines()
    pictures = sorted(path.name for path in (tmp_path / "out").glob("*.png"))
    assert len(pictures) == len(lines) - 1 > 3
    assert cv2.imread(str(tmp_path / "out" / pictures[0])).shape == (48, 64, 3)
    assert "pictures left out" in outcome.err


def test_the_event_map_needs_no_warm_up(lce_rig, tmp_path):
    words = ["reconstruct", recording(tmp_path / "sweep.npz"), "-o", tmp_path / "out", "--event-image", "map"]
    outcome = lce_rig(*words)
    assert outcome.code == 0, outcome.err
    assert "left out" not in outcome.err


def test_a_recording_too_short_to_settle_is_refused_and_nothing_is_written(lce_rig, tmp_path):
    outcome = lce_rig("reconstruct", recording(tmp_path / "short.npz", 0.1), "-o", tmp_path / "out")
    assert outcome.code == 5
    assert "too short" in outcome.err
    assert not (tmp_path / "out").exists()


def test_a_folder_without_events_is_refused_with_the_kinds_that_are_read(lce_rig, tmp_path):
    outcome = lce_rig("reconstruct", tmp_path, "-o", tmp_path / "out")
    assert outcome.code == 5
    assert ".aedat4" in outcome.err
