"""Bags with event messages for the tests."""

from lce_rig.io.ros.bag_file import RawMessage
from lce_rig.io.ros.bag_recorder import open_bag_writer
from lce_rig.io.ros.event_messages import parse_packet
from lce_rig.io.ros.messages import EVENT_ARRAY_TYPE, encode_event_array, typestore


def parsed(data, is_ros1):
    """Parse an EventPacket's bytes."""
    encoding = "ros1" if is_ros1 else "cdr"
    return parse_packet(RawMessage("/events", "event_camera_msgs/EventPacket", encoding, 0, data))


def write_packet_bag(path, messages):
    """Write (topic, time of receipt, message) as EventPackets; ROS 1 where the path ends in .bag."""
    store, name = typestore(path.suffix == ".bag"), "event_camera_msgs/msg/EventPacket"
    with open_bag_writer(path) as writer:
        topics = sorted({topic for topic, _, _ in messages})
        connections = {topic: writer.add_connection(topic, name, typestore=store) for topic in topics}
        for topic, received_ns, message in messages:
            writer.write(connections[topic], received_ns, message)
    return path


def write_event_bag(path, stretches):
    """Write events as EventArrays: a ROS 1 bag where the path ends in .bag, else a ROS 2 folder."""
    is_ros1 = path.suffix == ".bag"
    with open_bag_writer(path) as writer:
        store = typestore(is_ros1)
        connection = writer.add_connection("/dvs/events", EVENT_ARRAY_TYPE, typestore=store)
        for stretch in stretches:
            for begin in range(0, len(stretch), 1000):
                part = stretch.select(slice(begin, begin + 1000))
                message = encode_event_array(part, "event_camera", "ros1" if is_ros1 else "cdr")
                writer.write(connection, int(part.t_ns[-1]), message)
