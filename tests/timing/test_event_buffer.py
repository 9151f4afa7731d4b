"""Frames get exactly the events around their scan, for any packet sizes, with bounded memory."""

import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.findings import Losses
from lce_rig.timing.scan_pairing import AFTER_NS, BEFORE_NS, pair_by_time, rig_time_ns
from tests.shared import changed

T0_NS = 1_700_000_000 * 10**9
MS = 1_000_000


def image(time_ms):
    return Image("davis", "frames", T0_NS + round(time_ms * MS), np.zeros((2, 2), np.uint8))


def scan(time_ms):
    """A sweep of 100 ms that begins at `time_ms`."""
    offset_ns = np.array([0, 100 * MS])
    zeros = np.zeros(2, np.float32)
    return Scan(
        "lidar",
        T0_NS + round(time_ms * MS),
        np.ones((2, 3), np.float32),
        zeros,
        zeros.astype("i2"),
        offset_ns,
    )


def stream(begin_ms, end_ms, n, seed=0):
    rng = np.random.default_rng(seed)
    t_ns = T0_NS + np.sort(rng.integers(round(begin_ms * 1000), round(end_ms * 1000), n)) * 1000
    x, y = rng.integers(0, 346, n).astype(np.uint16), rng.integers(0, 260, n).astype(np.uint16)
    return Events("davis", t_ns, x, y, rng.random(n) < 0.5, 346, 260, host_ns=1)


def packets(events, edges):
    bounds = [0, *edges, len(events)]
    return [events.select(slice(a, b)) for a, b in pairwise(bounds) if b > a]


def frames_of(samples, rles):
    ordered = sorted(samples, key=lambda sample: rig_time_ns(sample, rles) or 0)
    return list(pair_by_time(ordered, rles, Losses()))


def is_cut_exactly(frame, events, begin_ms):
    (cut,) = frame.events
    start_ns = T0_NS + round(begin_ms * MS) - BEFORE_NS
    truth = events.between(start_ns, start_ns + BEFORE_NS + 100 * MS + AFTER_NS)
    found = cut.events
    columns = ("t_ns", "x", "y", "polarity")
    return all(np.array_equal(getattr(found, name), getattr(truth, name)) for name in columns)


@given(edges=st.lists(st.integers(0, 4000), max_size=30).map(sorted))
def test_event_buffer_cuts_exactly(rles, edges):
    events = stream(0, 3000, 4000)
    begins_ms = (1300, 1400, 1700)
    pictures = [image(t + 50) for t in begins_ms]
    frames = frames_of([*packets(events, edges), *map(scan, begins_ms), *pictures], rles)
    assert len(frames) == 3
    assert all(is_cut_exactly(frame, events, t) for frame, t in zip(frames, begins_ms, strict=True))
    assert all(frame.events[0].missing_ns == 0 for frame in frames)
    assert frames[0].events[0].events.host_ns is None


def test_event_buffer_reports_missing_time(rles):
    """The stream begins late or ends early."""
    events = stream(900, 1800, 5000)
    samples = [*packets(events, range(100, 5000, 100)), *(scan(t) for t in (100, 1000, 1700, 3500))]
    frames = frames_of([*samples, *(image(t + 50) for t in (100, 1000, 1700, 3500))], rles)
    assert [len(frame.events) for frame in frames] == [0, 1, 1, 0]
    assert is_cut_exactly(frames[1], events, 1000) and is_cut_exactly(frames[2], events, 1700)
    first_ns = int(events.t_ns[0])
    assert frames[1].events[0].missing_ns == first_ns - (T0_NS + 1000 * MS - BEFORE_NS)
    assert frames[2].events[0].missing_ns == first_ns - (T0_NS + 1700 * MS - BEFORE_NS)


def test_frame_wait_for_events_is_limited(rles):
    events = stream(0, 1500, 3000)
    first, *others = packets(events, range(50, 3000, 50))
    early = [first, scan(1000), image(1050), image(1200), *others]
    (frame,) = list(pair_by_time(early, rles, Losses()))
    assert is_cut_exactly(frame, events, 1000)
    silent = [*packets(events, [1500]), *(scan(t) for t in range(1000, 5000, 100))]
    ordered = sorted(
        [*silent, *(image(t + 50) for t in range(1000, 5000, 100))], key=lambda s: rig_time_ns(s, rles) or 0
    )
    taken = iter(ordered)
    earliest = next(pair_by_time(taken, rles, Losses()))
    assert earliest.time_ns == T0_NS + 1050 * MS and next(taken).stamp_ns < T0_NS + 2500 * MS


def test_event_buffer_cuts_for_each_camera(rles):
    both = changed(rles, cameras__right=rles.cameras["davis"])
    left, right = stream(0, 3000, 2000, 1), replace(stream(0, 3000, 2000, 2), sensor="right")
    samples = [
        *packets(left, range(90, 2000, 90)),
        *packets(right, range(70, 2000, 70)),
        scan(1300),
        image(1350),
    ]
    (frame,) = frames_of(samples, both)
    assert [cut.sensor for cut in frame.events] == ["davis", "right"]
    assert [len(cut) for cut in frame.events] == [
        len(e.between(T0_NS + 100 * MS, T0_NS + 1550 * MS)) for e in (left, right)
    ]


def test_event_buffer_memory_is_bounded(rles):
    """Also while the LiDAR is silent."""

    def samples(n_packets):
        for k in range(n_packets):
            yield replace(packet, t_ns=packet.t_ns + k * 20 * MS)
            if k % 5 == 0 and not 300 < k < 1800:
                yield scan(20.0 * k)
                yield image(20.0 * k + 10)

    packet = stream(0, 20, 4000)
    tracemalloc.start()
    n_frames = sum(1 for _ in pair_by_time(samples(2400), rles, Losses()))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    n_bytes = sum(column.nbytes for column in (packet.t_ns, packet.x, packet.y, packet.polarity))
    # 5.4 s are 270 packets; while a full block is copied into the next there are two, each with some room.
    assert n_frames > 100 and peak < 4 * 270 * n_bytes < 0.5 * 2400 * n_bytes
