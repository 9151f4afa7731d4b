"""A bag written as samples arrive, on the topics of the rig's profile."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from lce_rig.core.data import Events, Image, Sample, Scan
from lce_rig.core.errors import SourceError
from lce_rig.rig import Rig
from lce_rig.sources.bag_messages import CLOUD_TYPE, IMAGE_TYPE, encode_image, encode_scan, typestore
from lce_rig.sources.events.bag_writer import MESSAGE_TYPE, add_event_topic, event_messages, open_bag_writer
from lce_rig.timing.rig_time import event_channel


class BagRecorder:
    """A bag open for writing; a context manager.

    Samples go to the disk a megabyte at a time and are not kept. A bag that was never closed, because the
    program was killed or the disk is full, lacks its index; readers here find the messages all the same, and
    `rosbag reindex` or `ros2 bag reindex` puts the index back.

    Attributes:
        path: a ROS 1 bag where it ends in .bag, else the folder of a ROS 2 bag (mcap).
    """

    def __init__(self, path: Path, rig: Rig) -> None:
        """Begin an empty bag.

        Raises:
            SourceError: something is there already, or nothing can be written there.
        """
        self.path = path
        self._rig = rig
        self._is_ros1 = path.suffix == ".bag"
        self._numbers: Counter[str] = Counter()
        self._connections: dict[str, tuple[str, Any]] = {}
        self._failure: SourceError | None = None
        if path.exists() or path.is_symlink():
            raise SourceError(
                f"{path} exists already", "Name another file: recordings are never overwritten."
            )
        if path.suffix in (".mcap", ".db3"):
            raise SourceError(
                f"{path}: a ROS 2 bag is a folder", f"Name it {path.with_suffix('')}, or end it in .bag."
            )
        self._writer: Any = open_bag_writer(path)
        with self._disk():
            self._writer.open()

    def write(self, sample: Sample) -> None:
        """Add an image, a scan or a packet of events.

        Raises:
            SourceError: the disk is full, now or before; the rig lacks the sensor; or two sensors of the
                profile share a topic and differ in kind.
            ValueError: it has no timestamp at all.
        """
        if isinstance(sample, Events):
            self._write_events(sample)
            return
        received_ns = sample.stamp_ns if sample.host_ns is None else sample.host_ns
        if received_ns is None:
            raise ValueError(f"a sample of {sample.sensor} carries no time")
        if isinstance(sample, Image):
            topic, frame = self._camera_topic(sample.sensor, sample.channel)
            data = encode_image(sample, frame, self._is_ros1, self._numbers[topic])
            self._write(topic, IMAGE_TYPE, received_ns, data)
        else:
            topic = self._lidar_topic(sample)
            settings = self._rig.lidars[sample.sensor]
            data = encode_scan(sample, settings, self._is_ros1, self._numbers[topic])
            self._write(topic, CLOUD_TYPE, received_ns, data)

    def close(self) -> None:
        """Write the index; does nothing the second time, or after a failure.

        Raises:
            SourceError: the disk is full; what was written before can be read.
        """
        if self._writer is not None and self._failure is None:
            with self._disk():
                self._writer.close()
        self._writer = None

    def __enter__(self) -> "BagRecorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        with suppress(SourceError):
            self.close()

    def _write_events(self, events: Events) -> None:
        channel = event_channel(self._rig, events.sensor) or "events"
        topic, frame = self._camera_topic(events.sensor, channel)
        for received_ns, data in event_messages(events, frame, self._is_ros1, self._numbers[topic]):
            self._write(topic, MESSAGE_TYPE, received_ns, data)

    def _write(self, topic: str, msgtype: str, received_ns: int, data: bytes | memoryview) -> None:
        connection = self._connection(topic, msgtype)
        with self._disk():
            self._writer.write(connection, received_ns, data)
        self._numbers[topic] += 1

    def _connection(self, topic: str, msgtype: str) -> Any:
        if topic not in self._connections:
            if msgtype == MESSAGE_TYPE:
                connection = add_event_topic(self._writer, topic, self._is_ros1)
            else:
                connection = self._writer.add_connection(topic, msgtype, typestore=typestore(self._is_ros1))
            self._connections[topic] = msgtype, connection
        known, connection = self._connections[topic]
        if known != msgtype:
            raise SourceError(
                f"topic {topic} would carry both {known} and {msgtype}", "Give each a topic in the profile."
            )
        return connection

    def _camera_topic(self, camera: str, channel: str) -> tuple[str, str]:
        settings = self._rig.cameras.get(camera)
        if settings is None or channel not in settings.channels:
            raise SourceError(f"rig {self._rig.name!r} has no camera channel {camera}.{channel}")
        return settings.channels[channel].topic or f"/{camera}/{channel}", settings.optical_frame

    def _lidar_topic(self, scan: Scan) -> str:
        if scan.sensor not in self._rig.lidars:
            raise SourceError(f"rig {self._rig.name!r} has no lidar {scan.sensor!r}")
        return self._rig.lidars[scan.sensor].topic or f"/{scan.sensor}/points"

    @contextmanager
    def _disk(self) -> Iterator[None]:
        """End the bag where a full disk or an interrupt tears it: nothing is written behind that."""
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except BaseException as error:
            self._failure = not_writable(self.path, error)
            with suppress(OSError):
                # Of rosbags before 0.11 nothing closes a file without trying to write the index.
                getattr(self._writer, "abort", self._writer.close)()
            if isinstance(error, OSError):
                raise self._failure from error
            raise


def not_writable(path: Path, error: BaseException) -> SourceError:
    """Say that a recording cannot be written, and that what was written before is not lost."""
    return SourceError(
        f"{path} cannot be written: {getattr(error, 'strerror', '') or str(error) or type(error).__name__}",
        "Make room or record elsewhere; what was recorded before can be read.",
    )
