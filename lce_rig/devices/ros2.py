"""A sensor that another driver publishes as a ROS 2 topic; its timestamps are those of the headers."""

import re
import time
from contextlib import ExitStack
from importlib import import_module
from typing import Any

from lce_rig.core.data import LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.devices import findings
from lce_rig.devices.reading import READ_WAIT_S, LiveSource, SourceStatus
from lce_rig.io.ros.bag_file import RawMessage
from lce_rig.io.ros.rosbag import TopicDecoder
from lce_rig.io.ros.topics import Target
from lce_rig.rig import CameraSettings, LidarSettings

# Longest silence, and time for discovery, s: nodes find each other within a second on one computer, within a
# few on a network.
_SILENCE_S = _DISCOVERY_S = 5.0


class Ros2Source(LiveSource):
    """A topic of sensor_msgs/Image, CompressedImage or PointCloud2; see `LiveSource`.

    Messages arrive serialised and are decoded like those of a bag. The topic is the profile's topic for bags.
    Timestamps are those of the headers; their quality depends on the publishing driver.

    Args:
        sensor: the sensor's name in the profile.
        settings: its block of the profile.
    """

    def __init__(self, sensor: str, settings: CameraSettings | LidarSettings) -> None:
        if isinstance(settings, CameraSettings):
            channel = settings.first_channel("frames") or next(iter(settings.channels))
            named, label = settings.channels[channel].topic, f"camera {sensor!r}"
            self._target = Target(sensor, channel)
        else:
            named, label = settings.topic, f"LiDAR {sensor!r}"
            self._target = Target(sensor, None)
        self._topic = f"/{named.lstrip('/')}" if named else ""
        hint = f"Check that its driver publishes: `ros2 topic hz {self._topic}`."
        super().__init__(sensor, label, _SILENCE_S, hint)
        self._settings = settings
        self._stack = ExitStack()
        self._waiting: list[tuple[int, bytes]] = []
        self._decoder = TopicDecoder(self._target, settings)
        self._msgtype = ""
        self._delay_ms: float | None = None

    def open(self) -> None:
        """Join the ROS graph and subscribe.

        Raises:
            SourceError: rclpy cannot be imported, the profile names no topic, or no node publishes it.
        """
        if not self._topic:
            block = "cameras" if self._target.channel is not None else "lidars"
            hint = f"Set topic in {block}.{self.sensor}; `ros2 topic list -t` lists what is published."
            raise SourceError(f"{self._label}: the profile names no topic", hint)
        try:
            import rclpy
        except ImportError:
            what = f"{self._label}: driver.type ros2 needs rclpy, which cannot be imported"
            hint = (
                "Source ROS 2 first (source /opt/ros/humble/setup.bash) and use its Python; pip has no rclpy."
            )
            raise SourceError(what, hint) from None
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import qos_profile_sensor_data

        context = rclpy.Context()
        # With a context of its own, rclpy leaves Ctrl-C to this program.
        rclpy.init(context=context)
        self._stack.callback(rclpy.try_shutdown, context=context)
        # ROS 2 allows letters, digits and underscores of ASCII.
        name = "lce_rig_" + re.sub(r"[^A-Za-z0-9_]", "_", self.sensor)
        node = rclpy.create_node(name, context=context)
        self._stack.callback(node.destroy_node)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)
        self._stack.callback(self._executor.shutdown)
        self._msgtype = self._find_type(node)
        package, _, name = self._msgtype.partition("/")
        kind = getattr(import_module(f"{package}.msg"), name)

        def receive(data: bytes) -> None:
            self._waiting.append((time.time_ns(), bytes(data)))

        node.create_subscription(kind, self._topic, receive, qos_profile_sensor_data, raw=True)
        self._waiting.clear()

    def close(self) -> None:
        """Leave the ROS graph."""
        self._stack.close()

    def read(self) -> list[LiveSample]:
        """Return the received samples; see `LiveSource`."""
        self._executor.spin_once(timeout_sec=READ_WAIT_S)
        came, self._waiting = self._waiting, []
        samples: list[LiveSample] = []
        for host_ns, data in came:
            message = RawMessage(self._topic, self._msgtype, "cdr", host_ns, data)
            for sample in self._decoder.decode(message):
                if sample.stamp_ns is not None:
                    self._delay_ms = (host_ns - sample.stamp_ns) * 1e-6
                    samples.append(sample)
        return samples

    def describe(self) -> SourceStatus:
        """Report the state of the topic."""
        n_lost = sum(int(str(loss.figures["n"])) for loss in self._decoder.losses.findings())
        clock = None
        if self._delay_ms is not None:
            clock = findings.HEADER(delay_ms=self._delay_ms)
        problems = (findings.MESSAGES_SKIPPED(n=n_lost),) if n_lost else ()
        device = f"{self._topic} ({self._msgtype})" if self._msgtype else self._topic
        return SourceStatus(self.sensor, n_lost=n_lost, clock=clock, problems=problems, device=device)

    def _find_type(self, node: Any) -> str:
        """Wait until the topic is published, and return its type without ROS 2's "/msg".

        Raises:
            SourceError: the topic is not published, or is of another type.
        """
        until_s = time.monotonic() + _DISCOVERY_S
        while True:
            types: dict[str, list[str]] = {
                name: [each.replace("/msg/", "/") for each in kinds]
                for name, kinds in node.get_topic_names_and_types()
            }
            if self._topic in types or time.monotonic() > until_s or self.is_stopping:
                break
            time.sleep(READ_WAIT_S)
        fitting = [each for each in types.get(self._topic, ()) if each in self._target.types]
        if fitting:
            return fitting[0]
        others = sorted(name for name, kinds in types.items() if self._target.types & set(kinds))
        listing = (
            f"Topics of its type: {', '.join(others)}." if others else "No topic of its type is published."
        )
        hint = f"{listing} Check ROS_DOMAIN_ID, and `ros2 topic list -t`."
        if self._topic in types:
            wanted = " or ".join(sorted(self._target.types))
            raise SourceError(
                f"{self._label}: {self._topic} is {', '.join(types[self._topic])}, not {wanted}", hint
            )
        raise SourceError(f"{self._label}: nothing publishes {self._topic}", hint)
