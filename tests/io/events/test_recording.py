"""Order, clocks and windows of recordings, with small streams of known content."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import MAX_TIME_NS, EventColumns
from lce_rig.core.errors import SourceError
from lce_rig.io.events.event_recording import REORDER_NS, EventRecording, EventStream
from tests.notes import has_note

PATH = Path("recording.test")


class ListedStream(EventStream):
    """A stream of stretches given in advance."""

    def __init__(self, stretches, resolution_px=(346, 260)):
        self.resolution_px = resolution_px
        self.notes = []
        self._stretches = stretches

    def stretches(self, losses):
        yield from self._stretches


def columns(t_us):
    """Events at given times; the column is the number of earlier ones."""
    n = len(t_us)
    x = (np.arange(n) % 346).astype(np.uint16)
    return EventColumns(np.asarray(t_us, np.int64) * 1000, x, np.zeros(n, np.uint16), np.ones(n, bool))


def record(*stretches, resolution=(346, 260)):
    return EventRecording(PATH, ListedStream(stretches, resolution), "events", None)


def stamps_us(recording):
    return [t // 1000 for stretch in recording for t in stretch.t_ns.tolist()]


@given(
    jitter_us=st.integers(0, REORDER_NS // 1000 // 2),
    seed=st.integers(0, 10**6),
    cuts=st.lists(st.integers(1, 999), max_size=8),
)
def test_slightly_unordered_events_are_sorted(jitter_us, seed, cuts):
    rng = np.random.default_rng(seed)
    t_us = np.arange(1000) * 997 + rng.integers(0, jitter_us + 1, 1000)
    # Stretches are longer than the mixing, as packets are.
    parts = np.split(t_us, sorted({c // 100 * 100 for c in cuts} - {0}))
    recording = record(*(columns(part) for part in parts))
    assert stamps_us(recording) == sorted(t_us.tolist())


def test_events_clock_set_back_is_refused():
    """Sound events before are delivered."""
    first, second = np.arange(1000) * 1000, np.arange(1000) * 1000 - 5_000_000
    delivered = []
    with pytest.raises(SourceError, match=r"5\.999 s") as caught:
        for stretch in record(columns(first[:500]), columns(first[500:]), columns(second)):
            delivered += stretch.t_ns.tolist()
    assert "split" in caught.value.hint
    assert delivered == (first * 1000).tolist()


def test_events_before_clock_set_are_counted():
    before, after = 10**12 + np.arange(200) * 1000, np.arange(1000) * 1000
    recording = record(columns(before), columns(after[:400]), columns(after[400:]))
    assert stamps_us(recording) == after.tolist()
    assert has_note(recording.notes, "200 events", "stray")
    assert recording.span_ns == (0, 999_000_000)
    assert recording.start_ns == 0


@pytest.mark.parametrize("stray_us", [10**9, -(10**9)])
@pytest.mark.parametrize("at", [3, 499, 500, 700])
def test_stray_timestamp_is_skipped_and_counted(stray_us, at):
    truth = np.arange(1000) * 1000
    t_us = truth.copy()
    t_us[at] += stray_us
    recording = record(columns(t_us[:500]), columns(t_us[500:]))
    assert stamps_us(recording) == np.delete(truth, at).tolist()
    assert has_note(recording.notes, "1 events", "stray")


def test_events_off_the_sensor_are_skipped():
    """Many of them are refused."""
    stretch = columns(np.arange(1000))
    few, many = stretch.x.copy(), stretch.x.copy()
    few[7], many[::2] = 2000, 400
    recording = record(replace(stretch, x=few))
    assert sum(map(len, recording)) == 999
    assert has_note(recording.notes, "1 events", "off", "column 2000")
    with pytest.raises(SourceError, match="346x260"):
        list(record(replace(stretch, x=many)))


def test_events_own_clock_uses_least_delay():
    delays_ms = [7, 3, 5]
    recording = record(
        *(
            replace(columns([1000 * i]), host_ns=1_000_000 * (i + delay) + 17 * 10**17)
            for i, delay in enumerate(delays_ms)
        )
    )
    recording.tie_to_host()
    first_us = 17 * 10**14 + 3000
    assert stamps_us(recording) == [first_us, first_us + 1000, first_us + 2000]
    assert has_note(recording.notes, "arrival")
    unknown = record(columns([1]))
    unknown.tie_to_host()
    assert stamps_us(unknown) == [1] and not unknown.notes


def test_events_extreme_stamps_are_skipped():
    stretch = columns(range(1000))
    stretch.t_ns[[100, 200, 300, 400]] = MAX_TIME_NS, -MAX_TIME_NS, (1 << 63) - 1, -(1 << 63)
    recording = record(stretch)
    assert stamps_us(recording) == [i for i in range(1000) if i not in (100, 200, 300, 400)]
    assert has_note(recording.notes, "4 events", "stray")
    with pytest.raises(SourceError):
        _ = record(replace(columns([1]), t_ns=np.array([MAX_TIME_NS]))).start_ns
