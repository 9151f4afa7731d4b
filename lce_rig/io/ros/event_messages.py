"""Events in ROS 1 and ROS 2 bags.

References:
    https://github.com/ros-event-camera/event_camera_msgs
    https://github.com/ros-event-camera/event_camera_codecs (the sensor's own encodings inside a message)
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import MAX_TIME_NS, EventColumns
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Losses
from lce_rig.io import findings
from lce_rig.io.events.event_recording import NO_EVENTS, NS_PER_US, EventStream
from lce_rig.io.events.prophesee import EVT3, LIBCAER_CMP, WordDecoder
from lce_rig.io.ros.bag_file import BagFile, RawMessage, list_topics
from lce_rig.io.ros.messages import EventHead, decode_event_array, deserialize, header_stamp_ns

ARRAY_TYPES = frozenset({"dvs_msgs/EventArray", "prophesee_event_msgs/EventArray"})
# event_array_msgs is the former name of event_camera_msgs, with the same layout.
PACKET_TYPES = frozenset({"event_camera_msgs/EventPacket", "event_array_msgs/EventArray"})
EVENT_TYPES = ARRAY_TYPES | PACKET_TYPES
ENCODINGS = ("evt3", "libcaer_cmp", "trigger")


class EventPacket(NamedTuple):
    """One event_camera_msgs/EventPacket, undecoded.

    Attributes:
        number: sequence number of the message, as counted by the driver.
        time_base_ns: origin of the timestamps inside; 0 if they count from the sensor's start.
        encoding: one of `ENCODINGS`.
        words: (N,) uint16, the payload.
    """

    head: EventHead
    number: int
    time_base_ns: int
    encoding: str
    words: NDArray[np.uint16]


def parse_packet(message: RawMessage) -> EventPacket:
    """Read a message up to its payload.

    Raises:
        ValueError: it is damaged.
    """
    content = deserialize(message)
    if content.time_base > MAX_TIME_NS:
        raise ValueError(f"its time base, {content.time_base} ns, is beyond any clock")
    frame_id = str(content.header.frame_id)
    head = EventHead(header_stamp_ns(content), frame_id, int(content.width), int(content.height))
    payload = np.ascontiguousarray(content.events, np.uint8)
    if len(payload) % 2:
        raise ValueError(f"{len(payload)} bytes are not a whole number of 2-byte words")
    words = payload.view(">u2" if content.is_bigendian else "<u2").astype(np.uint16)
    return EventPacket(head, int(content.seq), int(content.time_base), str(content.encoding), words)


def read_event_head(message: RawMessage) -> EventHead:
    """Read header and resolution of a message of either kind.

    Raises:
        ValueError: it is damaged.
    """
    if message.msgtype in ARRAY_TYPES:
        return decode_event_array(message.data, message.encoding)[0]
    return parse_packet(message).head


class PacketDecoder:
    """Decodes the packets of one topic in order; EVT3 continues from packet to packet."""

    def __init__(self) -> None:
        self._evt3 = WordDecoder(EVT3)
        self._compressed = WordDecoder(LIBCAER_CMP)

    def decode(self, packet: EventPacket) -> EventColumns:
        """Decode a packet.

        Raises:
            ValueError: the encoding is not supported.
        """
        events, base_ns = NO_EVENTS, 0
        if packet.encoding == "evt3":
            events = self._evt3.decode(packet.words)
        elif packet.encoding == "libcaer_cmp":
            self._compressed.start_packet()
            events = self._compressed.decode(packet.words)
            # The codec truncates the driver's time base to whole microseconds; so does this reader.
            base_ns = packet.time_base_ns // NS_PER_US * NS_PER_US
        elif packet.encoding != "trigger":
            raise ValueError(f"encoding {packet.encoding!r} is none of {', '.join(ENCODINGS)}")
        return replace(events, t_ns=events.t_ns + base_ns, host_ns=packet.head.stamp_ns)


class BagEvents(EventStream):
    """Events of one topic; see `EventStream`."""

    def __init__(self, path: Path, topic: str | None, bag: BagFile | None = None) -> None:
        """Find the topic.

        Args:
            path: the bag.
            topic: None takes the only one with events.
            bag: the same bag, if already open.

        Raises:
            SourceError: the bag cannot be read, or lacks the topic; the hint lists those that are there.
        """
        self._bag = bag or BagFile(path)
        topics = self._bag.topics
        fitting = sorted(name for name, (kind, n) in topics.items() if kind in EVENT_TYPES and n > 0)
        if topic is None and len(fitting) != 1:
            fault = f"events on {len(fitting)} topics" if fitting else "no topic with events"
            hint = f"{list_topics(topics)}. Name the topic of the camera's events."
            raise SourceError(f"{path}: {fault}", hint)
        self._topic = topic or fitting[0]
        kind, n_messages = topics.get(self._topic, ("", 0))
        if kind not in EVENT_TYPES:
            fault = f"{topic} is {kind}, which holds no events" if kind else f"no topic {topic}"
            raise SourceError(f"{path}: {fault}", list_topics(topics))
        self.notes = [f"{path.name}: events from {self._topic} ({n_messages} messages)"]
        self.resolution_px: tuple[int, int] | None = None
        for _, message in self._messages(self._topic, Losses()):
            with suppress(ValueError):
                head = read_event_head(message)
                self.resolution_px = (head.width_px, head.height_px) if head.width_px else None
                break

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events, message by message."""
        decoder = PacketDecoder()
        last_number: int | None = None
        for index, message in self._messages(self._topic, losses):
            try:
                if message.msgtype in ARRAY_TYPES:
                    head, events = decode_event_array(message.data, message.encoding)
                    self._check_size(head)
                    yield replace(events, host_ns=message.log_ns)
                    continue
                packet = parse_packet(message)
                self._check_size(packet.head)
                yield decoder.decode(packet)
            except ValueError as error:
                losses.add(findings.BROKEN_PACKETS(where=f"message {index}: {error}"))
                continue
            if last_number is not None and packet.number > last_number + 1:
                lost = findings.PACKETS_LOST(where=f"before message {index}")
                losses.add(lost, packet.number - last_number - 1)
            last_number = packet.number

    def _check_size(self, head: EventHead) -> None:
        if self.resolution_px and (head.width_px, head.height_px) != self.resolution_px:
            raise ValueError(f"it is of {head.width_px}x{head.height_px} pixels")

    def _messages(self, topic: str, losses: Losses) -> Iterator[tuple[int, RawMessage]]:
        """Yield the numbered messages of a topic; damage of the bag is counted and ends the iteration."""
        try:
            yield from enumerate(self._bag.messages({topic}))
        except SourceError as error:
            losses.add(findings.BAG_TORN(where=error.what))
