"""A bag as a stream of images, scans and events, by the timestamps in their headers."""

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.data import Image, Sample, Scan, Stream
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses
from lce_rig.io import findings
from lce_rig.io.events.event_recording import CameraEvents, EventRecording
from lce_rig.io.events.stream import NoEventsError, worded
from lce_rig.io.folder.cloud import to_scan
from lce_rig.io.joining import check_overlap, merge_by_time
from lce_rig.io.protocol import SourceOptions, Span
from lce_rig.io.ros.bag_file import BagFile, RawMessage, list_topics
from lce_rig.io.ros.event_messages import BagEvents
from lce_rig.io.ros.messages import (
    decode_pointcloud2,
    decode_ros_image,
    deserialize,
    header_stamp_ns,
)
from lce_rig.io.ros.topics import PACKET_TYPES, Target, choose_topics
from lce_rig.io.velodyne.stream import OFFSETS_NOTE, Vlp16Stream
from lce_rig.rig import CameraSettings, LidarSettings, Rig

# A timestamp this much earlier than the one before is a clock that was set, not a message that came late.
CLOCK_JUMP_NS = 1_000_000_000
# Drivers start within this many messages of each other; the span of a later one is not known beforehand.
_N_PROBED = 500


class TopicDecoder:
    """Makes the images or scans of one topic from its messages, of a bag or live.

    Args:
        target: the sensor it belongs to.
        settings: that sensor's block of the profile.

    Attributes:
        n_yielded: samples so far.
        losses: what was skipped.
        notes: what was assumed, in words.
        hint: what to do about the last message that could not be decoded.
    """

    def __init__(self, target: Target, settings: CameraSettings | LidarSettings) -> None:
        self.n_yielded = 0
        self.losses = Losses()
        self.notes: set[str] = set()
        self._target, self._settings = target, settings
        self._last_ns: int | None = None
        self._packets: Vlp16Stream | None = None
        self._waiting: list[Scan] = []
        self.hint = ""

    def decode(self, message: RawMessage) -> Image | Scan | None:
        """Decode one message; None, and counted, where it is damaged, sent twice or late."""
        try:
            content = deserialize(message)
            if message.msgtype in PACKET_TYPES:
                self._take_packets(content)
                return self._oldest()
            stamp_ns = header_stamp_ns(content)
            if stamp_ns == 0:
                self.notes.add("headers have no timestamps; the time of receipt is used")
                stamp_ns = message.log_ns
            sample = self._to_sample(message, content, stamp_ns)
        except (SourceError, ValueError) as error:
            cause = error.what if isinstance(error, SourceError) else str(error)
            self.hint = (error.hint or "") if isinstance(error, SourceError) else ""
            self.losses.add(findings.NOT_DECODED(where=cause))
            return None
        if not self._is_in_order(sample.stamp_ns):
            return None
        self.n_yielded += 1
        return sample

    def finish(self) -> Iterator[Scan]:
        """Yield the scans that wait: a revolution of packets may end with the recording."""
        last = self._packets.finish() if self._packets else None
        self._waiting += [] if last is None else [last]
        while (scan := self._oldest()) is not None:
            yield scan

    def account(self) -> list[str]:
        """Say what was assumed and skipped, in words."""
        lines = sorted(self.notes) + worded(self.losses)
        return lines if self._packets is None else lines + self._packets.account()

    def _take_packets(self, content: Any) -> None:
        """Assemble the packets of a message; a scan ends where the rotor passes the cut, not the message."""
        assert isinstance(self._settings, LidarSettings)  # as packets have no camera
        if self._packets is None:
            self._packets = Vlp16Stream(self._target.sensor, self._settings)
            self.notes |= {OFFSETS_NOTE, "scans are assembled from packets"}
        for packet in content.packets:
            host_ns = int(packet.stamp.sec * 10**9 + packet.stamp.nanosec)
            scan = self._packets.push_data(np.asarray(packet.data).tobytes(), host_ns)
            self._waiting += [] if scan is None else [scan]
        others = self._packets.other_models.most_common(1)
        if others and not self._packets.n_data:
            what = f"its packets are of a {others[0][0]}, not of a {self._packets.product.name}"
            raise SourceError(what, f"Set the model of {self._target.sensor!r} in the profile.")

    def _oldest(self) -> Scan | None:
        while self._waiting:
            scan = self._waiting.pop(0)
            if self._is_in_order(scan.stamp_ns):
                self.n_yielded += 1
                return scan
        return None

    def _to_sample(self, message: RawMessage, content: Any, stamp_ns: int) -> Image | Scan:
        sensor, channel = self._target.sensor, self._target.channel
        if isinstance(self._settings, CameraSettings):
            assert channel is not None  # as every topic of a camera has
            pixels = decode_ros_image(content)
            if self._settings.channels[channel].timestamps.reference == "start":
                self.notes.add(
                    "messages have no exposure time; timestamps of its start are used as its middle"
                )
            return Image(sensor, channel, stamp_ns, pixels, message.log_ns)
        cloud = decode_pointcloud2(content)
        reading = to_scan(cloud, sensor, self._settings, message.topic, stamp_ns, message.log_ns)
        self.notes.update(reading.notes)
        n_without_return = reading.n_not_finite + reading.n_zero_range
        self.losses.add(findings.POINTS_WITHOUT_RETURN(), n_without_return)
        return reading.scan

    def _is_in_order(self, stamp_ns: int | None) -> bool:
        """Return whether a timestamp is later than its predecessor; count it where it is not."""
        if stamp_ns is None or self._last_ns is None or stamp_ns > self._last_ns:
            self._last_ns = stamp_ns
            return True
        if stamp_ns == self._last_ns:
            self.losses.add(findings.SENT_TWICE())
            return False
        if self._last_ns - stamp_ns < CLOCK_JUMP_NS:
            self.losses.add(findings.OUT_OF_ORDER())
            return False
        self.losses.add(findings.CLOCK_SET_BACK())
        self._last_ns = stamp_ns
        return True


