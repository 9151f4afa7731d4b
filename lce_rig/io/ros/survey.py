"""What a bag holds of cameras and LiDARs: what a rig's profile has to say of them."""

from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import SourceError
from lce_rig.io.ros.bag_file import BagFile, RawMessage, list_topics
from lce_rig.io.ros.event_messages import EVENT_TYPES
from lce_rig.io.ros.message_fields import MessageReader, read_header
from lce_rig.io.ros.rosbag import (
    decode_pointcloud2,
    decode_ros_compressed_image,
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
        rate_hz: by when the recorder received the first and the last; None for a single one.
        frame: of the first message's header, "" without.
        size_px: (width, height) of images and event arrays; None where they do not say.
        n_rings: number of rings of a scan; None where points have none.
        intrinsics: by the camera_info topic in the same namespace; None where there is no usable one.
        note: why there is no usable one, "" where there is one or no topic.
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

    Depth images and images that are another topic's compressed ones are left out.

    Raises:
        SourceError: it cannot be read, or holds no such topic.
    """
    bag = BagFile(path)
    kinds = {topic: _kind(msgtype) for topic, (msgtype, n) in bag.topics.items() if n > 0}
    wanted = {topic for topic, kind in kinds.items() if kind is not None}
    wanted = {topic for topic in wanted if topic.removesuffix("/compressed") not in wanted - {topic}}
    if any(bag.topics[topic][0] in CLOUD_TYPES for topic in wanted):
        wanted = {topic for topic in wanted if bag.topics[topic][0] not in PACKET_TYPES}
    infos = {topic for topic, (msgtype, n) in bag.topics.items() if msgtype == _INFO and n > 0}
    first = _first_messages(bag, wanted | infos)
    found = []
    for topic in sorted(wanted & first.keys()):
        kind = kinds[topic]
        assert kind is not None
        n = bag.topics[topic][1]
        probed = _probe(
            SensorTopic(topic, kind, n, _rate_hz(bag, topic, n, first[topic].log_ns)), first[topic]
        )
        if probed is not None:
            found.append(probed if kind == "scans" else _with_lens(probed, first, infos))
    if not found:
        raise SourceError(f"{path}: no images, events or point clouds", list_topics(bag.topics))
    return found


def _kind(msgtype: str) -> Literal["scans", "frames", "events"] | None:
    if msgtype in CLOUD_TYPES | PACKET_TYPES:
        return "scans"
    if msgtype in IMAGE_TYPES:
        return "frames"
    return "events" if msgtype in EVENT_TYPES else None


def _first_messages(bag: BagFile, topics: set[str]) -> dict[str, RawMessage]:
    first: dict[str, RawMessage] = {}
    try:
        for message in islice(bag.messages(topics), _N_PROBED):
            first.setdefault(message.topic, message)
            if len(first) == len(topics):
                break
    except SourceError:
        if not first:
            raise
    return first


def _rate_hz(bag: BagFile, topic: str, n_messages: int, first_ns: int) -> float | None:
    last_ns = bag.end_ns(topic)
    if last_ns is None or last_ns <= first_ns or n_messages < 2:
        return None
    return (n_messages - 1) / ((last_ns - first_ns) * 1e-9)


def _probe(found: SensorTopic, message: RawMessage) -> SensorTopic | None:
    """Look into a topic's first message; None where it is no image or scan that can be used."""
    try:
        if found.kind == "events":
            header = read_header(MessageReader(message.data, message.encoding))
            size = (header.width_px, header.height_px) if header.width_px > 0 else None
            return replace(found, frame=header.frame_id.lstrip("/"), size_px=size)
        content: Any = deserialize(message)
        found = replace(found, frame=str(content.header.frame_id).lstrip("/"))
        if found.kind == "frames":
            is_compressed = message.msgtype.endswith("CompressedImage")
            pixels = decode_ros_compressed_image(content) if is_compressed else decode_ros_image(content)
            return replace(found, size_px=(pixels.shape[1], pixels.shape[0]))
        if message.msgtype in PACKET_TYPES:
            return found
        cloud = decode_pointcloud2(content)
        return replace(found, n_rings=_count_rings(cloud, int(content.height)), cloud=cloud)
    except (SourceError, ValueError):
        return None


def _count_rings(cloud: NDArray[Any], height: int) -> int | None:
    for name in ("ring", "channel"):
        if name in (cloud.dtype.names or ()) and len(cloud):
            return len(np.unique(cloud[name]))
    return height if height > 1 else None


def _with_lens(found: SensorTopic, first: dict[str, RawMessage], infos: set[str]) -> SensorTopic:
    """Add what the camera_info topic of an image's namespace says."""
    topic = next((t for t in sorted(infos & first.keys()) if _namespace_of(t) == found.namespace), None)
    if topic is None:
        return found
    try:
        info: Any = deserialize(first[topic])
        # ROS 1 has capital letters.
        K, D = (info.k, info.d) if hasattr(info, "k") else (info.K, info.D)
        size = int(info.width), int(info.height)
        lens = Intrinsics.from_ros(str(info.distortion_model), np.asarray(K), tuple(D), size)
        return replace(found, intrinsics=lens)
    except ValueError as error:
        return replace(found, note=f"{topic}: {error}")


def _namespace_of(topic: str) -> str:
    return "/".join([part for part in topic.split("/") if part][:-1])
