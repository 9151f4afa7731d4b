"""A bag's topics: their assignment to the sensors of a rig, and a survey of them for a new profile."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Stream
from lce_rig.core.errors import SourceError
from lce_rig.io.camera_description import describe_message, is_rectified
from lce_rig.io.recording import SourceOptions
from lce_rig.io.ros.bag_file import BagFile, RawMessage, list_topics
from lce_rig.io.ros.event_messages import EVENT_TYPES, read_event_head
from lce_rig.io.ros.messages import (
    LIVOX_TYPES,
    decode_livox,
    decode_pointcloud2,
    decode_ros_image,
    deserialize,
)
from lce_rig.rig import Rig

CLOUD_TYPES = frozenset({"sensor_msgs/PointCloud2"}) | LIVOX_TYPES
PACKET_TYPES = frozenset({"velodyne_msgs/VelodyneScan"})
IMAGE_TYPES = frozenset({"sensor_msgs/Image", "sensor_msgs/CompressedImage"})
_INFO = "sensor_msgs/CameraInfo"
# Images computed by image_proc from image_raw: as a second camera they would count twice.
_COMPUTED = frozenset({"image_mono", "image_color", "image_rect", "image_rect_color"})
# Video message types, such as theora_image_transport/Packet and foxglove_msgs/CompressedVideo.
_VIDEO = re.compile(r"image_transport\w*/|CompressedVideo$")
# Number of messages within which drivers start.
_N_PROBED = 5000
Topics: TypeAlias = Mapping[str, tuple[str, int]]
"""(Message type, number of messages) by topic."""


@dataclass(frozen=True)
class Target:
    """A camera channel, or a LiDAR (channel None).

    Attributes:
        has_events: whether the channel is of kind events: raw events, or images reconstructed from them by
            other programs.
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
        """Return the stream of messages of this type."""
        if self.channel is None:
            return Stream(self.sensor, "", "scans")
        return Stream(self.sensor, self.channel, "events" if msgtype in EVENT_TYPES else "images")

    def __str__(self) -> str:
        return self.sensor if self.channel is None else f"{self.sensor}.{self.channel}"


def choose_topics(
    path: Path, topics: Topics, rig: Rig, options: SourceOptions, notes: list[str]
) -> dict[str, Target]:
    """Match topics with sensors: as requested, else by the profile, else the only topic of the right type.

    Args:
        path: the bag, for messages.
        topics: (message type, number of messages) by topic.
        notes: receives the choices, in words.

    Returns:
        Sensor by topic: at least one camera channel and one LiDAR, or either one in a part of a recording.

    Raises:
        SourceError: a requested topic is missing or of another type, or there are no images or point clouds;
            the hint lists the topics of the bag.
    """
    targets, asked = _list_targets(rig, options)
    there, chosen = list_topics(topics), dict[str, Target]()

    def take(target: Target, topic: str, reason: str) -> None:
        chosen[topic] = target
        notes.append(f"{path.name}: {target} from {topic}{reason}")
        camera = rig.cameras.get(target.sensor) if target.channel is not None else None
        if camera is not None and is_rectified(topic) and any(camera.intrinsics.distortion):
            what = f"{topic} has rectified images, and the profile's intrinsics of {target.sensor} distortion"
            notes.append(f"{path.name}: {what}: enter the projection matrix, without distortion")

    for target, profile_topic in targets.items():
        candidates = [asked[target]] if target in asked else [profile_topic] if profile_topic else []
        if target not in asked and profile_topic and target.channel is not None:
            candidates.append(f"{profile_topic}/compressed")  # a recorder may have kept only this one
        topic = next((topic for topic in candidates if topic in topics), None)
        if topic is None:
            if target in asked and not options.is_part:
                raise SourceError(f"{path}: no topic {asked[target]} for {target}", there)
            continue
        msgtype, count = topics[topic]
        if topic in chosen:
            raise SourceError(f"{path}: {topic} is requested for both {chosen[topic]} and {target}", there)
        if msgtype in target.types:
            take(target, topic, f" ({count} messages)")
        elif target in asked or target.channel is None:
            types = " or ".join(sorted(target.types))
            raise SourceError(f"{path}: {topic} for {target} is {msgtype}, not {types}", there)
        else:
            notes.append(f"{path.name}: {topic} is {msgtype} and is not read")

    def only(types: frozenset[str]) -> str:
        fitting = [
            each for each, (msgtype, n) in topics.items() if msgtype in types and n > 0 and each not in chosen
        ]
        return fitting[0] if len(fitting) == 1 else ""

    # If the profile names no topic, the only one of the right kind is used.
    for target, profile_topic in targets.items():
        topic = only(EVENT_TYPES)
        if topic and target.has_events and profile_topic is None and target not in chosen.values():
            take(target, topic, ", the only topic with events")
    failures = []
    for is_lidar, what in enumerate(("images", "point clouds")):
        of_kind = [target for target in targets if (target.channel is None) == is_lidar]
        if not of_kind or set(of_kind) & set(chosen.values()):
            continue
        target, profile_topic = of_kind[0], targets[of_kind[0]]
        # Packets are read if the bag lacks the driver's point clouds of them.
        topic = only(target.types & CLOUD_TYPES) or only(target.types)
        if profile_topic is None and topic:
            take(target, topic, f", the only topic with {what}")
            continue
        fault = f"no topic {profile_topic}" if profile_topic else f"no single topic with {what}"
        hint = f"{there}. Choose one with --topic {target}=TOPIC, or set topic in the profile."
        failures.append(SourceError(f"{path}: {fault} for {target}", hint))
    if failures and not (options.is_part and chosen):
        raise failures[0]
    return chosen


