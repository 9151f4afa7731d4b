"""The cameras and LiDARs in a bag, as far as a rig's profile needs them."""

from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import SourceError
from lce_rig.io.ros.bag_file import BagFile, RawMessage, list_topics
from lce_rig.io.ros.event_messages import EVENT_TYPES, read_event_head
from lce_rig.io.ros.messages import (
    decode_pointcloud2,
    decode_ros_image,
    deserialize,
)
from lce_rig.io.ros.topics import CLOUD_TYPES, IMAGE_TYPES, PACKET_TYPES

_INFO = "sensor_msgs/CameraInfo"
# Drivers start within this many messages of each other.
_N_PROBED = 5000


@dataclass(frozen=True)
class SensorTopic:
    """One topic of a bag with a sensor's data.

    Attributes:
        topic: its name.
        kind: "scans", "frames" or "events".
        n_messages: how many there are.
        rate_hz: by the times of receipt of the first and the last; None for a single one.
        frame: of the first message's header, "" without.
        size_px: (width, height) of images and event arrays; None where they do not say.
        n_rings: number of rings of a scan; None where points have none.
        intrinsics: by the camera_info topic in the same namespace; None where there is no usable one.
        note: the reason for which the one there is unusable; "" otherwise.
        cloud: the first point cloud of a topic of scans; None where it has packets.
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
        """The topic without its last part, and without that of a transport such as compressed."""
        parts = [part for part in self.topic.split("/") if part]
        if parts[-1] in ("compressed", "theora") and len(parts) > 1:
            parts.pop()
        return "/".join(parts[:-1])


def survey_bag(path: Path) -> list[SensorTopic]:
    """List the topics of a bag with images, events and point clouds, in the order of their names.

    Depth images and images that are another topic's compressed ones are left out, and packets where there are
    point clouds.

    Raises:
        SourceError: it cannot be read, or holds no such topic.
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
    sensors = []
    for topic in sorted(wanted & first.keys()):
        message, n = first[topic], bag.topics[topic][1]
        try:
            sensor = _probe(message, n)
        except (SourceError, ValueError):
            continue  # No image or scan that can be used.
        last_ns = bag.end_ns(topic)
        if n > 1 and last_ns is not None and last_ns > message.log_ns:
            sensor = replace(sensor, rate_hz=(n - 1) / ((last_ns - message.log_ns) * 1e-9))
        if sensor.kind != "scans":
            beside = (info for info in sorted(infos & first.keys()) if _is_beside(info, sensor))
            info = next(beside, None)
            sensor = sensor if info is None else _with_lens(sensor, first[info])
        sensors.append(sensor)
    if not sensors:
        raise SourceError(f"{path}: no images, events or point clouds", list_topics(bag.topics))
    return sensors


def _probe(message: RawMessage, n: int) -> SensorTopic:
    """Describe a topic with n messages by its first one.

    Raises:
        SourceError, ValueError: that is damaged, or no image or scan.
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
    cloud = decode_pointcloud2(content)
    n_rings = int(content.height) if content.height > 1 else None
    for name in ("channel", "ring"):
        if name in (cloud.dtype.names or ()) and len(cloud):
            n_rings = len(np.unique(cloud[name]))
    return SensorTopic(message.topic, "scans", n, frame=frame, n_rings=n_rings, cloud=cloud)


def _is_beside(info: str, sensor: SensorTopic) -> bool:
    return "/".join([part for part in info.split("/") if part][:-1]) == sensor.namespace


def _with_lens(sensor: SensorTopic, message: RawMessage) -> SensorTopic:
    """Add the intrinsics of the camera_info topic of an image's namespace."""
    try:
        info: Any = deserialize(message)
        # ROS 1 has capital letters.
        K, D = (info.k, info.d) if hasattr(info, "k") else (info.K, info.D)
        size = int(info.width), int(info.height)
        lens = Intrinsics.from_ros(str(info.distortion_model), np.asarray(K), tuple(D), size)
        return replace(sensor, intrinsics=lens)
    except ValueError as error:
        return replace(sensor, note=f"{message.topic}: {error}")
