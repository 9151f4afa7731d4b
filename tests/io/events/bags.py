"""Bags with event messages for the tests."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from lce_rig.core.data import Events
from lce_rig.io.ros.bag_recorder import add_event_topic, event_messages, open_bag_writer

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


def write_event_bag(path: Path, stretches: Iterable[Events]) -> None:
    """Write events as EventArrays: a ROS 1 bag where the path ends in .bag, else a ROS 2 folder."""
    is_ros1 = path.suffix == ".bag"
    with open_bag_writer(path) as writer:
        connection = add_event_topic(writer, "/dvs/events", is_ros1)
        number = 0
        for stretch in stretches:
            for received_ns, message in event_messages(stretch, "event_camera", is_ros1, number):
                writer.write(connection, received_ns, message)
                number += 1
