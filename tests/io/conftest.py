"""Real bags of any kind, and small rooms for LiDARs to look at."""

import numpy as np
import pytest


@pytest.fixture(scope="session")
def room():
    """A sweep of 16 rings in a round room, firing order, structured with the usual fields."""
    azimuth = np.linspace(np.pi, -np.pi, 360, endpoint=False)
    elevation = np.radians(np.arange(-15, 16, 2))
    cloud = np.zeros((360, 16), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"),
                                       ("ring", "u2"), ("time", "f4")])  # fmt: skip
    radius = 4 + np.sin(3 * azimuth)[:, None]
    cloud["x"], cloud["y"] = radius * np.cos(azimuth)[:, None], radius * np.sin(azimuth)[:, None]
    cloud["z"] = radius * np.tan(elevation)
    cloud["intensity"], cloud["ring"] = 30, np.arange(16)
    cloud["time"] = np.linspace(0, 0.1, 360)[:, None]
    return cloud.ravel()


def _typestore(kind):
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)


def _build(store, msgtype, fields):
    """Build a message, its header from `stamp_ns`, its fields from plain values."""
    types = store.types
    fields = dict(fields)
    stamp_ns = fields.pop("stamp_ns")
    header_type = types["std_msgs/msg/Header"]
    names = header_type.__dataclass_fields__
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = header_type(**({"seq": 0} if "seq" in names else {}), stamp=stamp, frame_id="sensor")
    if "K" in fields and "K" not in types["sensor_msgs/msg/CameraInfo"].__dataclass_fields__:
        fields = {name.lower() if len(name) == 1 else name: value for name, value in fields.items()}
    if "roi" in fields:
        fields["roi"] = types["sensor_msgs/msg/RegionOfInterest"](**fields["roi"])
    if "fields" in fields:
        point_field = types["sensor_msgs/msg/PointField"]
        fields["fields"] = [
            point_field(name=n, offset=o, datatype=d, count=c) for n, o, d, c in fields["fields"]
        ]
    return types[f"sensor_msgs/msg/{msgtype}"](header=header, **fields)


@pytest.fixture(scope="session")
def write_bag():
    """Write a bag: kind "ros1", "sqlite3" or "mcap"; returns the file, or the folder for ROS 2."""

    def write(path, kind, messages, compression=""):
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2

        store = _typestore(kind)
        if kind == "ros1":
            writer = Writer1(path.with_suffix(".bag"))
        else:
            writer = Writer2(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
        if compression and kind == "ros1":
            writer.set_compression(writer.CompressionFormat[compression])
        elif compression:
            from rosbags.rosbag2 import CompressionFormat, CompressionMode

            writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        with writer:
            connections = {}
            for topic, msgtype, log_ns, fields in messages:
                full = f"sensor_msgs/msg/{msgtype}"
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, full, typestore=store)
                message = _build(store, msgtype, fields)
                pack = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
                writer.write(connections[topic], log_ns, pack(message, full))
        return path.with_suffix(".bag") if kind == "ros1" else path

    return write


@pytest.fixture(scope="session")
def cloud_message():
    """Lay a structured cloud out as a PointCloud2."""
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

    def build(cloud, stamp_ns):
        fields = [(name, place, codes[kind.str[1:]], 1) for name, (kind, place) in cloud.dtype.fields.items()]
        return {
            "stamp_ns": stamp_ns, "height": 1, "width": len(cloud), "is_bigendian": False, "fields": fields,
            "point_step": cloud.itemsize, "row_step": cloud.nbytes,
            "data": np.frombuffer(cloud.tobytes(), np.uint8), "is_dense": False,
        }  # fmt: skip

    return build


@pytest.fixture(scope="session")
def image_message():
    """Build an Image message from pixels."""

    def build(pixels, stamp_ns, encoding="bgr8"):
        height, width = pixels.shape[:2]
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        return {"stamp_ns": stamp_ns, "height": height, "width": width, "encoding": encoding,
                "is_bigendian": 0, "step": len(data) // height, "data": data}  # fmt: skip

    return build