def _list_targets(rig: Rig, options: SourceOptions) -> tuple[dict[Target, str | None], dict[Target, str]]:
    """List the rig's sensors with their topics from the profile, and the requested topics.

    Raises:
        SourceError: a topic is given for a sensor that the rig does not have.
    """
    targets: dict[Target, str | None] = {
        Target(name, channel, settings.kind == "events"): settings.topic
        for name, camera in rig.cameras.items()
        for channel, settings in camera.channels.items()
    }
    targets |= {Target(name, None): lidar.topic for name, lidar in rig.lidars.items()}
    # "cam.events", "lidar", and "cam" for the first channel of a camera.
    by_name = {str(target): target for target in targets}
    for name, camera in rig.cameras.items():
        by_name[name] = by_name[f"{name}.{next(iter(camera.channels))}"]
    unknown = sorted(set(options.topics) - set(by_name))
    if unknown:
        sensors = ", ".join(sorted(by_name))
        raise SourceError(f"rig {rig.name!r} has no sensor {unknown[0]!r}; it has {sensors}")
    return targets, {by_name[name]: topic for name, topic in options.topics.items()}


@dataclass(frozen=True)
class SensorTopic:
    """One topic of a bag with a sensor's data.

    Attributes:
        topic: name of the topic.
        kind: "scans", "frames" or "events".
        n_messages: number of messages.
        rate_hz: from the receipt of the first to the bag's end; None for a single one.
        frame: frame_id of the first message's header, or "".
        size_px: (width, height) of images and event arrays; None if not stated.
        n_rings: number of rings of a scan; None for points without a ring.
        intrinsics: intrinsics of its images, from its camera_info topic; None if missing or unusable.
        note: the reason why the intrinsics are unusable, or the changes made to fit them to the images.
        cloud: the first point cloud of a topic of scans; None for packets.
    """

    topic: str
    kind: Literal["scans", "frames", "events"]
    n_messages: int
    rate_hz: float | None = None
    frame: str = ""
    size_px: tuple[int, int] | None = None
    n_rings: int | None = None
    intrinsics: Intrinsics | None = None
    note: str = ""
    cloud: NDArray[Any] | None = field(default=None, compare=False, repr=False)

    @property
    def namespace(self) -> str:
        """The topic's namespace: without its last part and any image transport suffix."""
        return _namespace(self.image_topic)

    @property
    def image_topic(self) -> str:
        """The topic without an image transport suffix such as /compressed."""
        return self.topic.removesuffix("/compressed").removesuffix("/theora")


def _namespace(topic: str) -> str:
    return "/".join([part for part in topic.split("/") if part][:-1])


