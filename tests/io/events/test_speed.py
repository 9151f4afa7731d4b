"""Readers keep up with cameras: five million events a second from every binary format, in little memory."""

import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lce_rig.core.data import Events
from lce_rig.io.events import open_events
from lce_rig.io.events.aedat4_writer import write_aedat4
from tests.io.events import encoders
from tests.io.events.bags import write_packet_bag
from tests.io.events.encoders import Event, listed, random_events
from tests.io.events.test_files import WRITERS

MIN_EVENTS_PER_S = 5e6
N_PACKET = 5000

PAYLOADS: dict[str, Callable[[list[Event]], bytes]] = {
    "evt3": encoders.evt3,
    "libcaer": lambda piece: encoders.libcaer(piece, piece[0][0]),
    "libcaer_cmp": lambda piece: encoders.libcaer_cmp(piece, piece[0][0]),
    "mono": lambda piece: encoders.mono(piece, piece[0][0] * 1000),
}
RAW: dict[str, Callable[[list[Event]], bytes]] = {
    "EVT2": encoders.evt2,
    "EVT3": encoders.evt3,
}


@pytest.fixture(scope="module")
def events() -> Events:
    return random_events(200_000, 1, start_us=1_700_000_000_000_000)


def rate_hz(path: Path, n_events: int) -> float:
    """Events a second of one core, the best of five: the machine may be busy with others."""
    recording = open_events(path)
    best_s = np.inf
    for _ in range(5):
        start_s = time.process_time()
        assert sum(map(len, recording)) == n_events
        best_s = min(best_s, time.process_time() - start_s)
    return n_events / best_s


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(WRITERS) - {"a.txt", "a.zip", "a.raw"}))
def test_files_and_event_arrays_are_read_fast(tmp_path: Path, events: Events, name: str) -> None:
    WRITERS[name](tmp_path / name, events)
    assert rate_hz(tmp_path / name, len(events)) > MIN_EVENTS_PER_S


@pytest.mark.slow
@pytest.mark.parametrize("version", sorted(RAW))
def test_raw_files_are_read_fast(tmp_path: Path, events: Events, version: str) -> None:
    head = f"% format {version};height=260;width=346\n% end\n"
    (tmp_path / "a.raw").write_bytes(head.encode() + RAW[version](listed(events)))
    assert rate_hz(tmp_path / "a.raw", len(events)) > MIN_EVENTS_PER_S


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.bag", "ros2"])
@pytest.mark.parametrize("encoding", sorted(PAYLOADS))
def test_packets_are_read_fast(tmp_path: Path, events: Events, name: str, encoding: str) -> None:
    truth = listed(events)
    messages = []
    for i in range(0, len(truth), N_PACKET):
        piece = truth[i : i + N_PACKET]
        base_ns = 0 if encoding == "evt3" else piece[0][0] * 1000
        payload = PAYLOADS[encoding](piece)
        data = encoders.packet(
            payload, encoding, is_ros1=name == "a.bag", number=i // N_PACKET, base_ns=base_ns
        )
        messages.append(("/events", piece[0][0] * 1000, data))
    path = write_packet_bag(tmp_path / name, messages)
    assert rate_hz(path, len(truth)) > MIN_EVENTS_PER_S


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
