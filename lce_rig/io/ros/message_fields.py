"""The first fields of event messages, read from ROS 1's and ROS 2's serialisation.

rosbags' deserialiser makes one object an event and cannot parse every definition found in bags; the messages
are few and fixed, so they are read by hand.

References:
    http://wiki.ros.org/msg
    https://www.omg.org/spec/DDSI-RTPS (plain CDR, 4 bytes of encapsulation)
"""

import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

_VELODYNE_MESSAGES = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
}


@cache
def typestore(is_ros1: bool) -> Any:
    """Load rosbags' message definitions of ROS 1 or ROS 2, and those of tf and Velodyne packets."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
        if name not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", name))
    for name, text in _VELODYNE_MESSAGES.items():
        store.register(get_types_from_msg(text, name))
    return store


_SIZES = {"B": 1, "I": 4, "i": 4, "Q": 8}


class MessageReader:
    """Reads a message front to back.

    Raises:
        ValueError: big-endian CDR, which no recorder of this decade writes; from every method, a message that
            ends before it should.
    """

    def __init__(self, data: bytes, encoding: str) -> None:
        self.is_ros1 = encoding == "ros1"
        self._begin = 0 if self.is_ros1 else 4
        if not self.is_ros1 and data[1:2] != b"\x01":
            raise ValueError("it is not little-endian CDR")
        self._data = data
        self._at = self._begin

    def number(self, kind: str) -> int:
        """Read one integer: B, I, i or Q, as the struct module names them."""
        size = _SIZES[kind]
        self._align(size)
        try:
            (value,) = struct.unpack_from(f"<{kind}", self._data, self._at)
        except struct.error:
            raise ValueError(f"it ends after {len(self._data)} bytes") from None
        self._at += size
        return int(value)

    def text(self) -> str:
        """Read a string; CDR's closing zero is skipped."""
        size = self.number("I")
        return bytes(self.block(size)).rstrip(b"\0").decode("utf-8", errors="replace")

    def block(self, size: int) -> NDArray[np.uint8]:
        """Read `size` bytes, without copying."""
        if self._at + size > len(self._data):
            raise ValueError(f"it declares {size} bytes and ends after {len(self._data) - self._at}")
        block = np.frombuffer(self._data, np.uint8, size, self._at)
        self._at += size
        return block

    def rest(self) -> NDArray[np.uint8]:
        """Look at everything that is left, without copying."""
        return np.frombuffer(self._data, np.uint8, offset=self._at)

    def _align(self, size: int) -> None:
        if not self.is_ros1:
            self._at += -(self._at - self._begin) % size


@dataclass(frozen=True)
class EventHeader:
    """The common first fields of both kinds of event message.

    Attributes:
        stamp_ns: of the header.
        frame_id: of the header.
        width_px, height_px: resolution of the sensor.
    """

    stamp_ns: int
    frame_id: str
    width_px: int
    height_px: int


def read_header(reader: MessageReader) -> EventHeader:
    """Read std_msgs/Header and the resolution behind it."""
    if reader.is_ros1:
        reader.number("I")
    seconds, nanoseconds = reader.number("I"), reader.number("I")
    frame_id = reader.text()
    height_px, width_px = reader.number("I"), reader.number("I")
    return EventHeader(seconds * 10**9 + nanoseconds, frame_id, width_px, height_px)
