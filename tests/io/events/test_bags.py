"""Events in bags: topics, packets lost or broken, torn bags."""

from pathlib import Path

import pytest

from lce_rig.core.errors import SourceError
from lce_rig.io.events import EventRecording, open_events
from tests.io.events import encoders
from tests.io.events.bags import write_event_bag, write_packet_bag
from tests.io.events.encoders import Event, listed, random_events
from tests.notes import has_note

TOPIC = "/event_camera/events"
TRUTH = listed(random_events(2000, 11))
PIECES = [TRUTH[i : i + 100] for i in range(0, 2000, 100)]


def messages(is_ros1: bool, encoding: str = "mono") -> list[tuple[str, int, bytes]]:
    encode = {"mono": lambda piece: encoders.mono(piece, 0), "evt3": encoders.evt3}[encoding]
    return [
        (TOPIC, 10**9 + 10**7 * i, encoders.packet(encode(piece), encoding, is_ros1=is_ros1, number=i))
        for i, piece in enumerate(PIECES)
    ]


def everything(recording: EventRecording) -> list[Event]:
    return [event for stretch in recording for event in listed(stretch)]


@pytest.mark.parametrize("name", ["a.bag", "ros2"])
@pytest.mark.parametrize("encoding", ["mono", "evt3"])
def test_packets_of_a_topic_are_one_recording(tmp_path: Path, name: str, encoding: str) -> None:
    path = write_packet_bag(tmp_path / name, messages(name == "a.bag", encoding))
    recording = open_events(path)
    assert everything(recording) == TRUTH
    assert recording.notes == [f"{name}: events from {TOPIC} (20 messages)"]


@pytest.mark.parametrize("name", ["a.bag", "ros2"])
def test_broken_packets_are_counted_and_the_first_is_named(tmp_path: Path, name: str) -> None:
    sent = messages(name == "a.bag")
    for i in (5, 9, 17):
        topic, received_ns, data = sent[i]
        sent[i] = topic, received_ns, data[:-3]
    recording = open_events(write_packet_bag(tmp_path / name, sent))
    kept = [event for i, piece in enumerate(PIECES) if i not in (5, 9, 17) for event in piece]
    assert everything(recording) == kept
    assert has_note(recording.notes, "3 broken packets", "message 5", "0.050 s")


def test_packets_that_never_arrived_are_counted(tmp_path: Path) -> None:
    sent = messages(is_ros1=True)
    recording = open_events(write_packet_bag(tmp_path / "a.bag", sent[:4] + sent[7:]))
    assert len(everything(recording)) == 1700
    assert has_note(recording.notes, "3 packets lost")


def test_packets_of_another_size_or_encoding_are_broken_ones(tmp_path: Path) -> None:
    sent = messages(is_ros1=True)
    odd = encoders.packet(b"", "mono", is_ros1=True, number=20, size=(640, 480))
    strange = encoders.packet(b"12345678", "evt9", is_ros1=True, number=21)
    sent += [(TOPIC, 2 * 10**9, odd), (TOPIC, 2 * 10**9, strange)]
    recording = open_events(write_packet_bag(tmp_path / "a.bag", sent))
    assert everything(recording) == TRUTH
    assert has_note(recording.notes, "2 broken packets", "640x480")


def test_a_damaged_record_ends_the_events_and_the_loss_is_said(tmp_path: Path) -> None:
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


def test_two_cameras_need_a_topic_and_the_topics_are_listed(tmp_path: Path) -> None:
    sent = messages(is_ros1=True)
    path = write_packet_bag(tmp_path / "a.bag", sent + [("/other", t, data) for _, t, data in sent[:3]])
    with pytest.raises(SourceError, match="2 topics") as caught:
        open_events(path)
    assert has_note([caught.value.hint], "/other", "EventPacket, 3")
    assert everything(open_events(path, topic="/other")) == TRUTH[:300]
    with pytest.raises(SourceError, match="/none") as caught:
        open_events(path, topic="/none")
    assert TOPIC in caught.value.hint
