"""Which topic of a bag belongs to which sensor of the rig."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from lce_rig.core.errors import SourceError
from lce_rig.rig import Rig
from lce_rig.sources.base import SourceOptions

CLOUD_TYPES = frozenset({"sensor_msgs/PointCloud2"})
IMAGE_TYPES = frozenset({"sensor_msgs/Image", "sensor_msgs/CompressedImage"})


@dataclass(frozen=True)
class Target:
    """A camera channel, or a LiDAR (channel None)."""

    sensor: str
    channel: str | None

    @property
    def types(self) -> frozenset[str]:
        """Message types that this sensor's data come as."""
        return CLOUD_TYPES if self.channel is None else IMAGE_TYPES

    def __str__(self) -> str:
        return self.sensor if self.channel is None else f"{self.sensor}.{self.channel}"


def choose_topics(
    path: Path, topics: Mapping[str, tuple[str, int]], rig: Rig, options: SourceOptions, notes: list[str]
) -> dict[str, Target]:
    """Match topics and sensors: as asked, else as the profile says, else the only topic of the right type.

    Args:
        path: the bag, for messages.
        topics: (message type, number of messages) by topic.
        notes: receives what was chosen.

    Returns:
        Sensor by topic; at least one camera channel and one LiDAR.

    Raises:
        SourceError: a topic that was asked for is not there or of another type, or no picture or cloud is
            left; the hint lists the topics that are there.
    """
    there = "topics there: " + (
        ", ".join(f"{t} ({m}, {n})" for t, (m, n) in sorted(topics.items())) or "none"
    )
    asked = _parse_overrides(rig, options)
    chosen: dict[str, Target] = {}
    for target, profile_topic in _targets(rig):
        topic = _find_topic(target, asked.get(target), profile_topic, topics)
        if topic is None:
            if target in asked:
                raise SourceError(f"{path}: no topic {asked[target]} for {target}", there)
            continue
        msgtype, count = topics[topic]
        if msgtype in target.types and topic not in chosen:
            chosen[topic] = target
            notes.append(f"{path.name}: {target} from {topic} ({count} messages)")
        elif topic in chosen:
            raise SourceError(f"{path}: {topic} is asked for both {chosen[topic]} and {target}", there)
        elif target in asked or target.channel is None:
            wanted = " or ".join(sorted(target.types))
            raise SourceError(f"{path}: {topic} for {target} is {msgtype}, not {wanted}", there)
        else:
            notes.append(f"{path.name}: {topic} is {msgtype} and is not read")
    for is_camera, what in ((True, "picture"), (False, "cloud")):
        if all((target.channel is not None) != is_camera for target in chosen.values()):
            topic, target = _only_candidate(path, topics, rig, is_camera, there, what)
            chosen[topic] = target
            notes.append(f"{path.name}: {target} from {topic}, the only topic with {what}s")
    return chosen


def _find_topic(
    target: Target, asked: str | None, profile_topic: str | None, topics: Mapping[str, tuple[str, int]]
) -> str | None:
    """Name the topic of a sensor if it is in the bag; a recorder may have kept the compressed one only."""
    if asked is not None:
        return asked if asked in topics else None
    candidates = [] if profile_topic is None else [profile_topic, f"{profile_topic}/compressed"]
    n_candidates = 1 if target.channel is None else 2
    return next((topic for topic in candidates[:n_candidates] if topic in topics), None)


def _targets(rig: Rig) -> list[tuple[Target, str | None]]:
    cameras = [
        (Target(name, channel), settings.topic)
        for name, camera in rig.cameras.items()
        for channel, settings in camera.channels.items()
    ]
    return cameras + [(Target(name, None), lidar.topic) for name, lidar in rig.lidars.items()]


def _parse_overrides(rig: Rig, options: SourceOptions) -> dict[Target, str]:
    """Read "cam", "cam.events" and "lidar" as sensors; a camera alone means its first channel."""
    known = {str(target): target for target, _ in _targets(rig)}
    for name, camera in rig.cameras.items():
        known[name] = Target(name, next(iter(camera.channels)))
    unknown = sorted(set(options.topics) - set(known))
    if unknown:
        raise SourceError(f"rig {rig.name!r} has no sensor {unknown[0]!r}; it has {', '.join(sorted(known))}")
    return {known[name]: topic for name, topic in options.topics.items()}


def _only_candidate(
    path: Path, topics: Mapping[str, tuple[str, int]], rig: Rig, is_camera: bool, there: str, what: str
) -> tuple[str, Target]:
    target, wanted_topic = next(
        (t, topic) for t, topic in _targets(rig) if (t.channel is not None) == is_camera
    )
    fitting = sorted(topic for topic, (msgtype, n) in topics.items() if msgtype in target.types and n > 0)
    if wanted_topic is None and len(fitting) == 1:
        return fitting[0], target
    asked = (
        f"no topic {wanted_topic} for {target}"
        if wanted_topic
        else f"no single topic with {what}s for {target}"
    )
    hint = f"{there}. Say which with --topic {target}=TOPIC, or set topic in the profile."
    raise SourceError(f"{path}: {asked}", hint)
