"""Bags with event messages for the tests."""

from collections.abc import Sequence
from pathlib import Path

from lce_rig.recordings.ros.bag_recorder import open_bag_writer

_PACKET = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
    "string encoding\nbool is_bigendian\nuint8[] events\n"
)


def write_packet_bag(path: Path, messages: Sequence[tuple[str, int, bytes]]) -> Path:
    """Write (topic, time of receipt, message) as EventPackets; ROS 1 where the path ends in .bag."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE)
    name = "event_camera_msgs/msg/EventPacket"
    store.register(get_types_from_msg(_PACKET, name))
    with open_bag_writer(path) as writer:
        topics = sorted({topic for topic, _, _ in messages})
        connections = {topic: writer.add_connection(topic, name, typestore=store) for topic in topics}
        for topic, received_ns, message in messages:
            writer.write(connections[topic], received_ns, message)
    return path
