"""sensor_msgs/PointCloud2 of any layout as a structured array.

References:
    https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/PointCloud2.html
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.sources.events.message import MessageReader, read_header

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def check_field_count(data: bytes, encoding: str) -> None:
    """Make sure that a message does not declare more fields than points have, before it is deserialised.

    Args:
        data: sensor_msgs/PointCloud2 as it lies in the bag.
        encoding: "ros1" or "cdr".

    Raises:
        ValueError: it does, or it is damaged.
    """
    reader = MessageReader(data, encoding)
    read_header(reader)  # Height and width stand behind the header as they do in messages of events.
    n_fields = reader.number("I")
    if n_fields > limits.MAX_FIELDS:
        raise ValueError(f"it declares {n_fields} fields a point, at most {limits.MAX_FIELDS} are read")


def decode_pointcloud2(message: Any) -> NDArray[Any]:
    """View a message's points by their names, row by row.

    Field offsets, gaps between fields, gaps behind rows and byte order are as the message says.

    Args:
        message: sensor_msgs/PointCloud2 of ROS 1 or 2.

    Returns:
        Structured (height * width,); fields with a count of c > 1 have shape (c,).

    Raises:
        ValueError: what in the message contradicts itself.
    """
    order = ">" if message.is_bigendian else "<"
    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    for field in message.fields:
        if field.datatype not in _KINDS:
            raise ValueError(f"field {field.name!r} has the unknown datatype {field.datatype}")
        kind, count = np.dtype(order + _KINDS[field.datatype]), max(int(field.count), 1)
        if field.offset + kind.itemsize * count > message.point_step:
            raise ValueError(f"field {field.name!r} does not fit into point_step {message.point_step}")
        if field.name and field.name not in names:
            names.append(field.name)
            formats.append(kind if count == 1 else (kind, (count,)))
            offsets.append(int(field.offset))
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    if width * height > limits.MAX_POINTS:
        raise ValueError(f"it declares {width * height} points, at most {limits.MAX_POINTS} are read")
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
        raise ValueError(f"{len(data)} of {n_needed} bytes of its points are there")
    rows: NDArray[Any] = np.ndarray((height, width), dtype, data.data, 0, (row_step, step))
    return rows.reshape(-1)
