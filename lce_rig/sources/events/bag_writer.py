"""Writing events into ROS bags as dvs_msgs/EventArray.

References:
    https://github.com/uzh-rpg/rpg_dvs_ros/tree/master/dvs_msgs/msg
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.data import Events
from lce_rig.sources.events.event_array import encode_event_array

MESSAGE_TYPE = "dvs_msgs/msg/EventArray"
# The drivers' own rate.
_MESSAGE_NS = 33_000_000
_HEADER = "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"
_EVENT = {
    True: "uint16 x\nuint16 y\ntime ts\nbool polarity\n",
    False: "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity\n",
}


def write_event_bag(
    path: Path, stretches: Iterable[Events], topic: str = "/dvs/events", frame_id: str = "event_camera"
) -> None:
    """Write a recording of events: as a ROS 1 bag where the path ends in .bag, else as a ROS 2 folder (mcap).

    Raises:
        FileExistsError: something is there already.
    """
    if path.exists():
        raise FileExistsError(f"{path} exists already")
    is_ros1 = path.suffix == ".bag"
    with open_bag_writer(path) as writer:
        connection = add_event_topic(writer, topic, is_ros1)
        number = 0
        for stretch in stretches:
            for received_ns, message in event_messages(stretch, frame_id, is_ros1, number):
                writer.write(connection, received_ns, message)
                number += 1


def open_bag_writer(path: Path) -> Any:
    """Begin a bag: ROS 1 where the path ends in .bag, else ROS 2's mcap; a context manager of rosbags'."""
    if path.suffix == ".bag":
        from rosbags.rosbag1 import Writer as Ros1Writer

        return Ros1Writer(path)
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Ros2Writer

    return Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)


def add_event_topic(writer: Any, topic: str, is_ros1: bool) -> Any:
    """Announce a topic of events in a bag that may hold others as well."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_EVENT[is_ros1], "dvs_msgs/msg/Event"))
    store.register(get_types_from_msg(_HEADER, MESSAGE_TYPE))
    return writer.add_connection(topic, MESSAGE_TYPE, typestore=store)


def event_messages(
    events: Events, frame_id: str, is_ros1: bool, first_number: int = 0
) -> Iterator[tuple[int, bytes]]:
    """Cut events into messages of 33 ms.

    Yields:
        Time of receipt in ns, that of the last event where the host's clock is not known, and the message.
    """
    if not len(events):
        return
    first_ns, last_ns = int(events.t_ns[0]), int(events.t_ns[-1])
    edges_ns = np.arange(first_ns, last_ns + _MESSAGE_NS + 1, _MESSAGE_NS)
    encoding = "ros1" if is_ros1 else "cdr"
    number = first_number
    for start_ns in edges_ns[:-1]:
        part = events.between(int(start_ns), int(start_ns) + _MESSAGE_NS)
        if len(part):
            received_ns = int(part.t_ns[-1])
            if events.host_ns is not None:
                received_ns = events.host_ns + int(part.t_ns[0]) - first_ns
            yield received_ns, encode_event_array(part, frame_id, encoding, number)
            number += 1
