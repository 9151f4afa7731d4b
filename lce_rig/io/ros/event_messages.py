"""Events in ROS 1 and ROS 2 bags."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses
from lce_rig.io import findings
from lce_rig.io.events.stream import NS_PER_US, seconds_in
from lce_rig.io.events.word_codec import EVT3, LIBCAER_CMP, WordDecoder
from lce_rig.io.ros.bag_file import BagFile, RawMessage, list_topics
from lce_rig.io.ros.event_array import decode_event_array
from lce_rig.io.ros.message_fields import EventHeader, MessageReader, read_header

# event_camera_msgs/EventPacket: the sensor's own encodings inside a ROS message.
#
# References:
#     https://github.com/ros-event-camera/event_camera_msgs
#     https://github.com/ros-event-camera/event_camera_codecs

ENCODINGS = ("evt3", "libcaer", "libcaer_cmp", "mono", "trigger")
_BATCH_BYTES = 1 << 17
# A word of two bytes may hold twelve events.
_WORDS_AT_ONCE = 1 << 17
_LIBCAER_WRAP_US = 1 << 31


@dataclass(frozen=True, eq=False)
class EventPacket:
    """One message, undecoded.

    Attributes:
        number: of the message, as the driver counted them.
        time_base_ns: what the timestamps inside count from; 0 where they count from the sensor's start.
        encoding: one of `ENCODINGS`.
        is_big_endian: byte order of the payload.
        payload: (N,) bytes.
    """

    header: EventHeader
    number: int
    time_base_ns: int
    encoding: str
    is_big_endian: bool
    payload: NDArray[np.uint8]

    def words(self, kind: str) -> NDArray[np.void]:
        """View the payload as words of one kind: "u2", "u8".

        Raises:
            ValueError: it does not hold a whole number of them.
        """
        dtype = np.dtype(f"{'>' if self.is_big_endian else '<'}{kind}")
        if len(self.payload) % dtype.itemsize:
            raise ValueError(
                f"{len(self.payload)} bytes are not a whole number of {dtype.itemsize}-byte words"
            )
        return self.payload.view(dtype)


def parse_packet(data: bytes, encoding: str) -> EventPacket:
    """Read a message up to its payload.

    Args:
        data: the message as it lies in the bag.
        encoding: "ros1" or "cdr".

    Raises:
        ValueError: it is damaged.
    """
    reader = MessageReader(data, encoding)
    header = read_header(reader)
    number, time_base_ns = reader.number("Q"), reader.number("Q")
    if time_base_ns > limits.MAX_TIME_NS:
        raise ValueError(f"its time base, {time_base_ns} ns, is beyond any clock")
    name = reader.text()
    is_big_endian = bool(reader.number("B"))
    n_bytes = limits.check_size(reader.number("I"), "a packet", limits.MAX_PACKET_BYTES)
    payload = reader.block(n_bytes)
    return EventPacket(header, number, time_base_ns, name, is_big_endian, payload)


class PacketDecoder:
    """Decodes the packets of one topic in turn; EVT3 continues from one to the next."""

    def __init__(self) -> None:
        self._evt3 = WordDecoder(EVT3)
        self._compressed = WordDecoder(LIBCAER_CMP)
        self._waiting: list[EventPacket] = []
        self._n_waiting_bytes = 0
        self._n_trigger_packets = 0

    def decode(self, packet: EventPacket) -> Iterator[EventColumns]:
        """Yield what is decoded by now: small EVT3 packets are decoded together, later.

        Raises:
            ValueError: the packet is damaged or of no known encoding.
        """
        if packet.encoding == "evt3":
            packet.words("u2")
            self._waiting.append(packet)
            self._n_waiting_bytes += len(packet.payload)
            if self._n_waiting_bytes >= _BATCH_BYTES:
                yield from self.finish()
            return
        yield from self.finish()
        if packet.encoding == "mono":
            yield _decode_mono(packet)
        elif packet.encoding == "libcaer":
            yield _decode_libcaer(packet)
        elif packet.encoding == "libcaer_cmp":
            self._compressed.start_packet()
            for words in _pieces(packet.words("u2").astype(np.uint16)):
                yield _shift(self._compressed.decode(words), packet)
        elif packet.encoding == "trigger":
            self._n_trigger_packets += 1
        else:
            raise ValueError(f"encoding {packet.encoding!r} is none of {', '.join(ENCODINGS)}")

    def finish(self) -> Iterator[EventColumns]:
        """Yield what waits."""
        if self._waiting:
            words = [packet.words("u2").astype(np.uint16) for packet in self._waiting]
            host_ns: int | None = self._waiting[0].header.stamp_ns
            self._waiting, self._n_waiting_bytes = [], 0
            for piece in _pieces(np.concatenate(words)):
                events = self._evt3.decode(piece)
                yield EventColumns(events.t_ns, events.x, events.y, events.polarity, host_ns)
                host_ns = None

    def account(self, losses: Losses) -> None:
        """Count what was skipped, and what could not be decoded inside packets."""
        losses.add(findings.TRIGGER_PACKETS(), self._n_trigger_packets)
        losses.add(findings.EVENTS_UNTIMED(), self._evt3.n_untimed)
        n_repaired = self._evt3.n_repaired + self._compressed.n_repaired
        losses.add(findings.TIME_WORDS_REPAIRED(), n_repaired)
        losses.add(findings.UNKNOWN_WORDS(), self._evt3.n_unknown + self._compressed.n_unknown)


def _pieces(words: NDArray[np.uint16]) -> Iterator[NDArray[np.uint16]]:
    return (words[at : at + _WORDS_AT_ONCE] for at in range(0, len(words), _WORDS_AT_ONCE))


def _shift(events: EventColumns, packet: EventPacket) -> EventColumns:
    # The driver's time base has nanoseconds of its own start; the codec drops them, and so do we.
    base_ns = packet.time_base_ns // NS_PER_US * NS_PER_US
    return EventColumns(events.t_ns + base_ns, events.x, events.y, events.polarity, packet.header.stamp_ns)


def _decode_mono(packet: EventPacket) -> EventColumns:
    """Decode polarity 1 | y 15 | x 16 | ns after the time base 32 bits."""
    words = packet.words("u8").astype(np.uint64)
    upper = (words >> np.uint64(32)).astype(np.uint32)
    t_ns = packet.time_base_ns + (words & np.uint64(0xFFFFFFFF)).astype(np.int64)
    x, y = (upper & 0xFFFF).astype(np.uint16), ((upper >> 16) & 0x7FFF).astype(np.uint16)
    return EventColumns(t_ns, x, y, (upper >> 31).astype(bool), packet.header.stamp_ns)


def _decode_libcaer(packet: EventPacket) -> EventColumns:
    """Decode x 15 | y 15 | polarity 1 | valid 1 bits, then 31 bits of us, which may wrap inside a packet."""
    pairs = packet.words("u4").astype(np.uint32)
    if len(pairs) % 2:
        raise ValueError(f"{len(packet.payload)} bytes are not a whole number of 8-byte events")
    where, t_us = pairs[0::2], pairs[1::2].astype(np.int64)
    wraps = np.cumsum(np.diff(t_us, prepend=t_us[:1]) < -_LIBCAER_WRAP_US // 2)
    t_ns = packet.time_base_ns + (t_us + wraps * _LIBCAER_WRAP_US) * NS_PER_US
    x, y = (where >> 17).astype(np.uint16), ((where >> 2) & 0x7FFF).astype(np.uint16)
    return EventColumns(t_ns, x, y, (where >> 1 & 1).astype(bool), packet.header.stamp_ns)


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
        first = next((message for _, message in _messages(self._bag, self._topic, Losses())), None)
        end_ns = self._bag.end_ns(self._topic)
        return None if first is None or end_ns is None else end_ns - first.log_ns

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events, one or several messages at a time."""
        decoder = PacketDecoder()
        last_number: int | None = None
        first_ns: int | None = None
        for index, message in _messages(self._bag, self._topic, losses):
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
                losses.add(findings.BROKEN_PACKETS(where=where))
                continue
            if last_number is not None and packet.number > last_number + 1:
                lost = packet.number - last_number - 1
                losses.add(findings.PACKETS_LOST(where=f"before message {index}"), lost)
            last_number = packet.number
        yield from decoder.finish()
        decoder.account(losses)

    def _check_size(self, header: EventHeader) -> None:
        size = header.width_px, header.height_px
        if self.resolution_px and size != self.resolution_px:
            raise ValueError(f"it is of {size[0]}x{size[1]} pixels")

    def _first_header(self) -> EventHeader | None:
        for _, message in _messages(self._bag, self._topic, Losses()):
            try:
                if self._is_array:
                    return decode_event_array(message.data, message.encoding)[0]
                return parse_packet(message.data, message.encoding).header
            except ValueError:
                continue
        return None


def _messages(bag: BagFile, topic: str, losses: Losses) -> Iterator[tuple[int, RawMessage]]:
    """Yield the messages of a topic with their number; a tear in the bag is counted and ends them."""
    messages = bag.messages({topic})
    index = 0
    while True:
        try:
            message = next(messages, None)
        except SourceError as error:
            losses.add(findings.BAG_TORN(where=error.what))
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
    for _, message in _messages(bag, topic, Losses()):
        with suppress(ValueError):
            return parse_packet(message.data, message.encoding).encoding == "trigger"
    return False
