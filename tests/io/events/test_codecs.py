"""Round trips of events in the cameras' encodings; lost and broken packets in bags are counted."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import Events, join_events
from lce_rig.core.errors import SourceError
from lce_rig.io.events import open_events
from lce_rig.io.events.prophesee import EVT3, WordDecoder
from lce_rig.io.ros.event_messages import PacketDecoder
from lce_rig.io.ros.messages import EVENT_ARRAY_TYPE, decode_event_array, encode_event_array, typestore
from tests.io.events import encoders
from tests.io.events.bags import parsed, write_event_bag, write_packet_bag
from tests.io.events.encoders import everything, listed, random_events
from tests.notes import has_note


def columns_listed(columns):
    return listed(Events("", columns.t_ns, columns.x, columns.y, columns.polarity, 1, 1))


@given(
    n=st.integers(1, 120),
    seed=st.integers(0, 10**6),
    cuts=st.lists(st.integers(0, 300), max_size=6),
    start_us=st.integers(0, 1 << 23),
)
def test_codecs_ignore_block_boundaries(n, seed, cuts, start_us):
    truth = listed(random_events(n, seed, (1280, 720), start_us))
    words = np.frombuffer(encoders.evt3(truth), "<u2")
    decoder = WordDecoder(EVT3)
    parts = [decoder.decode(block) for block in np.split(words, sorted(min(c, len(words)) for c in cuts))]
    assert columns_listed(join_events(parts)) == truth


def test_evt3_vector_continues_after_previous_one():
    # Base 100, then 12 + 12 + 8 places, of which the first of each is set.
    words = [8 << 12, 6 << 12 | 5, 7, 3 << 12 | 1 << 11 | 100, 4 << 12 | 1, 4 << 12 | 1, 5 << 12 | 1]
    events = WordDecoder(EVT3).decode(np.array(words, "<u2"))
    assert columns_listed(events) == [(5, 100, 7, True), (5, 112, 7, True), (5, 124, 7, True)]


def test_codecs_sensor_clock_wraps_seamlessly():
    truth = listed(random_events(400, 1, (640, 480), (1 << 24) - 400))
    assert truth[0][0] < 1 << 24 < truth[-1][0]
    assert columns_listed(WordDecoder(EVT3).decode(np.frombuffer(encoders.evt3(truth), "<u2"))) == truth


def test_small_step_back_of_time_is_not_a_wrap():
    words = [8 << 12 | 50, 6 << 12, 9, 2 << 12 | 1, 8 << 12 | 49, 2 << 12 | 2, 8 << 12 | 51, 2 << 12 | 3]
    events = WordDecoder(EVT3).decode(np.array(words, "<u2"))
    assert (events.t_ns // 4_096_000).tolist() == [50, 49, 51]


def test_a_damaged_time_word_is_repaired():
    truth = [(5000 * i, i, i, True) for i in range(100)]
    words = np.frombuffer(encoders.evt3(truth), "<u2").copy()
    high = np.flatnonzero(words >> 12 == 8)
    words[high[50]] ^= 1 << 10
    found = columns_listed(WordDecoder(EVT3).decode(words))
    assert found[:50] + found[51:] == truth[:50] + truth[51:]
    assert abs(found[50][0] - truth[50][0]) < 10_000


@pytest.mark.parametrize("is_ros1", [True, False])
@pytest.mark.parametrize("encoding", ["evt3", "libcaer_cmp"])
@given(seed=st.integers(0, 10**6), n=st.integers(1, 60))
def test_packets_of_every_encoding_come_back(encoding, is_ros1, seed, n):
    start_us = 0 if encoding == "evt3" else 1_700_000_000_000_000
    truth = listed(random_events(n, seed, start_us=start_us))
    payloads = {
        "evt3": lambda part: encoders.evt3(part),
        "libcaer_cmp": lambda part: encoders.libcaer_cmp(part, start_us),
    }
    decoder = PacketDecoder()
    parts = []
    for half in (truth[: n // 2], truth[n // 2 :]):
        payload = payloads[encoding](half)
        data = encoders.packet(payload, encoding, is_ros1=is_ros1, base_ns=start_us * 1000, stamp_ns=77)
        parts.append(decoder.decode(parsed(data, is_ros1)))
    assert columns_listed(join_events(parts)) == truth
    assert parts[0].host_ns == 77


@pytest.mark.parametrize("is_ros1", [True, False])
def test_event_arrays_are_read_by_ros(is_ros1):
    store = typestore(is_ros1)
    events = random_events(20, 4, start_us=1_700_000_000_000_000)
    data = encode_event_array(events, "cam", "ros1" if is_ros1 else "cdr")
    read = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    message = read(data, EVENT_ARRAY_TYPE)
    found = [(e.ts.sec * 10**6 + e.ts.nanosec // 1000, e.x, e.y, e.polarity) for e in message.events]
    assert found == listed(events)
    write = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    assert bytes(write(message, EVENT_ARRAY_TYPE)) == data


@given(data=st.binary(max_size=200), is_ros1=st.booleans())
def test_codecs_garbage_is_refused_with_message(data, is_ros1):
    for decode in (parsed, lambda data, is_ros1: decode_event_array(data, "ros1" if is_ros1 else "cdr")):
        try:
            decode(data, is_ros1)
        except ValueError as error:
            assert str(error)


TOPIC = "/event_camera/events"
TRUTH = listed(random_events(2000, 11))
PIECES = [TRUTH[i : i + 100] for i in range(0, 2000, 100)]


def messages(is_ros1, encoding="libcaer_cmp"):
    encode = {"libcaer_cmp": lambda piece: encoders.libcaer_cmp(piece, 0), "evt3": encoders.evt3}[encoding]
    return [
        (TOPIC, 10**9 + 10**7 * i, encoders.packet(encode(piece), encoding, is_ros1=is_ros1, number=i))
        for i, piece in enumerate(PIECES)
    ]


@pytest.mark.parametrize("name", ["a.bag", "ros2"])
@pytest.mark.parametrize("encoding", ["libcaer_cmp", "evt3"])
def test_packets_of_a_topic_are_one_recording(tmp_path, name, encoding):
    path = write_packet_bag(tmp_path / name, messages(name == "a.bag", encoding))
    recording = open_events(path)
    assert everything(recording) == TRUTH
    assert recording.notes == [f"{name}: events from {TOPIC} (20 messages)"]


@pytest.mark.parametrize("name", ["a.bag", "ros2"])
def test_codecs_broken_packets_are_counted(tmp_path, name):
    """The first broken one is named."""
    is_ros1 = name == "a.bag"
    sent = messages(is_ros1)
    for i in (5, 9, 17):
        topic, received_ns, data = sent[i]
        sent[i] = topic, received_ns, data[:-3]
    # Of another size, and of an encoding that nothing reads.
    odd = encoders.packet(b"", "libcaer_cmp", is_ros1=is_ros1, number=20, size=(640, 480))
    strange = encoders.packet(b"12345678", "evt9", is_ros1=is_ros1, number=21)
    sent += [(TOPIC, 2 * 10**9, odd), (TOPIC, 2 * 10**9, strange)]
    recording = open_events(write_packet_bag(tmp_path / name, [*sent[:12], *sent[14:]]))
    kept = [event for i, piece in enumerate(PIECES) if i not in (5, 9, 12, 13, 17) for event in piece]
    assert everything(recording) == kept
    assert has_note(recording.notes, "5 broken packets", "message 5")
    assert has_note(recording.notes, "5 packets lost"), "the broken ones and two that never came"


def test_codecs_damaged_record_ends_events(tmp_path):
    path = tmp_path / "a.bag"
    events = random_events(100_000, 3, start_us=1_700_000_000_000_000, step_us=100)
    write_event_bag(path, [events])
    damaged = bytearray(path.read_bytes())
    place = damaged.index(b"op=\2", len(damaged) // 2)
    damaged[place : place + 2] = b"??"
    path.write_bytes(bytes(damaged))
    recording = open_events(path)
    found = everything(recording)
    assert 20_000 < len(found) < len(events)
    assert found == listed(events)[: len(found)]
    assert any("torn" in note for note in recording.notes)


def test_two_cameras_need_a_topic_and_the_topics_are_listed(tmp_path):
    sent = messages(is_ros1=True)
    path = write_packet_bag(tmp_path / "a.bag", sent + [("/other", t, data) for _, t, data in sent[:3]])
    with pytest.raises(SourceError, match="2 ") as caught:
        open_events(path)
    assert has_note([caught.value.hint], "/other", "EventPacket, 3")
    assert everything(open_events(path, topic="/other")) == TRUTH[:300]
    with pytest.raises(SourceError, match="/none") as caught:
        open_events(path, topic="/none")
    assert TOPIC in caught.value.hint
