"""Simultaneous recordings by several recorders: grouping and order."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Scan, Stream
from lce_rig.core.errors import SourceError
from lce_rig.io.recording import (
    JoinedRecording,
    check_overlap,
    join_recordings,
    merge_by_time,
    require_sensors,
)
from tests.notes import has_note
from tests.shared import changed

S = 10**9
T0_NS = 1_700_000_000 * S
LIDAR = Stream("lidar", "", "scans")
FRAMES, EVENTS = Stream("davis", "frames", "images"), Stream("davis", "events", "events")


def sample(stream, time_s):
    stamp_ns = T0_NS + round(time_s * S)
    if stream.kind == "images":
        return Image(stream.sensor, stream.channel, stamp_ns, np.zeros((2, 2), np.uint8))
    if stream.kind == "scans":
        column = np.zeros(1, np.float32)
        return Scan(stream.sensor, stamp_ns, np.ones((1, 3), np.float32), column, np.zeros(1, np.int16))
    t_ns = stamp_ns + np.arange(3) * 1000
    place = np.zeros(3, np.uint16)
    return Events(stream.sensor, t_ns, place, place, np.ones(3, bool), 346, 260)


@dataclass
class Listed:
    """A recording of given samples, torn after them if `torn`."""

    name: str
    contents: list[tuple[Stream, float]]
    torn: str = ""
    notes: list[str] = field(default_factory=list)

    def __post_init__(self):
        self.path, self.key = Path(self.name), self.name
        self.n_samples = sum(stream.kind != "events" for stream, _ in self.contents)
        self.streams = {stream for stream, _ in self.contents}

    def samples(self):
        yield from (sample(stream, time_s) for stream, time_s in self.contents)
        self.notes.append(f"{self.name} was read")
        if self.torn:
            raise SourceError(self.torn)


def lidar(name="lidar.bag", step_s=0.1, **kwargs):
    return Listed(name, [(LIDAR, k * step_s) for k in range(3)], **kwargs)


def camera(name="events.aedat4", after_s=0.0):
    contents = [(EVENTS, 0.01), (FRAMES, 0.05), (EVENTS, 0.12), (FRAMES, 0.15)]
    return Listed(name, [(stream, time_s + after_s) for stream, time_s in contents])


def whole(name, *more):
    return Listed(name, [(stream, 0.1 * k) for k, stream in enumerate((LIDAR, FRAMES, *more))])


def names(recordings):
    return [
        [part.name for part in r._parts] if isinstance(r, JoinedRecording) else [r.name] for r in recordings
    ]


def test_join_by_missing_sensors(rles):
    events_only = Listed("e", [(EVENTS, 0.0)])
    for given, wanted in [
        ([lidar(), camera()], [["lidar.bag", "events.aedat4"]]),
        ([camera(), lidar()], [["events.aedat4", "lidar.bag"]]),
        ([whole("a"), whole("b")], [["a"], ["b"]]),
        ([whole("a"), whole("b", EVENTS)], [["a"], ["b"]]),
        ([whole("a"), events_only], [["a", "e"]]),
        ([whole("a"), camera("c")], [["a", "c"]]),
        ([lidar("1"), camera("2"), lidar("3"), camera("4")], [["1", "2"], ["3", "4"]]),
        ([camera("1"), lidar("2"), camera("3"), lidar("4")], [["1", "2"], ["3", "4"]]),
    ]:
        assert names(join_recordings(given, rles)) == wanted


def test_join_second_copy_is_skipped(rles):
    (joined,) = join_recordings([whole("a.bag", EVENTS), camera("c.aedat4")], rles)
    assert has_note(joined.notes, "davis.events", "a.bag, not", "c.aedat4")
    assert len(list(joined.samples())) == 3


def test_join_samples_come_in_order_of_time(rles):
    (joined,) = join_recordings([lidar(), camera()], rles)
    kinds = [type(s).__name__ for s in joined.samples()]
    assert kinds == ["Scan", "Events", "Image", "Scan", "Events", "Image", "Scan"]
    assert joined.n_samples == 5 and set(joined.streams) == {LIDAR, FRAMES, EVENTS}
    assert [note.split()[0] for note in joined.notes[-2:]] == ["lidar.bag", "events.aedat4"]
    shifted = changed(rles, cameras__davis__channels__frames__timestamps__expected_offset_s=-0.06)
    frames_only = Listed("frames.bag", [(FRAMES, 0.05), (FRAMES, 0.15)])
    kinds = [type(s).__name__ for s in JoinedRecording([lidar(), frames_only], shifted).samples()]
    assert kinds == ["Image", "Scan", "Image", "Scan", "Scan"]


def test_join_key_ignores_the_order(rles):
    one, other = JoinedRecording([lidar(), camera()], rles), JoinedRecording([camera(), lidar()], rles)
    assert one.key == other.key != JoinedRecording([lidar(), camera("x")], rles).key


@pytest.mark.parametrize(
    ("after_s", "words"),
    [
        (1264.5, ["channels.events.timestamps.expected_offset_s", "-1264.5 s"]),
        (-1_699_999_999.0, ["counts from its start", "channels.events.timestamps.expected_offset_s"]),
        (400_000.0, ["one computer's"]),
    ],
)
def test_join_non_overlapping_clocks_state_the_gap(rles, after_s, words):
    joined = JoinedRecording([lidar(), camera(after_s=after_s)], rles)
    passed = []
    with pytest.raises(SourceError) as caught:
        for one in check_overlap(joined.samples(), rles, []):
            passed.append(one)
    assert len(passed) == 7 and all(word in caught.value.hint for word in words)


def test_a_partial_overlap_is_noted(rles):
    joined = JoinedRecording([lidar(step_s=15.0), camera(after_s=20.0)], rles)
    assert len(list(check_overlap(joined.samples(), rles, joined.notes))) == 7
    assert has_note(joined.notes, "davis.events", "0.1 of", "30.0 s", "lidar's")


def test_check_overlap_long_packet_covers_its_span(rles):
    t_ns = (T0_NS + np.linspace(0, 30e9, 5)).astype(np.int64)
    joined = JoinedRecording([lidar(step_s=15.0)], rles)
    list(check_overlap([*joined.samples(), packet(t_ns)], rles, joined.notes))
    assert not has_note(joined.notes, "davis.events", "cover")


@pytest.mark.parametrize(("factor", "words"), [(1e-3, "small"), (1e-6, "small"), (1e3, "large")])
@pytest.mark.parametrize("is_received", [True, False])
def test_check_overlap_other_unit_is_named(rles, factor, words, is_received):
    after_ns = np.linspace(0, 30_000_000_000, 50).astype(np.int64)
    packets = [
        packet(np.array([T0_NS + round(t * factor)]), T0_NS + int(t) if is_received else None)
        for t in after_ns
    ]
    with pytest.raises(SourceError, match=f"times too {words}"):
        list(check_overlap([*lidar(step_s=15.0).samples(), *packets], rles, []))


def packet(t_ns, host_ns=None):
    zeros = np.zeros(len(t_ns), np.uint16)
    return Events("davis", t_ns, zeros, zeros, zeros > 0, 346, 260, host_ns)


def test_join_torn_part_keeps_the_others(rles):
    torn = lidar(torn="lidar.bag is damaged")
    found = []
    with pytest.raises(SourceError, match=r"lidar\.bag"):
        for one in JoinedRecording([torn, camera()], rles).samples():
            found.append(one)
    assert len(found) == 7


def test_join_missing_sensor_is_refused(rles):
    require_sensors(JoinedRecording([lidar(), camera()], rles), rles)
    with pytest.raises(SourceError, match=r"events\.aedat4"):
        require_sensors(camera(), rles)
    with pytest.raises(SourceError, match=r"lidar\.bag") as caught:
        require_sensors(lidar(), rles)
    assert re.findall(r"--from (\S+\w)", caught.value.hint) == ["lidar.bag", "events.aedat4"]


def test_merge_untimed_keep_their_place(rles):
    image = sample(FRAMES, 0.05)
    assert isinstance(image, Image)
    timeless = replace(image, stamp_ns=None)
    parts = [[image, timeless], [sample(LIDAR, 0.0), sample(LIDAR, 0.1)]]
    assert [type(s).__name__ for s in merge_by_time(parts, rles)] == ["Scan", "Image", "Image", "Scan"]
