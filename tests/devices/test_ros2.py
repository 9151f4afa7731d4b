"""Sensors read from ROS 2 topics: messages serialised by rosbags, over a stand-in of ROS 2's graph.

No ROS 2 can be installed by pip, so `ros2_graph/` stands in for rclpy; what it hands over are the bytes that
ROS 2's middleware would.
"""

import json
import socket
import struct
import sys
import threading
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SourceError
from lce_rig.devices import open_live
from lce_rig.devices.reading import AttachedSensors
from lce_rig.devices.ros2 import Ros2Source
from lce_rig.io.ros.bag_recorder import encode_image, encode_scan
from lce_rig.rig import load_rig
from tests.devices.attached import attached
from tests.shared import changed

IMAGES, POINTS = "/camera/image_raw", "/points"
TOPICS = {
    IMAGES: ["sensor_msgs/msg/Image"],
    POINTS: ["sensor_msgs/msg/PointCloud2"],
    "/tf": ["tf2_msgs/msg/TFMessage"],
}


@pytest.fixture
def rig():
    """The rig rlfs with both sensors on ROS 2 topics."""
    return changed(
        load_rig("rlfs"),
        lidars__lidar__driver__type="ros2",
        lidars__lidar__topic=POINTS[1:],
        cameras__cam__driver__type="ros2",
        cameras__cam__channels__frames__topic=IMAGES,
        sync=None,
    )


def samples(rig, n):
    """Messages of both topics whose headers rise; every fifth image is torn."""
    height, width = 48, 64
    begin_ns = time.time_ns()
    angle = np.linspace(-np.pi, np.pi, 1600, endpoint=False)
    for k in range(n):
        stamp_ns = begin_ns + k * 20_000_000
        pixels = np.full((height, width), k, np.uint8)
        data = bytes(encode_image(Image("cam", "frames", stamp_ns, pixels), "camera", False))
        yield IMAGES, data[: len(data) // 2] if k % 5 == 4 else data
        ring = np.arange(1600) % 16
        points = np.column_stack((5 * np.cos(angle), 5 * np.sin(angle), 0.1 * (ring - 8))).astype(np.float32)
        scan = Scan("lidar", stamp_ns, points, np.full(1600, 9, np.float32), ring.astype(np.uint16))
        yield POINTS, bytes(encode_scan(scan, rig.lidars["lidar"], False))


@pytest.fixture
def graph(rig, monkeypatch):
    """A graph in which both topics are published to whoever subscribes, at 50 messages a second."""
    monkeypatch.syspath_prepend(str(Path(__file__).with_name("ros2_graph")))
    listener = socket.create_server(("127.0.0.1", 0))
    monkeypatch.setenv("ROS_GRAPH_PORT", str(listener.getsockname()[1]))

    def serve(member):
        with suppress(OSError), member:
            member.sendall(json.dumps(TOPICS).encode() + b"\n")
            if member.recv(3) != b"go\n":
                return
            for topic, data in samples(rig, 200):
                member.sendall(struct.pack("<II", len(topic), len(data)) + topic.encode() + data)
                time.sleep(0.01)

    def accept():
        with suppress(OSError):
            while True:
                threading.Thread(target=serve, args=(listener.accept()[0],), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    yield
    listener.close()
    for name in [name for name in sys.modules if name.partition(".")[0] in ("rclpy", "sensor_msgs")]:
        del sys.modules[name]


@pytest.mark.realtime
@pytest.mark.usefixtures("graph")
def test_ros2_topics_equal_bag(rig):
    came = {"cam": [], "lidar": []}
    with AttachedSensors(open_live(rig)) as sensors:
        until_s = time.monotonic() + 60
        while min(map(len, came.values())) < 10 and time.monotonic() < until_s:
            taken = sensors.take(0.5)
            if taken is not None:
                came[taken[0]].append(taken[1])
        statuses = sensors.statuses()
    images, scans = came["cam"], came["lidar"]
    assert all(isinstance(each, Image) for each in images) and all(isinstance(each, Scan) for each in scans)
    # The value of an image's pixels is its number: every fifth, torn, is left out.
    numbers = [int(each.pixels[0, 0]) for each in images]
    assert numbers == [k for k in range(numbers[-1] + 1) if k % 5 != 4]
    assert (np.diff([each.stamp_ns for each in images]) % 20_000_000 == 0).all()
    assert all(len(each.points) == 1600 and set(each.ring) == set(range(16)) for each in scans)
    camera = statuses["cam"]
    assert camera.clock is not None and camera.clock.code == "clock.header"
    assert [each.code for each in camera.problems] == ["stream.messages_skipped"]
    assert camera.n_lost == camera.problems[0].figures["n"] >= 1
    assert statuses["lidar"].n_lost == 0 and POINTS in statuses["lidar"].device


def refusal(source):
    with pytest.raises(SourceError) as caught, attached(source):
        pass
    return caught.value


def with_topic(rig, topic):
    return Ros2Source("lidar", rig.lidars["lidar"].model_copy(update={"topic": topic}))


@pytest.mark.realtime
@pytest.mark.usefixtures("graph")
def test_ros2_unusable_topic_lists_others(rig, monkeypatch):
    monkeypatch.setattr("lce_rig.devices.ros2._DISCOVERY_S", 0.2)
    absent, wrong, unnamed = (refusal(with_topic(rig, topic)) for topic in ("/velodyne", IMAGES, None))
    assert "/velodyne" in absent.what and POINTS in absent.hint
    assert IMAGES in wrong.what and "PointCloud2" in wrong.what and POINTS in wrong.hint
    assert "lidars.lidar" in unnamed.hint


def test_ros2_missing_installation_has_hint(rig):
    if find_spec("rclpy") is not None:
        pytest.skip("ROS 2 is there")
    error = refusal(Ros2Source("cam", rig.cameras["cam"]))
    assert "'cam'" in error.what and "setup.bash" in error.hint
