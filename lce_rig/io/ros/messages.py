"""ROS 1 and ROS 2 messages: definitions, and images, point clouds and event arrays as NumPy arrays.

References:
    https://docs.ros.org/en/noetic/api/sensor_msgs/html/image__encodings_8h_source.html
    https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/PointCloud2.html
    https://github.com/uzh-rpg/rpg_dvs_ros/tree/master/dvs_msgs/msg
    https://github.com/prophesee-ai/prophesee_ros_wrapper (the same fields)
    https://github.com/ros-event-camera/event_camera_msgs
    https://github.com/Livox-SDK/livox_ros_driver2/tree/master/msg (CustomMsg; the older driver's is equal)
"""

import struct
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import EventColumns, Events
from lce_rig.core.errors import reason_of
from lce_rig.io.decoding import decode_image, to_8_bit
from lce_rig.io.ros.bag_file import RawMessage

EVENT_ARRAY_TYPE = "dvs_msgs/msg/EventArray"
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms\n"
_PACKET = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
    "string encoding\nbool is_bigendian\nuint8[] events\n"
)
_LIVOX = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "{package}/CustomPoint[] points\n"
)
_LIVOX_POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
)
_LIVOX_PACKAGES = ("livox_ros_driver", "livox_ros_driver2")
LIVOX_TYPES = frozenset(f"{package}/CustomMsg" for package in _LIVOX_PACKAGES)
_DEFINITIONS = {
    **{f"{package}/msg/CustomPoint": _LIVOX_POINT for package in _LIVOX_PACKAGES},
    **{f"{package}/msg/CustomMsg": _LIVOX.format(package=package) for package in _LIVOX_PACKAGES},
    "tf2_msgs/msg/TFMessage": _TRANSFORMS,
    "tf/msg/tfMessage": _TRANSFORMS,
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
    "event_camera_msgs/msg/EventPacket": _PACKET,
    # The same type under its former name.
    "event_array_msgs/msg/EventArray": _PACKET,
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\n{time} ts\nbool polarity\n",
    EVENT_ARRAY_TYPE: "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n",
}


@cache
def typestore(is_ros1: bool) -> Any:
    """Load rosbags' message definitions of ROS 1 or ROS 2, and those of tf, events and Velodyne packets."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    time = "time" if is_ros1 else "builtin_interfaces/Time"
    for name, text in _DEFINITIONS.items():
        if name not in store.types:
            store.register(get_types_from_msg(text.format(time=time), name))
    return store


def deserialize(message: RawMessage) -> Any:
    """Deserialise by ROS's standard definitions; a bag's may be missing, or unsupported by rosbags.

    Raises:
        ValueError: it is damaged.
    """
    is_ros1 = message.encoding == "ros1"
    store = typestore(is_ros1)
    msgtype = message.msgtype.replace("/", "/msg/")
    try:
        return (store.deserialize_ros1 if is_ros1 else store.deserialize_cdr)(message.data, msgtype)
    except Exception as error:  # Damaged messages raise any of these: struct, assert, unicode, index.
        raise ValueError(f"a message is damaged: {reason_of(error)}") from None


def header_stamp_ns(content: Any) -> int:
    """Read the timestamp of a message's header, ns."""
    return int(content.header.stamp.sec * 10**9 + content.header.stamp.nanosec)


# Encoding: bytes of one channel, channels, name of OpenCV's conversion to BGR ("" for no conversion).
_ENCODINGS = {
    "mono8": (1, 1, ""),
    "8uc1": (1, 1, ""),
    "mono16": (2, 1, ""),
    "16uc1": (2, 1, ""),
    "bgr8": (1, 3, ""),
    "8uc3": (1, 3, ""),
    "bgr16": (2, 3, ""),
    "rgb8": (1, 3, "COLOR_RGB2BGR"),
    "rgb16": (2, 3, "COLOR_RGB2BGR"),
    "bgra8": (1, 4, "COLOR_BGRA2BGR"),
    "8uc4": (1, 4, "COLOR_BGRA2BGR"),
    "rgba8": (1, 4, "COLOR_RGBA2BGR"),
    "yuv422": (1, 2, "COLOR_YUV2BGR_UYVY"),
    "uyvy": (1, 2, "COLOR_YUV2BGR_UYVY"),
    "yuv422_yuy2": (1, 2, "COLOR_YUV2BGR_YUY2"),
    "yuyv": (1, 2, "COLOR_YUV2BGR_YUY2"),
    **{f"bayer_{m}8": (1, 1, f"COLOR_Bayer{m.upper()}2BGR") for m in ("rggb", "bggr", "gbrg", "grbg")},
    **{f"bayer_{m}16": (2, 1, f"COLOR_Bayer{m.upper()}2BGR") for m in ("rggb", "bggr", "gbrg", "grbg")},
}
# A plane of luminance, then one of half its rows with colour.
_SEMI_PLANAR = {"nv12": "COLOR_YUV2BGR_NV12", "nv21": "COLOR_YUV2BGR_NV21"}


