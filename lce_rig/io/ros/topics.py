"""Assignment of a bag's topics to the sensors of the rig."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from lce_rig.core.data import Stream
from lce_rig.core.errors import SourceError
from lce_rig.io.protocol import SourceOptions
from lce_rig.io.ros.bag_file import list_topics
from lce_rig.io.ros.event_messages import EVENT_TYPES
from lce_rig.rig import Rig

CLOUD_TYPES = frozenset({"sensor_msgs/PointCloud2"})
PACKET_TYPES = frozenset({"velodyne_msgs/VelodyneScan"})
IMAGE_TYPES = frozenset({"sensor_msgs/Image", "sensor_msgs/CompressedImage"})
Topics: TypeAlias = Mapping[str, tuple[str, int]]
"""(Message type, number of messages) by topic."""


@dataclass(frozen=True)
class Target:
    """A camera channel, or a LiDAR (channel None).

    Attributes:
        has_events: whether the channel is of kind events: raw ones, or images that others made of them.
    """

    sensor: str
    channel: str | None
    has_events: bool = False

    @property
    def types(self) -> frozenset[str]:
        """Message types of this sensor's data."""
        if self.channel is None:
            return CLOUD_TYPES | PACKET_TYPES
        return IMAGE_TYPES | EVENT_TYPES if self.has_events else IMAGE_TYPES

    def stream(self, msgtype: str) -> Stream:
        """Name the stream that messages of this type make."""
        if self.channel is None:
            return Stream(self.sensor, "", "scans")
        return Stream(self.sensor, self.channel, "events" if msgtype in EVENT_TYPES else "images")

    def __str__(self) -> str:
        return self.sensor if self.channel is None else f"{self.sensor}.{self.channel}"


def choose_topics(
    path: Path, topics: Topics, rig: Rig, options: SourceOptions, notes: list[str]
) -> dict[str, Target]:
    """Match topics and sensors: as asked, else as the profile says, else the only topic of the right type.

    Args:
        path: the bag, for messages.
        topics: (message type, number of messages) by topic.
        notes: receives what was chosen.

    Returns:
        Sensor by topic; at least one camera channel and one LiDAR, one of the two in a part of a recording.

    Raises:
        SourceError: a topic that was asked for is not there or of another type, or no image or point cloud is
            left; the hint lists the topics that are there.
    """
    there = list_topics(topics)
    targets = [
        (Target(name, channel, settings.kind == "events"), settings.topic)
        for name, camera in rig.cameras.items()
        for channel, settings in camera.channels.items()
    ]
    targets += [(Target(name, None), lidar.topic) for name, lidar in rig.lidars.items()]
    # "cam.events", "lidar", and "cam" for the first channel of a camera.
    by_name = {str(target): target for target, _ in targets}
    for name, camera in rig.cameras.items():
        by_name[name] = by_name[f"{name}.{next(iter(camera.channels))}"]
    unknown = sorted(set(options.topics) - set(by_name))
    if unknown:
        sensors = ", ".join(sorted(by_name))
        raise SourceError(f"rig {rig.name!r} has no sensor {unknown[0]!r}; it has {sensors}")
    asked = {by_name[name]: topic for name, topic in options.topics.items()}
    chosen: dict[str, Target] = {}
    for target, profile_topic in targets:
        candidates = [asked[target]] if target in asked else [profile_topic] if profile_topic else []
        if target not in asked and profile_topic and target.channel is not None:
            candidates.append(f"{profile_topic}/compressed")  # a recorder may have kept that one only
        topic = next((topic for topic in candidates if topic in topics), None)
        if topic is None:
            if target in asked and not options.is_part:
                raise SourceError(f"{path}: no topic {asked[target]} for {target}", there)
            continue
        msgtype, count = topics[topic]
        if msgtype in target.types and topic not in chosen:
            chosen[topic] = target
            notes.append(f"{path.name}: {target} from {topic} ({count} messages)")
        elif topic in chosen:
            raise SourceError(f"{path}: {topic} is requested for both {chosen[topic]} and {target}", there)
        elif target in asked or target.channel is None:
            types = " or ".join(sorted(target.types))
            raise SourceError(f"{path}: {topic} for {target} is {msgtype}, not {types}", there)
        else:
            notes.append(f"{path.name}: {topic} is {msgtype} and is not read")
    for target, profile_topic in targets:
        fitting = [topic for topic in _fitting(topics, EVENT_TYPES) if topic not in chosen]
        is_open = target.has_events and profile_topic is None and target not in chosen.values()
        if is_open and len(fitting) == 1:
            chosen[fitting[0]] = target
            notes.append(f"{path.name}: {target} from {fitting[0]}, the only topic with events")
    failures = [
        failure
        for what in ("image", "point cloud")
        if (failure := _add_only_topic(path, topics, targets, chosen, notes, what)) is not None
    ]
    if failures and not (options.is_part and chosen):
        raise failures[0]
    return chosen


def _add_only_topic(
    path: Path,
    topics: Topics,
    targets: Sequence[tuple[Target, str | None]],
    chosen: dict[str, Target],
    notes: list[str],
    what: str,
) -> SourceError | None:
    """Give the rig's first camera or LiDAR the only topic of its kind, where the profile names none.

    Returns:
        The error for a rig without one; None where there is one.
    """
    of_kind = [pair for pair in targets if (pair[0].channel is not None) == (what == "image")]
    if any(target in chosen.values() for target, _ in of_kind):
        return None
    target, profile_topic = of_kind[0]
    # Packets are read where a driver's point clouds of them were not recorded.
    fitting = _fitting(topics, target.types & CLOUD_TYPES) or _fitting(topics, target.types)
    if profile_topic is None and len(fitting) == 1:
        chosen[fitting[0]] = target
        notes.append(f"{path.name}: {target} from {fitting[0]}, the only topic with {what}s")
        return None
    fault = f"no topic {profile_topic}" if profile_topic else f"no single topic with {what}s"
    hint = f"{list_topics(topics)}. Say which with --topic {target}=TOPIC, or set topic in the profile."
    return SourceError(f"{path}: {fault} for {target}", hint)


def _fitting(topics: Topics, types: frozenset[str]) -> list[str]:
    return sorted(topic for topic, (msgtype, n) in topics.items() if msgtype in types and n > 0)
