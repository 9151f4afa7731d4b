"""Events in ROS 1 and ROS 2 bags."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lce_rig.core.errors import SourceError
from lce_rig.sources.bag_file import BagFile, list_topics
from lce_rig.sources.bag_storage import RawMessage
from lce_rig.sources.events.event_array import decode_event_array
from lce_rig.sources.events.event_packet import (
    EventPacket,
    PacketDecoder,
    Triggers,
    decode_triggers,
    parse_packet,
)
from lce_rig.sources.events.message import EventHeader
from lce_rig.sources.events.stream import EventColumns, Findings, seconds_in

ARRAY_TYPES = frozenset({"dvs_msgs/EventArray", "prophesee_event_msgs/EventArray"})
# event_array_msgs is what event_camera_msgs was called before; the layout is the same.
PACKET_TYPES = frozenset({"event_camera_msgs/EventPacket", "event_array_msgs/EventArray"})
EVENT_TYPES = ARRAY_TYPES | PACKET_TYPES


class BagEvents:
    """Events of one topic; see `EventStream`."""

    def __init__(self, path: Path, topic: str | None, bag: BagFile | None = None) -> None:
        """Find the topic.

        Args:
            path: the bag.
            topic: None takes the only one with events.
            bag: the same one, where it is open already.

        Raises:
            SourceError: the bag cannot be read, or lacks the topic; the hint lists those that are there.
        """
        self._bag = bag or BagFile(path)
        self._topic = _choose_topic(self._bag, topic)
        self._is_array = self._bag.topics[self._topic][0] in ARRAY_TYPES
        self.notes = [f"{path.name}: events from {self._topic} ({self._bag.topics[self._topic][1]} messages)"]
        header = self._first_header()
        self.resolution_px = (header.width_px, header.height_px) if header and header.width_px else None

    def duration_ns(self) -> int | None:
        """Count from the receipt of the first message to that of the last."""
        first = next((message for _, message in _messages(self._bag, self._topic, Findings())), None)
        end_ns = self._bag.end_ns(self._topic)
        return None if first is None or end_ns is None else end_ns - first.log_ns

    def stretches(self, findings: Findings) -> Iterator[EventColumns]:
        """Yield the events, one or several messages at a time."""
        decoder = PacketDecoder()
        last_number: int | None = None
        first_ns: int | None = None
        for index, message in _messages(self._bag, self._topic, findings):
            first_ns = message.log_ns if first_ns is None else first_ns
            try:
                if self._is_array:
                    header, events = decode_event_array(message.data, message.encoding)
                    self._check_size(header)
                    yield replace(events, host_ns=message.log_ns)
                    continue
                packet = parse_packet(message.data, message.encoding)
                self._check_size(packet.header)
                yield from decoder.decode(packet)
            except ValueError as error:
                where = f"message {index}, received {seconds_in(message.log_ns, first_ns)}: {error}"
                findings.add("broken packets left out", where)
                continue
            if last_number is not None and packet.number > last_number + 1:
                lost = packet.number - last_number - 1
                findings.add("packets lost in recording", f"before message {index}", lost)
            last_number = packet.number
        yield from decoder.finish()
        decoder.account(findings)

    def _check_size(self, header: EventHeader) -> None:
        size = header.width_px, header.height_px
        if self.resolution_px and size != self.resolution_px:
            raise ValueError(f"it is of {size[0]}x{size[1]} pixels")

    def _first_header(self) -> EventHeader | None:
        for _, message in _messages(self._bag, self._topic, Findings()):
            try:
                if self._is_array:
                    return decode_event_array(message.data, message.encoding)[0]
                return parse_packet(message.data, message.encoding).header
            except ValueError:
                continue
        return None


def read_triggers(path: Path, topic: str | None = None) -> Triggers:
    """Read the edges on a camera's trigger input from EventPackets of encoding "trigger"; there may be none.

    Raises:
        SourceError: the bag cannot be read, or lacks the topic.
    """
    bag = BagFile(path)
    topics = [topic] if topic else [name for name, (kind, _) in bag.topics.items() if kind in PACKET_TYPES]
    packets = []
    for name in topics:
        if name not in bag.topics:
            raise SourceError(f"{path} has no topic {name}", list_topics(bag.topics))
        packets += [p for p in _packets(bag, name) if p.encoding == "trigger"]
    return decode_triggers(packets)


def _packets(bag: BagFile, topic: str) -> Iterator[EventPacket]:
    for _, message in _messages(bag, topic, Findings()):
        try:
            yield parse_packet(message.data, message.encoding)
        except ValueError:
            continue


def _messages(bag: BagFile, topic: str, findings: Findings) -> Iterator[tuple[int, RawMessage]]:
    """Yield the messages of a topic with their number; where the bag is torn, that is said and all."""
    messages = bag.messages({topic})
    index = 0
    while True:
        try:
            message = next(messages, None)
        except SourceError as error:
            findings.add("places where the bag is torn", error.what)
            return
        if message is None:
            return
        yield index, message
        index += 1


def _choose_topic(bag: BagFile, asked: str | None) -> str:
    """Take the topic asked for, else the only one that carries events."""
    there = list_topics(bag.topics)
    if asked is not None:
        kind, _ = bag.topics.get(asked, ("", 0))
        if kind not in EVENT_TYPES:
            said = f"{asked} is {kind}, which holds no events" if kind else f"no topic {asked}"
            raise SourceError(f"{bag.path}: {said}", there)
        return asked
    fitting = sorted(name for name, (kind, n) in bag.topics.items() if kind in EVENT_TYPES and n > 0)
    if len(fitting) > 1:
        fitting = [name for name in fitting if not _holds_triggers(bag, name)]
    if len(fitting) != 1:
        found = f"events on {len(fitting)} topics" if fitting else "no topic with events"
        raise SourceError(f"{bag.path}: {found}", f"{there}. Say which topic holds the camera's events.")
    return fitting[0]


def _holds_triggers(bag: BagFile, topic: str) -> bool:
    if bag.topics[topic][0] not in PACKET_TYPES:
        return False
    first = next(_packets(bag, topic), None)
    return first is not None and first.encoding == "trigger"
