"""Images and scans as ROS messages, with the fields and conventions that other programs expect.

References:
    https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/Image.html
    https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/PointCloud2.html
    https://github.com/ros-drivers/velodyne (the layout of its point clouds)
"""

from functools import cache
from typing import Any

import numpy as np

from lce_rig.core.data import Image, Scan
from lce_rig.rig import LidarSettings

IMAGE_TYPE = "sensor_msgs/msg/Image"
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
_NS_PER_S = 10**9
_UINT16, _FLOAT32 = 4, 7
# velodyne_pointcloud's: times are seconds after the header's timestamp, which float32 holds to 4 ns.
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2")])
_TIMED_POINT = np.dtype([*_POINT.descr, ("time", "<f4")])


@cache
def typestore(is_ros1: bool) -> Any:
    """Load the message definitions of ROS 1 or ROS 2."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)


def encode_image(image: Image, frame_id: str, is_ros1: bool, number: int) -> memoryview:
    """Encode an image as sensor_msgs/Image, mono8 or bgr8.

    Args:
        image: the image; one without a timestamp gets 0, which readers take for none.
        frame_id: of the header.
        is_ros1: whether for ROS 1.
        number: of the message in its topic; ROS 1 headers carry it.
    """
    height_px, width_px = image.pixels.shape[:2]
    data = np.ascontiguousarray(image.pixels).reshape(-1)
    message = typestore(is_ros1).types[IMAGE_TYPE](
        header=_header(image.stamp_ns or 0, frame_id, is_ros1, number),
        height=height_px,
        width=width_px,
        encoding="mono8" if image.pixels.ndim == 2 else "bgr8",
        is_bigendian=0,
        step=len(data) // height_px,
        data=data,
    )
    return _serialize(message, IMAGE_TYPE, is_ros1)


def encode_scan(scan: Scan, settings: LidarSettings, is_ros1: bool, number: int) -> memoryview:
    """Encode a scan as sensor_msgs/PointCloud2 with x, y, z, intensity, ring and, where known, time.

    Args:
        scan: the scan; one without a timestamp gets 0, which readers take for none.
        settings: the LiDAR's frame, and which firing its timestamps mark.
        is_ros1: whether for ROS 1.
        number: of the message in its topic; ROS 1 headers carry it.
    """
    stamp_ns = _cloud_stamp_ns(scan, settings)
    points = np.empty(len(scan.points), _POINT if scan.offset_ns is None else _TIMED_POINT)
    for axis, name in enumerate("xyz"):
        points[name] = scan.points[:, axis]
    points["intensity"], points["ring"] = scan.intensity, scan.ring
    if scan.offset_ns is not None:
        points["time"] = 1e-9 * (scan.offset_ns + ((scan.stamp_ns or 0) - stamp_ns))
    types = typestore(is_ros1).types
    field = types["sensor_msgs/msg/PointField"]
    message = types[CLOUD_TYPE](
        header=_header(stamp_ns, settings.frame, is_ros1, number),
        height=1,
        width=len(points),
        fields=[
            field(name=name, offset=place, datatype=_UINT16 if kind == "<u2" else _FLOAT32, count=1)
            for name, (kind, place, *_) in (points.dtype.fields or {}).items()
        ],
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )
    return _serialize(message, CLOUD_TYPE, is_ros1)


def _cloud_stamp_ns(scan: Scan, settings: LidarSettings) -> int:
    """Say what the LiDAR's driver would have timestamped: the first firing, or the last one."""
    if scan.stamp_ns is None or settings.timestamps.reference == "first_firing":
        return scan.stamp_ns or 0
    if scan.offset_ns is None or not len(scan.offset_ns):
        return scan.stamp_ns + round(_NS_PER_S / settings.rate_hz)
    return scan.stamp_ns + int(scan.offset_ns.max())


def _header(stamp_ns: int, frame_id: str, is_ros1: bool, number: int) -> Any:
    types = typestore(is_ros1).types
    seconds, nanoseconds = divmod(stamp_ns, _NS_PER_S)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    sequence = {"seq": number} if is_ros1 else {}
    return types["std_msgs/msg/Header"](**sequence, stamp=stamp, frame_id=frame_id)


def _serialize(message: Any, msgtype: str, is_ros1: bool) -> memoryview:
    store = typestore(is_ros1)
    data: memoryview = (store.serialize_ros1 if is_ros1 else store.serialize_cdr)(message, msgtype)
    return data
