"""reconstruct, as a user types it."""

import cv2
import numpy as np
import pytest

from lce_rig.core.data import Events
from tests.io.events.aedat4_files import write_aedat4


def recording(path, duration_s=1.2):
    """A vertical edge that sweeps over a small sensor and back, written as AEDAT4."""
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
    write_aedat4(path, [events])
    return path


def test_reconstruct_writes_images_stamps(lce_rig, tmp_path):
    outcome = lce_rig("reconstruct", recording(tmp_path / "sweep.aedat4"), "-o", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    lines = (tmp_path / "out" / "stamps.csv").read_text().splitlines()
    pictures = sorted(path.name for path in (tmp_path / "out").glob("*.png"))
    assert len(pictures) == len(lines) - 1 > 3
    assert cv2.imread(str(tmp_path / "out" / pictures[0])).shape == (48, 64, 3)
    assert "skipped" in outcome.err


@pytest.mark.parametrize(("duration_s", "words", "code"), [(0.1, (), 5), (1.2, ("--start", 60), 2)])
def test_reconstruct_too_short_is_refused(lce_rig, tmp_path, duration_s, words, code):
    path = recording(tmp_path / "short.aedat4", duration_s)
    assert lce_rig("reconstruct", path, "-o", tmp_path / "out", *words).code == code
    assert lce_rig("reconstruct", tmp_path, "-o", tmp_path / "out").code == 5, "no events in a folder"
    assert not (tmp_path / "out").exists()


def test_reconstruct_part_matches_whole(lce_rig, tmp_path):
    path = recording(tmp_path / "sweep.aedat4", 2.6)
    assert lce_rig("reconstruct", path, "-o", tmp_path / "whole").code == 0
    words = ["reconstruct", path, "-o", tmp_path / "part", "--start", 1.6, "--duration", 0.3]
    outcome = lce_rig(*words)
    assert outcome.code == 0, outcome.err
    assert "skipped" not in outcome.err
    part = stamps(tmp_path / "part")
    first_ns = int(part[0])
    assert len(part) == 6 and np.all(np.diff(part) == 50_000_000)
    whole = stamps(tmp_path / "whole")
    assert set(part) <= set(whole)
    twin = tmp_path / "whole" / f"{whole.index(first_ns):06d}.png"
    a, b = (cv2.imread(str(file)).astype(int) for file in (twin, tmp_path / "part" / "000000.png"))
    # Warmed up with other events and windows: similar, not equal.
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.7


def stamps(folder):
    return [int(line.split(",")[1]) for line in (folder / "stamps.csv").read_text().splitlines()[1:]]


def test_reconstruct_wild_stamp_is_refused(lce_rig, tmp_path):
    t_ns, places = np.array([0, 10**6, 10**18]), np.array([1, 2, 3], np.uint16)
    write_aedat4(tmp_path / "a.aedat4", [Events("events", t_ns, places, places, places > 1, 346, 260)])
    outcome = lce_rig("reconstruct", tmp_path / "a.aedat4", "-o", tmp_path / "out")
    assert outcome.code == 2
    assert "maximum 1000000" in outcome.err and "--duration" in outcome.err