class BagRecording:
    """A ROS 1 or ROS 2 bag; one message of each kind is in memory at a time.

    Attributes:
        path: the bag's file or folder.
        notes: topics taken, and after reading what was skipped and why.
        key: fingerprint of the bag.
        n_samples: number of messages with images and scans on the topics taken.
        streams: what is read, with its span where the bag holds events or is a part of a recording.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the topics.

        Raises:
            SourceError: the bag cannot be read, or lacks a topic; the message lists those that are there.
        """
        self.path = path
        self.notes: list[str] = []
        self._rig = rig
        self._bag = BagFile(path)
        self._targets = choose_topics(path, self._bag.topics, rig, options, self.notes)
        self._events = self._open_events()
        self.n_samples = sum(self._bag.topics[topic][1] for topic in self._targets)
        self.key = self._bag.fingerprint()
        self.streams = self._list_streams(is_spanned=bool(self._events) or options.is_part)
        events, scans = (
            {s: span for s, span in self.streams.items() if s.kind == kind} for kind in ("events", "scans")
        )
        self.notes += check_overlap(scans, events, rig)
        for file in self._bag.files:
            journal = file.with_name(f"{file.name}-wal")
            if journal.exists() and journal.stat().st_size:
                hint = "its last messages are not read; opening the bag once with sqlite3 merges them"
                self.notes.append(f"{journal.name} lies beside the bag: {hint}")
        self.notes += [f"skipped: {error.what}" for error in self._bag.damages]

    def samples(self) -> Iterator[Sample]:
        """Yield images and scans in the order the recorder received them, and events by their timestamps.

        Each sensor's timestamps rise. Messages sent twice, late, or damaged are skipped and counted in
        `notes`. Where the clock of a camera or LiDAR is set back by more than a second its timestamps start
        again from there.

        Raises:
            SourceError: no message of a topic could be decoded; or, after all that can be read, the bag is
                torn.
        """
        parts = [self._messages(), *(events.samples() for events in self._events.values())]
        try:
            yield from merge_by_time(parts, self._rig)
        finally:
            for events in self._events.values():
                self.notes += [note for note in events.notes if note not in self.notes]

    def _messages(self) -> Iterator[Sample]:
        decoders = {
            topic: TopicDecoder(target, self._settings(target)) for topic, target in self._targets.items()
        }
        try:
            for message in self._bag.messages(self._targets.keys()):
                sample = decoders[message.topic].decode(message)
                if sample is not None:
                    yield sample
            for decoder in decoders.values():
                yield from decoder.finish()
        finally:
            self._summarise(decoders)
        for topic, decoder in decoders.items():
            found = {each.code: each for each in decoder.losses.findings()}
            if decoder.n_yielded == 0 and found:
                failed = found.get("recording.not_decoded")
                cause = failed.figures["where"] if failed else "its timestamps do not increase"
                raise SourceError(f"{self.path}: no message of {topic} could be used: {cause}", decoder.hint)

    def _settings(self, target: Target) -> CameraSettings | LidarSettings:
        is_lidar = target.channel is None
        return self._rig.lidars[target.sensor] if is_lidar else self._rig.cameras[target.sensor]

    def _open_events(self) -> dict[Stream, CameraEvents]:
        """Take the topics of raw events out of the others and open them.

        Raises:
            SourceError: events of another resolution; or no events, and no images either.
        """
        opened: dict[Stream, CameraEvents] = {}
        for topic, target in list(self._targets.items()):
            stream = target.stream(self._bag.topics[topic][0])
            if stream.kind != "events":
                continue
            del self._targets[topic]
            size = self._rig.cameras[target.sensor].resolution_px
            try:
                events = BagEvents(self.path, topic, self._bag)
                opened[stream] = CameraEvents(EventRecording(self.path, events, target.sensor, size))
            except NoEventsError as error:
                if all(other.channel is None for other in self._targets.values()):
                    raise SourceError(f"{topic} of {error.what}", list_topics(self._bag.topics)) from None
                self.notes.append(f"{topic} of {error.what}; read without")
        return opened

    def _list_streams(self, is_spanned: bool) -> dict[Stream, Span | None]:
        streams: dict[Stream, Span | None] = {s: events.span_ns for s, events in self._events.items()}
        begun = self._first_stamps() if is_spanned else {}
        for topic, target in self._targets.items():
            stamp_ns, log_ns = begun.get(topic, (None, None))
            end_ns = self._bag.end_ns(topic) if topic in begun else None
            stream = target.stream(self._bag.topics[topic][0])
            if stamp_ns is None or log_ns is None or end_ns is None:
                streams[stream] = None
            else:
                streams[stream] = stamp_ns, stamp_ns + end_ns - log_ns
        return streams

    def _first_stamps(self) -> dict[str, tuple[int, int]]:
        """Find (timestamp, time of receipt) of the first message of each topic, as far as they come early."""
        found: dict[str, tuple[int, int]] = {}
        try:
            for message in islice(self._bag.messages(self._targets.keys()), _N_PROBED):
                if message.topic not in found:
                    with suppress(ValueError):
                        stamp_ns = header_stamp_ns(deserialize(message)) or message.log_ns
                        found[message.topic] = stamp_ns, message.log_ns
                if len(found) == len(self._targets):
                    break
        except SourceError:
            pass  # Reported once everything before the damage has been read.
        return found

    def _summarise(self, decoders: dict[str, TopicDecoder]) -> None:
        for topic, decoder in decoders.items():
            self.notes += [f"{topic}: {line}" for line in decoder.account()]
