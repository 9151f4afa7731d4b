"""Assignment of a bag's topics to the sensors of the rig."""

from collections.abc import Mapping
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
        """Message types that this sensor's data come as."""
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
    asked = _parse_overrides(rig, options)
    chosen: dict[str, Target] = {}
    for target, profile_topic in _targets(rig):
        topic = _find_topic(target, asked.get(target), profile_topic, topics)
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
            wanted = " or ".join(sorted(target.types))
            raise SourceError(f"{path}: {topic} for {target} is {msgtype}, not {wanted}", there)
        else:
            notes.append(f"{path.name}: {topic} is {msgtype} and is not read")
    _add_only_events(path, topics, rig, chosen, notes)
    _add_only_candidates(path, topics, rig, chosen, notes, options.is_part)
    return chosen


def _find_topic(target: Target, asked: str | None, profile_topic: str | None, topics: Topics) -> str | None:
    """Name the topic of a sensor if it is in the bag; a recorder may have kept the compressed one only."""
    if asked is not None:
        return asked if asked in topics else None
    candidates = [] if profile_topic is None else [profile_topic, f"{profile_topic}/compressed"]
    n_candidates = 1 if target.channel is None else 2
    return next((topic for topic in candidates[:n_candidates] if topic in topics), None)


def _targets(rig: Rig) -> list[tuple[Target, str | None]]:
    cameras = [
        (Target(name, channel, settings.kind == "events"), settings.topic)
        for name, camera in rig.cameras.items()
        for channel, settings in camera.channels.items()
    ]
    return cameras + [(Target(name, None), lidar.topic) for name, lidar in rig.lidars.items()]


def _parse_overrides(rig: Rig, options: SourceOptions) -> dict[Target, str]:
    """Read "cam", "cam.events" and "lidar" as sensors; a camera alone means its first channel."""
    known = {str(target): target for target, _ in _targets(rig)}
    for name, camera in rig.cameras.items():
        known[name] = known[f"{name}.{next(iter(camera.channels))}"]
    unknown = sorted(set(options.topics) - set(known))
    if unknown:
        raise SourceError(f"rig {rig.name!r} has no sensor {unknown[0]!r}; it has {', '.join(sorted(known))}")
    return {known[name]: topic for name, topic in options.topics.items()}


def _add_only_events(
    path: Path, topics: Topics, rig: Rig, chosen: dict[str, Target], notes: list[str]
) -> None:
    """Give a channel of events without a topic in the profile the only topic of events there is."""
    for target, wanted_topic in _targets(rig):
        fitting = [topic for topic in _fitting(topics, EVENT_TYPES) if topic not in chosen]
        is_open = target.has_events and wanted_topic is None and target not in chosen.values()
        if is_open and len(fitting) == 1:
            chosen[fitting[0]] = target
            notes.append(f"{path.name}: {target} from {fitting[0]}, the only topic with events")


def _add_only_candidates(
    path: Path, topics: Topics, rig: Rig, chosen: dict[str, Target], notes: list[str], is_part: bool
) -> None:
    """Give the rig's first camera and LiDAR the only topic of their kind, where the profile names none."""
    failures = []
    for is_camera, what in ((True, "image"), (False, "point cloud")):
        if any((target.channel is not None) == is_camera for target in chosen.values()):
            continue
        target, wanted_topic = next(
            (t, name) for t, name in _targets(rig) if (t.channel is not None) == is_camera
        )
        # Packets are read where a driver's point clouds of them were not recorded.
        clouds = _fitting(topics, target.types & CLOUD_TYPES)
        fitting = clouds or _fitting(topics, target.types)
        if wanted_topic is None and len(fitting) == 1:
            chosen[fitting[0]] = target
            notes.append(f"{path.name}: {target} from {fitting[0]}, the only topic with {what}s")
            continue
        asked = f"no topic {wanted_topic}" if wanted_topic else f"no single topic with {what}s"
        hint = f"{list_topics(topics)}. Say which with --topic {target}=TOPIC, or set topic in the profile."
        failures.append(SourceError(f"{path}: {asked} for {target}", hint))
    if failures and not (is_part and chosen):
        raise failures[0]


def _fitting(topics: Topics, types: frozenset[str]) -> list[str]:
    return sorted(topic for topic, (msgtype, n) in topics.items() if msgtype in types and n > 0)
