"""Bags of Livox drivers: their own messages, point clouds with tags, and scans that are accumulated."""

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lce_rig.core.data import NO_RING, Scan
from lce_rig.io import open_recording
from lce_rig.io.cloud import to_scan
from lce_rig.io.recording import SourceOptions
from lce_rig.rig import load_rig
from tests.shared import changed

T0_NS = 1_700_000_000 * 10**9
N_POINTS = 200
POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
MESSAGE = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points"""


def write_custom(path, package, n, is_ros1):
    """Write n messages of a Livox driver at 10 Hz; every fifth point is tagged as noise."""
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(POINT, f"{package}/msg/CustomPoint"))
    store.register(get_types_from_msg(MESSAGE, f"{package}/msg/CustomMsg"))
    types = store.types
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if is_ros1:
        writer = Writer1(path.with_suffix(".bag"))
    with writer:
        connection = writer.add_connection("/livox/lidar", f"{package}/msg/CustomMsg", typestore=store)
        for k in range(n):
            stamp_ns = T0_NS + k * 100_000_000
            time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
            header = types["std_msgs/msg/Header"](
                **({"seq": k} if is_ros1 else {}), stamp=time, frame_id="livox"
            )
            points = [
                types[f"{package}/msg/CustomPoint"](
                    500_000 * i, 3.0 + k, 0.01 * i, 0.5, 40, 16 * (i % 2) + (i % 5 == 2), i % 4
                )
                for i in range(N_POINTS)
            ]
            message = types[f"{package}/msg/CustomMsg"](
                header, stamp_ns, N_POINTS, 0, np.zeros(3, np.uint8), points
            )
            pack = store.serialize_ros1 if is_ros1 else store.serialize_cdr
            writer.write(connection, stamp_ns, pack(message, f"{package}/msg/CustomMsg"))
    return path.with_suffix(".bag") if is_ros1 else path


def scans_of(path, rig):
    recording = open_recording(path, rig, SourceOptions(is_part=True))
    return [sample for sample in recording.samples() if isinstance(sample, Scan)]


def of_model(model, **changes):
    return changed(load_rig("mid360"), lidars__lidar__model=model, **changes)


@pytest.mark.parametrize(("package", "is_ros1"), [("livox_ros_driver", True), ("livox_ros_driver2", False)])
def test_livox_both_drivers_are_accumulated(tmp_path, package, is_ros1):
    path = write_custom(tmp_path / "bag", package, 25, is_ros1)
    scans = scans_of(path, of_model("Avia"))
    # At one scan per second: two complete ones, and the rest.
    assert [scan.stamp_ns for scan in scans] == [T0_NS + k * 10**9 for k in range(3)]
    assert [len(scan.points) for scan in scans] == [10 * 160, 10 * 160, 5 * 160]
    first = scans[0]
    assert set(first.ring) == {NO_RING} and set(first.intensity) == {40.0}
    np.testing.assert_allclose(np.unique(first.points[:, 0]), 3.0 + np.arange(10))
    assert first.offset_ns.min() == 0 and first.offset_ns.max() == pytest.approx(10**9, rel=1e-3)
    assert len(scans_of(path, of_model("Avia", lidars__lidar__rate_hz=10.0))) == 25


@pytest.mark.parametrize(("model", "n_kept"), [("Avia", 160), ("Mid-360", 80), ("unstructured", 160)])
def test_livox_tags_follow_the_model(model, n_kept):
    """Missing tags remove no point."""
    index = np.arange(N_POINTS)
    cloud = np.zeros(N_POINTS, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("tag", "u1"), ("timestamp", "f8")])
    cloud["x"], cloud["y"], cloud["tag"] = 3.0, 0.01 * index, 16 * (index % 2) + (index % 5 == 2)
    cloud["timestamp"] = T0_NS + index * 500_000.0
    settings = of_model(model).lidars["lidar"]
    notes = set[str]()
    scan = to_scan(cloud, "lidar", settings, "here", T0_NS, notes=notes)
    assert len(scan.points) == n_kept and any("tag" in note for note in notes)
    untagged = to_scan(cloud[["x", "y", "z"]], "lidar", settings, "here", T0_NS)
    assert len(untagged.points) == N_POINTS
