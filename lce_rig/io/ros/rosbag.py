"""A bag as a stream of images, scans and events, by header timestamps."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.data import Image, Sample, Scan, Stream
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Losses
from lce_rig.io import findings
from lce_rig.io.cloud import to_scan
from lce_rig.io.events.event_recording import EventRecording, NoEventsError
from lce_rig.io.findings import worded
from lce_rig.io.recording import SourceOptions, fingerprint, follows, merge_by_time
from lce_rig.io.ros.bag_file import BagFile, RawMessage, list_topics
from lce_rig.io.ros.event_messages import BagEvents
from lce_rig.io.ros.messages import (
    LIVOX_TYPES,
    decode_livox,
    decode_pointcloud2,
    decode_ros_image,
    deserialize,
    header_stamp_ns,
)
from lce_rig.io.ros.receipt_clock import describe, find_foreign, fit_to_receipts
from lce_rig.io.ros.topics import PACKET_TYPES, Target, choose_topics
from lce_rig.io.velodyne_scans import OFFSETS_NOTE, Vlp16Stream
from lce_rig.rig import CameraSettings, LidarSettings, Rig
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.scan_pairing import rig_offset_ns

# Largest fraction of the period by which scans arrive early.
_EARLY = 0.05


class TopicDecoder:
    """Converts the messages of one topic, from a bag or live, to images or scans.

    Args:
        target: the sensor of the topic.
        settings: that sensor's block of the profile.
        clock: model from the timestamps' clock to the recorder's; None if they are the same.

    Attributes:
        n_yielded: samples so far.
        losses: messages and points that were skipped.
        notes: assumptions, in words.
        hint: an action against the failure of the last message that could not be decoded.
    """

    def __init__(
        self,
        target: Target,
        settings: CameraSettings | LidarSettings,
        clock: ClockModel | None = None,
    ) -> None:
        self.n_yielded = 0
        self.losses = Losses()
        self.notes: set[str] = set()
        self.hint = ""
        self._target, self._settings, self._clock = target, settings, clock
        self._last_ns: int | None = None
        self._packets: Vlp16Stream | None = None
        self._parts: list[Scan] = []

    def decode(self, message: RawMessage) -> list[Image | Scan]:
        """Decode one message; a damaged, repeated or late one is counted and yields an empty list."""
        try:
            content, samples = deserialize(message), list[Image | Scan]()
            if message.msgtype in PACKET_TYPES:
                samples += self._assemble(content)
            else:
                sample = self._to_sample(message, content)
                if self._clock is not None and sample.stamp_ns is not None:
                    sample = replace(sample, stamp_ns=self._clock.convert(sample.stamp_ns))
                samples.append(sample)
        except (SourceError, ValueError) as error:
            cause = error.what if isinstance(error, SourceError) else str(error)
            self.hint = error.hint if isinstance(error, SourceError) else ""
            self.losses.add(findings.NOT_DECODED(where=cause))
            return []
        samples = self._in_order(samples)
        if isinstance(self._settings, CameraSettings) or self._settings.has_rings:
            return samples
        # Scans without rings are sparse: they are joined to scans of the profile's rate.
        ready: list[Image | Scan] = []
        for scan in samples:
            assert isinstance(scan, Scan)  # a LiDAR has no images
            first_ns = self._parts[0].stamp_ns if self._parts else None
            least_ns = (1 - _EARLY) * 1e9 / self._settings.rate_hz
            if first_ns is not None and (scan.stamp_ns or 0) - first_ns >= least_ns:
                ready.append(self._join())
            self._parts.append(scan)
        return ready

    def finish(self) -> list[Image | Scan]:
        """Return the last scan, if the recording ends during a revolution or an accumulation."""
        if self._parts:
            return [self._join()]
        last = self._packets.finish() if self._packets else None
        return [] if last is None else self._in_order([last])

    def account(self) -> list[str]:
        """List assumptions and losses as text."""
        lines = sorted(self.notes) + worded(self.losses)
        return lines if self._packets is None else lines + worded(self._packets.losses)

    def _assemble(self, content: Any) -> list[Image | Scan]:
        """Assemble the packets of a message; scans end at the rotor's cut, not with messages."""
        assert isinstance(self._settings, LidarSettings)  # as packets have no camera
        if self._packets is None:
            self._packets = Vlp16Stream(self._target.sensor, self._settings)
            self.notes |= {OFFSETS_NOTE, "scans are assembled from packets"}
        scans: list[Image | Scan] = []
        for packet in content.packets:
            host_ns = int(packet.stamp.sec * 10**9 + packet.stamp.nanosec)
            scan = self._packets.push_data(np.asarray(packet.data).tobytes(), host_ns)
            scans += [] if scan is None else [scan]
        others = self._packets.other_models.most_common(1)
        if others and not self._packets.n_data:
            what = f"its packets are of a {others[0][0]}, not of a {self._packets.product.name}"
            raise SourceError(what, f"Set the model of {self._target.sensor!r} in the profile.")
        return scans

    def _to_sample(self, message: RawMessage, content: Any) -> Image | Scan:
        sensor, channel, stamp_ns = self._target.sensor, self._target.channel, header_stamp_ns(content)
        if stamp_ns == 0:
            self.notes.add("headers have no timestamps; the time of receipt is used")
            stamp_ns = message.log_ns
        if isinstance(self._settings, CameraSettings):
            assert channel is not None  # as every topic of a camera has
            if self._settings.channels[channel].timestamps.reference == "start":
                self.notes.add(
                    "messages have no exposure time; timestamps of its start are used as its middle"
                )
            return Image(sensor, channel, stamp_ns, decode_ros_image(content), message.log_ns)
        cloud = (decode_livox if message.msgtype in LIVOX_TYPES else decode_pointcloud2)(content)
        return to_scan(cloud, sensor, self._settings, message.topic, stamp_ns, message.log_ns, self.notes)

    def _join(self) -> Scan:
        """Join the accumulated scans."""
        parts, self._parts = self._parts, []
        first_ns = parts[0].stamp_ns or 0
        if len(parts) == 1:
            return parts[0]
        self.notes.add(f"scans are accumulated to {getattr(self._settings, 'rate_hz', 0):g} per second")
        offsets_ns = [
            np.zeros(len(part.points), np.int64)
            + (part.stamp_ns or 0)
            - first_ns
            + (0 if part.offset_ns is None else part.offset_ns)
            for part in parts
        ]
        return Scan(
            parts[0].sensor,
            parts[0].stamp_ns,
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.intensity for part in parts]),
            np.concatenate([part.ring for part in parts]),
            np.concatenate(offsets_ns),
            parts[-1].host_ns,
        )

    def _in_order(self, samples: list[Image | Scan]) -> list[Image | Scan]:
        """Keep the samples with timestamps later than their predecessor's; count the others."""
        kept = []
        for sample in samples:
            if follows(sample.stamp_ns, self._last_ns, self.losses):
                self._last_ns = sample.stamp_ns
                kept.append(sample)
        self.n_yielded += len(kept)
        return kept


