"""Recordings of real cameras by others, against the makers' own library or a decoder word by word."""

from pathlib import Path

import numpy as np
import pytest

from lce_rig.io.events import open_events
from lce_rig.io.ros.bag_file import BagFile
from lce_rig.io.ros.event_messages import parse_packet

pytestmark = pytest.mark.dataset


@pytest.fixture
def folder(recordings: Path) -> Path:
    if not (recordings / "events").is_dir():
        pytest.skip("no recordings of events")
    return recordings / "events"


def columns(path: Path) -> tuple[np.ndarray, ...]:
    stretches = list(open_events(path))
    return tuple(
        np.concatenate([getattr(stretch, name) for stretch in stretches])
        for name in ("t_ns", "x", "y", "polarity")
    )


@pytest.mark.parametrize("name", ["davis346_short.aedat4", "dvs_320x240.aedat4"])
def test_aedat4_is_read_as_its_makers_read_it(folder: Path, name: str) -> None:
    dv = pytest.importorskip("dv_processing")
    recording = dv.io.MonoCameraRecording(str(folder / name))
    batches = []
    while (batch := recording.getNextEventBatch()) is not None:
        batches.append(batch.numpy().copy())
    truth = np.concatenate(batches)
    t_ns, x, y, polarity = columns(folder / name)
    assert np.array_equal(t_ns, truth["timestamp"] * 1000)
    assert np.array_equal(x, truth["x"])
    assert np.array_equal(y, truth["y"])
    assert np.array_equal(polarity, truth["polarity"].astype(bool))


def test_a_real_drivers_compressed_packets_are_read_as_word_by_word(folder: Path) -> None:
    path = folder / "davis346_apriltag_libcaer_cmp.mcap"
    found = []
    for message in BagFile(path).messages({"/event_camera/events"}):
        packet = parse_packet(message)
        found += compressed_word_by_word(packet.payload.tobytes(), packet.time_base_ns // 1000)
    truth = np.array(found)
    t_ns, x, y, polarity = columns(path)
    order = np.argsort(truth[:, 0], kind="stable")
    assert len(t_ns) == 571_266
    assert np.array_equal(t_ns // 1000, truth[order, 0])
    assert np.array_equal(np.stack([x, y, polarity], axis=1), truth[order, 1:])


@pytest.mark.parametrize(
    ("name", "n", "duration_s"),
    [("event_packet_ros1.bag", 343_474, 2.078), ("evt3_pedestrians.raw", 5000, 0.045)],
)
def test_evt3_is_read_as_word_by_word(folder: Path, name: str, n: int, duration_s: float) -> None:
    path = folder / name
    if path.suffix == ".bag":
        messages = BagFile(path).messages({"/event_camera/events"})
        data = b"".join(parse_packet(m).payload.tobytes() for m in messages)
    else:
        data = path.read_bytes()
        while data.startswith(b"%"):
            data = data[data.index(b"\n") + 1 :]
    truth = np.array(evt3_word_by_word(data))
    t_ns, x, y, polarity = columns(path)
    assert len(t_ns) == n
    assert np.ptp(open_events(path).span_ns) * 1e-9 == pytest.approx(duration_s, abs=5e-3)
    assert np.array_equal(np.stack([t_ns // 1000, x, y, polarity], axis=1), truth)


def compressed_word_by_word(data: bytes, base_us: int) -> list[tuple[int, int, int, int]]:
    high = low = x = base = polarity = 0
    events = []
    for word in np.frombuffer(data, "<u2").tolist():
        code, rest = word >> 12, word & 0xFFF
        if code == 0:
            high = rest
        elif code == 1:
            low = rest
        elif code == 2:
            x = rest & 0x7FF
        elif code == 3:
            events.append((base_us + (high << 12 | low), x, rest & 0x7FF, rest >> 11))
        elif code == 4:
            base, polarity = rest & 0x7FF, rest >> 11
        elif code == 5:
            time = base_us + (high << 12 | low)
            events += [(time, x, base + i, polarity) for i in range(8) if rest >> i & 1]
            base += 8
    return events


def evt3_word_by_word(data: bytes) -> list[tuple[int, int, int, int]]:
    high = low = None
    y = base = polarity = wraps = 0
    events = []
    for word in np.frombuffer(data, "<u2").tolist():
        code, rest = word >> 12, word & 0xFFF
        if code == 8:
            wraps += high is not None and rest + 10 < high
            high = rest
        elif code == 6 and high is not None:
            low = rest
        elif code == 0:
            y = rest & 0x7FF
        elif code == 3:
            base, polarity = rest & 0x7FF, rest >> 11
        elif code in (2, 4, 5):
            time = None if high is None or low is None else wraps << 24 | high << 12 | low
            if code == 2:
                found = [(rest & 0x7FF, rest >> 11)]
            else:
                n_bits = 12 if code == 4 else 8
                found = [(base + i, polarity) for i in range(n_bits) if rest >> i & 1]
                base += n_bits
            events += [(time, x, y, p) for x, p in found if time is not None]
    return events
