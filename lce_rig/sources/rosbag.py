"""A bag as a stream of pictures and scans, by the stamps in their headers."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from lce_rig.core.data import Image
from lce_rig.core.errors import SourceError
from lce_rig.rig import Rig
from lce_rig.sources.bag_file import BagFile, RawMessage
from lce_rig.sources.base import Sample, SourceOptions
from lce_rig.sources.cloud import to_scan
from lce_rig.sources.pointcloud2 import decode_pointcloud2
from lce_rig.sources.ros_image import decode_ros_compressed_image, decode_ros_image
from lce_rig.sources.topics import Target, choose_topics

# A stamp this much earlier than the one before is a clock that was set, not a message that came late.
CLOCK_JUMP_NS = 1_000_000_000


@dataclass
class _Stream:
    """What was seen of one topic so far."""

    last_ns: int | None = None
    n_yielded: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    notes: set[str] = field(default_factory=set)
    first_failure: str = ""


class BagRecording:
    """A ROS 1 or ROS 2 bag; one message is in memory at a time.

    Attributes:
        path: the bag's file or folder.
        notes: topics taken, and after reading what was left out and why.
        key: fingerprint of the bag.
        n_samples: number of messages on the topics taken.
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
        self.n_samples = sum(self._bag.topics[topic][1] for topic in self._targets)
        self.key = self._bag.fingerprint()
        for journal in self._bag.unmerged_journals():
            hint = "its last messages are not read; opening the bag once with sqlite3 merges them"
            self.notes.append(f"{journal.name} lies beside the bag: {hint}")
        if self._bag.damage:
            self.notes.append(f"{path.name}: damaged ({self._bag.damage}); read as far as it goes")

    def samples(self) -> Iterator[Sample]:
        """Yield pictures and scans in the order the recorder received them; each sensor's stamps rise.

        Messages sent twice, late, or damaged are left out and counted in `notes`. Where a sensor's clock is
        set back by more than a second its stamps start again from there.

        Raises:
            SourceError: no message of a topic could be decoded; or, after all that can be read, the bag is
                torn.
        """
        streams = {topic: _Stream() for topic in self._targets}
        try:
            for message in self._bag.messages(self._targets.keys()):
                stream = streams[message.topic]
                sample = self._decode(message, stream)
                if sample is not None and _is_in_order(sample, stream):
                    stream.n_yielded += 1
                    yield sample
        finally:
            self._summarise(streams)
        for topic, stream in streams.items():
            if stream.n_yielded == 0 and stream.counts:
                cause = stream.first_failure or "its stamps do not rise"
                raise SourceError(f"{self.path}: no message of {topic} could be used: {cause}")

    def _decode(self, message: RawMessage, stream: _Stream) -> Sample | None:
        target = self._targets[message.topic]
        try:
            content = _deserialize(message)
            stamp_ns = content.header.stamp.sec * 10**9 + content.header.stamp.nanosec
            if stamp_ns == 0:
                stream.notes.add("headers carry no stamps: time of receipt taken")
                stamp_ns = message.log_ns
            return self._to_sample(message, content, target, stamp_ns, stream)
        except (SourceError, ValueError) as error:
            cause = error.what if isinstance(error, SourceError) else str(error)
            stream.first_failure = stream.first_failure or cause
            stream.counts["could not be decoded"] += 1
            return None

    def _to_sample(
        self, message: RawMessage, content: Any, target: Target, stamp_ns: int, stream: _Stream
    ) -> Sample:
        if target.channel is not None:
            is_compressed = message.msgtype.endswith("CompressedImage")
            pixels = decode_ros_compressed_image(content) if is_compressed else decode_ros_image(content)
            return Image(target.sensor, target.channel, stamp_ns, pixels, message.log_ns)
        settings = self._rig.lidars[target.sensor]
        cloud = decode_pointcloud2(content)
        reading = to_scan(cloud, target.sensor, settings, message.topic, stamp_ns, message.log_ns)
        stream.notes.update(reading.notes)
        n_dropped = reading.n_not_finite + reading.n_zero_range
        stream.counts["points without a return"] += n_dropped
        return reading.scan

    def _summarise(self, streams: dict[str, _Stream]) -> None:
        for topic, stream in streams.items():
            for note in sorted(stream.notes):
                self.notes.append(f"{topic}: {note}")
            for what, count in sorted(stream.counts.items()):
                cause = f" ({stream.first_failure})" if what == "could not be decoded" else ""
                if count:
                    self.notes.append(f"{topic}: {count} {what}{cause}")


def _deserialize(message: RawMessage) -> Any:
    """Deserialise by ROS's own definitions; those in a bag may be missing, or beyond what rosbags parses."""
    is_ros1 = message.encoding == "ros1"
    store = _typestore(is_ros1)
    msgtype = message.msgtype.replace("/", "/msg/")
    try:
        if is_ros1:
            return store.deserialize_ros1(message.data, msgtype)
        return store.deserialize_cdr(message.data, msgtype)
    except Exception as error:  # A damaged message fails in any way: struct, assert, unicode, index.
        raise ValueError(f"a message is damaged: {str(error) or type(error).__name__}") from None


@cache
def _typestore(is_ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)


def _is_in_order(sample: Sample, stream: _Stream) -> bool:
    """Tell whether a sample's stamp is later than its predecessor's; count it where it is not."""
    stamp_ns = sample.stamp_ns
    if stamp_ns is None or stream.last_ns is None or stamp_ns > stream.last_ns:
        stream.last_ns = stamp_ns
        return True
    if stamp_ns == stream.last_ns:
        stream.counts["sent twice (equal stamps)"] += 1
        return False
    if stream.last_ns - stamp_ns < CLOCK_JUMP_NS:
        stream.counts["out of order (stamps run backwards)"] += 1
        return False
    stream.counts["jumps of the clock back by more than a second"] += 1
    stream.last_ns = stamp_ns
    return True
