"""dvs_msgs/EventArray and prophesee_event_msgs/EventArray as bytes and back.

References:
    https://github.com/uzh-rpg/rpg_dvs_ros/tree/master/dvs_msgs/msg
    https://github.com/prophesee-ai/prophesee_ros_wrapper (the same fields)
"""

import struct

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.core.data import EventColumns, Events
from lce_rig.io.ros.message_fields import EventHeader, MessageReader, read_header

_FIELDS = [("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("polarity", "?")]
_ROS1_EVENT = np.dtype(_FIELDS)
# CDR aligns each field: after the first event, whose 13 bytes begin aligned, the timestamp of event k lies at
# 16 k + 4 and the columns at 16 k - 2, so that strides of 16 bytes hold everything but the first x and y.
_CDR_EVENT = np.dtype(
    {
        "names": [name for name, _ in _FIELDS],
        "formats": [kind for _, kind in _FIELDS],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
_CDR_LEAD_BYTES = 2
_CDR_TAIL_BYTES = 1


def decode_event_array(data: bytes, encoding: str) -> tuple[EventHeader, EventColumns]:
    """Decode one message; its header's timestamp is device time, so that the host's is left open.

    Args:
        data: the message as it lies in the bag.
        encoding: "ros1" or "cdr".

    Raises:
        ValueError: it is damaged.
    """
    reader = MessageReader(data, encoding)
    header = read_header(reader)
    n_events = reader.number("I")
    limits.check_size(n_events * _ROS1_EVENT.itemsize, "a packet", limits.MAX_PACKET_BYTES)
    raw = _ros1_events(reader, n_events) if reader.is_ros1 else _cdr_events(reader, n_events)
    t_ns = raw["sec"].astype(np.int64) * 10**9 + raw["nsec"]
    x, y = raw["x"].astype(np.uint16), raw["y"].astype(np.uint16)
    return header, EventColumns(t_ns, x, y, raw["polarity"].copy())


def _ros1_events(reader: MessageReader, n_events: int) -> NDArray[np.void]:
    return reader.block(n_events * _ROS1_EVENT.itemsize).view(_ROS1_EVENT)


def _cdr_events(reader: MessageReader, n_events: int) -> NDArray[np.void]:
    if n_events == 0:
        return np.empty(0, _CDR_EVENT)
    begin = reader.rest()
    n_bytes = n_events * 16 - _CDR_LEAD_BYTES - _CDR_TAIL_BYTES
    if len(begin) < n_bytes:
        raise ValueError(f"it declares {n_events} events and ends after {len(begin)} bytes")
    padded = np.zeros(n_events * 16, np.uint8)
    padded[_CDR_LEAD_BYTES : _CDR_LEAD_BYTES + n_bytes] = begin[:n_bytes]
    padded[:4] = begin[:4]
    return padded.view(_CDR_EVENT)


def encode_event_array(events: Events, frame_id: str, encoding: str, number: int = 0) -> bytes:
    """Encode events as one dvs_msgs/EventArray, timestamped with the first event's time.

    Args:
        events: at least one.
        frame_id: of the header.
        encoding: "ros1" or "cdr".
        number: of the message in its topic; ROS 1 headers carry it.
    """
    seconds, nanoseconds = divmod(int(events.t_ns[0]), 10**9)
    name = frame_id.encode() + (b"" if encoding == "ros1" else b"\0")
    head = struct.pack("<III", seconds, nanoseconds, len(name)) + name
    sizes = struct.pack("<III", events.height_px, events.width_px, len(events))
    if encoding == "ros1":
        return struct.pack("<I", number) + head + sizes + _fill(np.empty(len(events), _ROS1_EVENT), events)
    body = _fill(np.zeros(len(events), _CDR_EVENT), events)
    lead = b"\0\1\0\0" + head + bytes(-len(head) % 4) + sizes
    return lead + body[:4] + body[4 + _CDR_LEAD_BYTES : -_CDR_TAIL_BYTES]


def _fill(raw: NDArray[np.void], events: Events) -> bytes:
    raw["x"], raw["y"], raw["polarity"] = events.x, events.y, events.polarity
    raw["sec"], raw["nsec"] = np.divmod(events.t_ns, 10**9)
    return raw.tobytes()