def survey_bag(path: Path, skipped: list[str] | None = None) -> list[SensorTopic]:
    """List the topics of a bag with images, events and point clouds, in the order of their names.

    Depth images and compressed copies of another image topic are skipped; so are packets if the bag has
    point clouds.

    Args:
        path: the bag.
        skipped: receives the topics that cannot be decoded, with the reason.

    Raises:
        SourceError: the bag cannot be read, or has no such topic.
    """
    bag = BagFile(path)
    types = {topic: kind for topic, (kind, n) in bag.topics.items() if n > 0}
    read = CLOUD_TYPES | PACKET_TYPES | IMAGE_TYPES | EVENT_TYPES
    wanted = {topic for topic, kind in types.items() if kind in read}
    wanted = {topic for topic in wanted if topic.removesuffix("/compressed") not in wanted - {topic}}
    if any(types[topic] in CLOUD_TYPES for topic in wanted):
        wanted = {topic for topic in wanted if types[topic] not in PACKET_TYPES}
    infos = {topic for topic, kind in types.items() if kind == _INFO}
    first: dict[str, RawMessage] = {}
    try:
        for message in islice(bag.messages(wanted | infos), _N_PROBED):
            first.setdefault(message.topic, message)
            if len(first) == len(wanted | infos):
                break
    except SourceError:
        if not first:
            raise
    sensors, skipped = [], [] if skipped is None else skipped
    skipped += [
        f"{topic}: skipped, {kind} is not supported: record raw or compressed images"
        for topic, kind in types.items()
        if _VIDEO.search(kind)
    ]
    skipped += [
        f"{topic}: skipped, it has none of the first {_N_PROBED} messages"
        for topic in sorted(wanted - first.keys())
    ]
    for topic in sorted(wanted & first.keys()):
        message, n = first[topic], bag.topics[topic][1]
        try:
            sensor = _probe(message, n)
        except (SourceError, ValueError) as error:
            skipped.append(f"{topic}: skipped, {error}")
            continue
        if n > 1 and bag.end_ns > message.log_ns:
            sensor = replace(sensor, rate_hz=(n - 1) / ((bag.end_ns - message.log_ns) * 1e-9))
        if sensor.kind != "scans":
            info = _info_of(sensor, infos & first.keys())
            sensor = sensor if info is None else _with_lens(sensor, first[info])
        sensors.append(sensor)
    if not sensors:
        raise SourceError(
            f"{path}: no images, events or point clouds", "\n".join([*skipped, list_topics(bag.topics)])
        )
    return _without_computed(sensors, skipped)


def _probe(message: RawMessage, n: int) -> SensorTopic:
    """Describe a topic with n messages by its first one.

    Raises:
        SourceError, ValueError: the message is damaged, or not an image or scan.
    """
    if message.msgtype in EVENT_TYPES:
        head = read_event_head(message)
        size_px = (head.width_px, head.height_px) if head.width_px > 0 else None
        return SensorTopic(message.topic, "events", n, frame=head.frame_id.lstrip("/"), size_px=size_px)
    content: Any = deserialize(message)
    frame = str(content.header.frame_id).lstrip("/")
    if message.msgtype in IMAGE_TYPES:
        height_px, width_px = decode_ros_image(content).shape[:2]
        return SensorTopic(message.topic, "frames", n, frame=frame, size_px=(width_px, height_px))
    if message.msgtype in PACKET_TYPES:
        return SensorTopic(message.topic, "scans", n, frame=frame)
    if message.msgtype in LIVOX_TYPES:
        return SensorTopic(message.topic, "scans", n, frame=frame, cloud=decode_livox(content))
    cloud = decode_pointcloud2(content)
    n_rings = int(content.height) if content.height > 1 else None
    for name in ("channel", "ring"):
        if name in (cloud.dtype.names or ()) and len(cloud):
            n_rings = len(np.unique(cloud[name]))
    return SensorTopic(message.topic, "scans", n, frame=frame, n_rings=n_rings, cloud=cloud)


def _without_computed(sensors: list[SensorTopic], skipped: list[str]) -> list[SensorTopic]:
    """Drop images computed from raw ones in the same bag; they are added to `skipped`."""
    raw = {sensor.namespace: sensor.topic for sensor in sensors if sensor.image_topic.endswith("/image_raw")}
    kept = []
    for sensor in sensors:
        is_computed = sensor.image_topic.rpartition("/")[2] in _COMPUTED
        if is_computed and sensor.namespace in raw:
            skipped.append(f"{sensor.topic}: skipped, it is computed from {raw[sensor.namespace]}")
        else:
            kept.append(sensor)
    return kept


def _info_of(sensor: SensorTopic, infos: Collection[str]) -> str | None:
    """Return the camera_info topic of an image's topic, or None.

    Drivers publish it beside the image, with an equal prefix (left_camera_info for left_image), or below it.
    """
    beside = sorted(info for info in infos if _namespace(info) == sensor.namespace)
    last = sensor.image_topic.rpartition("/")[2]
    stems = [info for info in beside if last.startswith(_stem(info) or "/")]
    own = [info for info in infos if info == f"{sensor.image_topic}/camera_info"]
    # Another image's has its stem.
    common = [info for info in beside if not _stem(info)]
    return next(iter([*own, *stems, *common]), None)


def _stem(info: str) -> str:
    """Return the part before camera_info in the last part of a topic, such as "left_"."""
    return info.rpartition("/")[2].partition("camera_info")[0]


def _with_lens(sensor: SensorTopic, message: RawMessage) -> SensorTopic:
    """Add the intrinsics of a camera_info topic."""
    try:
        camera = describe_message(deserialize(message))
        lens, notes = camera.intrinsics(sensor.size_px, is_rectified=is_rectified(sensor.topic))
    except ValueError as error:
        return replace(sensor, note=f"{message.topic}: {error}")
    return replace(sensor, intrinsics=lens, note=f"{message.topic}: {'; '.join(notes)}" if notes else "")