def decode_ros_image(message: Any) -> NDArray[np.uint8]:
    """Decode sensor_msgs/Image or CompressedImage.

    Returns:
        (H, W) grey or (H, W, 3) BGR.

    Raises:
        ValueError: the message is damaged, a depth image, of an unknown encoding, or its sizes are
            contradictory.
    """
    if hasattr(message, "format"):
        encoding = str(message.format).lower()
        if "compresseddepth" in encoding:
            raise ValueError("it is a depth image")
        pixels = decode_image(bytes(message.data))
        # A camera's raw mosaic may have been compressed as if it were grey.
        encoding = encoding.split(";")[0].strip()
        if pixels.ndim == 3 or not encoding.startswith("bayer_") or encoding not in _ENCODINGS:
            return pixels
        conversion = _ENCODINGS[encoding][2]
    else:
        encoding = str(message.encoding).lower()
        if encoding in _SEMI_PLANAR:
            return _decode_semi_planar(message, _SEMI_PLANAR[encoding])
        if encoding not in _ENCODINGS:
            raise ValueError(
                f"its encoding {encoding!r} is not known: record mono8, bgr8, nv12 or compressed"
            )
        n_bytes, n_channels, conversion = _ENCODINGS[encoding]
        width, height = int(message.width), int(message.height)
        n_row = width * n_channels * n_bytes
        step = int(message.step) or n_row
        data = np.ascontiguousarray(message.data, dtype=np.uint8)
        if width * height == 0 or step < n_row or len(data) < (height - 1) * step + n_row:
            size = f"{width}x{height} image in {encoding} with rows of {step} bytes"
            raise ValueError(f"{len(data)} bytes are not a {size}")
        kind = np.dtype(f"{'>' if message.is_bigendian else '<'}u{n_bytes}")
        strides = step, n_channels * n_bytes, n_bytes
        rows: NDArray[Any] = np.ndarray((height, width, n_channels), kind, data.data, 0, strides)
        pixels = to_8_bit((rows[:, :, 0] if n_channels == 1 else rows).astype(kind.newbyteorder("=")))
    if not conversion:
        return pixels
    import cv2

    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, conversion)), dtype=np.uint8)


def _decode_semi_planar(message: Any, conversion: str) -> NDArray[np.uint8]:
    """Decode NV12 or NV21 to (H, W, 3) BGR.

    Raises:
        ValueError: the sizes contradict each other.
    """
    import cv2

    width, height = int(message.width), int(message.height)
    step = int(message.step) or width
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    # Some drivers count the rows of both planes.
    if len(data) == step * height and height % 3 == 0:
        height = height * 2 // 3
    n_rows = height * 3 // 2
    if width * height == 0 or width % 2 or height % 2 or step < width or len(data) < n_rows * step:
        raise ValueError(f"{len(data)} bytes are not a {width}x{height} image with rows of {step} bytes")
    planes = np.ascontiguousarray(data[: n_rows * step].reshape(n_rows, step)[:, :width])
    return np.asarray(cv2.cvtColor(planes, getattr(cv2, conversion)), dtype=np.uint8)


_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def decode_pointcloud2(message: Any) -> NDArray[Any]:
    """View a message's points by field name, row by row.

    Field offsets, gaps between fields, gaps after rows and byte order are taken from the message.

    Args:
        message: sensor_msgs/PointCloud2 of ROS 1 or 2.

    Returns:
        Structured (height * width,); fields with a count of c > 1 have shape (c,).

    Raises:
        ValueError: the message contradicts itself; the text names the fields or sizes.
    """
    order = ">" if message.is_bigendian else "<"
    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    for entry in message.fields:
        if entry.datatype not in _KINDS:
            raise ValueError(f"field {entry.name!r} has the unknown datatype {entry.datatype}")
        kind, count = np.dtype(order + _KINDS[entry.datatype]), max(int(entry.count), 1)
        if entry.offset + kind.itemsize * count > message.point_step:
            raise ValueError(f"field {entry.name!r} does not fit into point_step {message.point_step}")
        if entry.name and entry.name not in names:
            names.append(entry.name)
            formats.append(kind if count == 1 else (kind, (count,)))
            offsets.append(int(entry.offset))
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    if step < 1:
        raise ValueError("its points have no bytes")
    # Some drivers leave row_step at zero in point clouds of one row.
    row_step = int(message.row_step) or width * step
    if row_step < width * step:
        raise ValueError(f"row_step {row_step} is less than {width} points of {step} bytes")
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    if width * height == 0:
        return np.empty(0, dtype=dtype)
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    n_needed = (height - 1) * row_step + width * step
    if len(data) < n_needed:
        raise ValueError(f"it holds {len(data)} of {n_needed} bytes of points")
    rows: NDArray[Any] = np.ndarray((height, width), dtype, data.data, 0, (row_step, step))
    return rows.reshape(-1)