class BagRecording:
    """A ROS 1 or ROS 2 bag; one message of each kind is in memory at a time.

    Attributes:
        path: the bag's file or folder.
        notes: the topics of each sensor, and after reading the losses.
        key: fingerprint of the bag.
        n_samples: number of messages with images and scans on these topics.
        streams: streams of the sensors.
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
        self.key = fingerprint(file for file in self._bag.files if file.is_file())
        others = (target.stream(self._bag.topics[topic][0]) for topic, target in self._targets.items())
        self.streams = frozenset([*self._events, *others])
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
                damaged.
        """
        parts: list[Iterable[Sample]] = [self._messages(), *self._events.values()]
        try:
            yield from merge_by_time(parts, self._rig)
        finally:
            for events in self._events.values():
                self.notes += [note for note in events.notes if note not in self.notes]

    def _messages(self) -> Iterator[Sample]:
        """Yield images and scans."""
        decoders: dict[str, TopicDecoder] = {}
        clocks = self._fit_clocks()
        for topic, target in self._targets.items():
            sensors = self._rig.lidars if target.channel is None else self._rig.cameras
            decoders[topic] = TopicDecoder(target, sensors[target.sensor], clocks.get(topic))
        try:
            for message in self._bag.messages(self._targets.keys()):
                yield from decoders[message.topic].decode(message)
            for decoder in decoders.values():
                yield from decoder.finish()
        finally:
            for topic, decoder in decoders.items():
                self.notes += [f"{topic}: {line}" for line in decoder.account()]
        for topic, decoder in decoders.items():
            losses = {loss.code: loss for loss in decoder.losses.findings()}
            if decoder.n_yielded == 0 and losses:
                failed = losses.get(findings.NOT_DECODED.code)
                cause = failed.figures["where"] if failed else "its timestamps do not increase"
                raise SourceError(f"{self.path}: no message of {topic} could be used: {cause}", decoder.hint)

    def _fit_clocks(self) -> dict[str, ClockModel]:
        """Fit the clocks of sensors that differ from the others', by topic; add a note for each.

        Sensors with an `expected_offset_s` in the profile are skipped, as are packets.
        """
        topics = {
            topic: target
            for topic, target in self._targets.items()
            if self._bag.topics[topic][0] not in PACKET_TYPES
            and not rig_offset_ns(target.stream(self._bag.topics[topic][0]), self._rig)
        }
        has_host = len(topics) < len(self._targets) or bool(self._events)
        clocks: dict[str, ClockModel] = {}
        # Read an incomplete bag as far as possible; its damage is reported later.
        with suppress(SourceError):
            for topic in find_foreign(self._bag, topics, has_host=has_host):
                target = topics[topic]
                lidar = self._rig.lidars[target.sensor] if target.channel is None else None
                is_sent_after = lidar is not None and lidar.timestamps.reference == "first_firing"
                clock = fit_to_receipts(self._bag, topic, is_sent_after=is_sent_after)
                if clock is not None:
                    clocks[topic] = clock
                    self.notes.append(f"{topic}: {describe(str(target), clock).sentence}")
        return clocks

    def _open_events(self) -> dict[Stream, EventRecording]:
        """Separate the topics of raw events and open them.

        Raises:
            SourceError: events of another resolution; or no events, and no images either.
        """
        opened: dict[Stream, EventRecording] = {}
        for topic, target in list(self._targets.items()):
            stream = target.stream(self._bag.topics[topic][0])
            if stream.kind != "events":
                continue
            del self._targets[topic]
            size = self._rig.cameras[target.sensor].resolution_px
            try:
                events = BagEvents(self.path, topic, self._bag)
                opened[stream] = EventRecording(self.path, events, target.sensor, size)
                opened[stream].tie_to_host()
            except NoEventsError as error:
                if all(other.channel is None for other in self._targets.values()):
                    raise SourceError(f"{topic} of {error.what}", list_topics(self._bag.topics)) from None
                self.notes.append(f"{topic} of {error.what}; read without")
        return opened
