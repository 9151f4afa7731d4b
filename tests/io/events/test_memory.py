"""Recordings of events are read in little memory."""

import tracemalloc
from pathlib import Path

from lce_rig.core.data import Events
from lce_rig.io.events import open_events
from lce_rig.io.events.aedat4 import write_aedat4
from tests.io.events.encoders import random_events


def test_a_long_recording_is_never_in_memory_as_a_whole(tmp_path: Path) -> None:
    piece = random_events(20_000, 1)
    span_ns = int(piece.t_ns[-1])
    pieces = (
        Events("", piece.t_ns + i * span_ns, piece.x, piece.y, piece.polarity, 346, 260) for i in range(150)
    )
    write_aedat4(tmp_path / "a.aedat4", pieces)
    recording = open_events(tmp_path / "a.aedat4")
    tracemalloc.start()
    n_events = sum(map(len, recording))
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert n_events == 3_000_000
    assert peak_bytes < 0.3 * n_events * 13