_LIVOX_DTYPE = np.dtype(
    [("offset_time", "i8"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectivity", "u1"), ("tag", "u1")]
)


def decode_livox(message: Any) -> NDArray[Any]:
    """View the points of a CustomMsg of either Livox driver as a structured array (N,)."""
    points = [(p.offset_time, p.x, p.y, p.z, p.reflectivity, p.tag) for p in message.points]
    return np.array(points, dtype=_LIVOX_DTYPE)


class EventHead(NamedTuple):
    """The first fields of both kinds of event message.

    Attributes:
        stamp_ns: timestamp of the header.
        frame_id: frame of the header.
        width_px, height_px: resolution of the sensor.
    """

    stamp_ns: int
    frame_id: str
    width_px: int
    height_px: int


_EVENT_FIELDS = [("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("polarity", "?")]
_ROS1_EVENT = np.dtype(_EVENT_FIELDS)
# CDR aligns each field: after the first event, whose 13 bytes begin aligned, the timestamp of event k lies at
# 16 k + 4 and the columns at 16 k - 2, so that strides of 16 bytes hold everything but the first x and y.
_CDR_EVENT = np.dtype(
    {
        "names": [name for name, _ in _EVENT_FIELDS],
        "formats": [kind for _, kind in _EVENT_FIELDS],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
_CDR_LEAD_BYTES, _CDR_TAIL_BYTES = 2, 1
# ROS 1 begins with the header's number, CDR with its encapsulation; both take 4 bytes.
_TIME_AT, _NAME_AT = 4, 12


def decode_event_array(data: bytes, encoding: str) -> tuple[EventHead, EventColumns]:
    """Decode one dvs_msgs/EventArray without rosbags, which would create an object per event.

    Its header's timestamp is device time; the host's is unknown.

    Args:
        data: the serialised message.
        encoding: "ros1" or "cdr".

    Raises:
        ValueError: the message is damaged, or big-endian CDR.
    """
    if encoding != "ros1" and data[1:2] != b"\x01":
        raise ValueError("it is not little-endian CDR")
    try:
        seconds, nanoseconds, n_name = struct.unpack_from("<III", data, _TIME_AT)
        at = _NAME_AT + 4 + n_name
        frame_id = data[_NAME_AT + 4 : at].rstrip(b"\0").decode(errors="replace")
        at += 0 if encoding == "ros1" else -at % 4
        height_px, width_px, n_events = struct.unpack_from("<III", data, at)
    except struct.error:
        raise ValueError(f"it ends after {len(data)} bytes") from None
    content = np.frombuffer(data, np.uint8, offset=at + 12)
    n_bytes = n_events * 16 - _CDR_LEAD_BYTES - _CDR_TAIL_BYTES if n_events else 0
    if encoding == "ros1":
        n_bytes = n_events * _ROS1_EVENT.itemsize
    if len(content) < n_bytes:
        raise ValueError(f"it declares {n_events} events and ends after {len(content)} bytes")
    if encoding == "ros1":
        raw = content[:n_bytes].view(_ROS1_EVENT)
    else:
        padded = np.zeros(n_events * 16, np.uint8)
        padded[_CDR_LEAD_BYTES : _CDR_LEAD_BYTES + n_bytes] = content[:n_bytes]
        padded[:4] = content[: len(padded[:4])]
        raw = padded.view(_CDR_EVENT)
    t_ns = raw["sec"].astype(np.int64) * 10**9 + raw["nsec"]
    x, y = raw["x"].astype(np.uint16), raw["y"].astype(np.uint16)
    head = EventHead(seconds * 10**9 + nanoseconds, frame_id, width_px, height_px)
    return head, EventColumns(t_ns, x, y, raw["polarity"].copy())


def encode_event_array(events: Events, frame_id: str, encoding: str) -> bytes:
    """Encode events as one dvs_msgs/EventArray, timestamped with the first event's time.

    Args:
        events: at least one.
        frame_id: frame of the header.
        encoding: "ros1" or "cdr".
    """
    raw = np.zeros(len(events), _ROS1_EVENT if encoding == "ros1" else _CDR_EVENT)
    raw["x"], raw["y"], raw["polarity"] = events.x, events.y, events.polarity
    raw["sec"], raw["nsec"] = np.divmod(events.t_ns, 10**9)
    body = raw.tobytes()
    name = frame_id.encode() + (b"" if encoding == "ros1" else b"\0")
    head = struct.pack("<III", *divmod(int(events.t_ns[0]), 10**9), len(name)) + name
    sizes = struct.pack("<III", events.height_px, events.width_px, len(events))
    if encoding == "ros1":
        return bytes(4) + head + sizes + body
    lead = b"\0\1\0\0" + head + bytes(-len(head) % 4) + sizes
    return lead + body[:4] + body[4 + _CDR_LEAD_BYTES : -_CDR_TAIL_BYTES]
