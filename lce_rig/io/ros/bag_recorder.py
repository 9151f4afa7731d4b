"""A bag written as samples arrive, on the topics of the rig's profile.

Messages have the fields and conventions that other programs expect.

References:
    https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/Image.html
    https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/PointCloud2.html
    https://github.com/ros-drivers/velodyne (the layout of its point clouds)
    https://github.com/uzh-rpg/rpg_dvs_ros/tree/master/dvs_msgs/msg
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.data import Events, Image, Sample, Scan
from lce_rig.core.errors import SourceError
from lce_rig.io.ros.messages import EVENT_ARRAY_TYPE, encode_event_array, typestore
from lce_rig.rig import LidarSettings, Rig
from lce_rig.timing.clock import NS_PER_S
from lce_rig.timing.scan_pairing import event_channel

IMAGE_TYPE = "sensor_msgs/msg/Image"
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
_UINT16, _FLOAT32 = 4, 7
_BAG_NAMES = {1: "recording.bag", 2: "recording"}
# velodyne_pointcloud's: times are seconds after the header's timestamp, which float32 holds to 4 ns.
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2")])
_TIMED_POINT = np.dtype([*_POINT.descr, ("time", "<f4")])


def open_bag_writer(path: Path) -> Any:
    """Open a bag for writing: ROS 1 for a path ending in .bag, else ROS 2's mcap; a context manager."""
    if path.suffix == ".bag":
        from rosbags.rosbag1 import Writer as Ros1Writer

        return Ros1Writer(path)
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Ros2Writer

    return Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)


def encode_image(image: Image, frame_id: str, is_ros1: bool) -> memoryview:
    """Encode an image as sensor_msgs/Image, mono8 or bgr8.

    Args:
        image: the image; one without a timestamp gets 0, which readers treat as none.
        frame_id: frame of the header.
        is_ros1: whether for ROS 1.
    """
    height_px, width_px = image.pixels.shape[:2]
    data = np.ascontiguousarray(image.pixels).reshape(-1)
    message = typestore(is_ros1).types[IMAGE_TYPE](
        header=_header(image.stamp_ns or 0, frame_id, is_ros1),
        height=height_px,
        width=width_px,
        encoding="mono8" if image.pixels.ndim == 2 else "bgr8",
        is_bigendian=0,
        step=len(data) // height_px,
        data=data,
    )
    return _serialize(message, IMAGE_TYPE, is_ros1)


def encode_scan(scan: Scan, settings: LidarSettings, is_ros1: bool) -> memoryview:
    """Encode a scan as sensor_msgs/PointCloud2 with x, y, z, intensity, ring and, if known, time.

    Args:
        scan: the scan; one without a timestamp gets 0, which readers treat as none.
        settings: the LiDAR's frame, and which firing its timestamps mark.
        is_ros1: whether for ROS 1.
    """
    # The LiDAR's driver would have timestamped the first or the last firing.
    stamp_ns = scan.stamp_ns or 0
    if scan.stamp_ns is not None and settings.timestamps.reference != "first_firing":
        if scan.offset_ns is not None and len(scan.offset_ns):
            stamp_ns += int(scan.offset_ns.max())
        else:
            stamp_ns += round(NS_PER_S / settings.rate_hz)
    points = np.empty(len(scan.points), _POINT if scan.offset_ns is None else _TIMED_POINT)
    for axis, name in enumerate("xyz"):
        points[name] = scan.points[:, axis]
    points["intensity"], points["ring"] = scan.intensity, scan.ring
    if scan.offset_ns is not None:
        points["time"] = 1e-9 * (scan.offset_ns + ((scan.stamp_ns or 0) - stamp_ns))
    types = typestore(is_ros1).types
    field = types["sensor_msgs/msg/PointField"]
    message = types[CLOUD_TYPE](
        header=_header(stamp_ns, settings.frame, is_ros1),
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


def _header(stamp_ns: int, frame_id: str, is_ros1: bool) -> Any:
    types = typestore(is_ros1).types
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    sequence = {"seq": 0} if is_ros1 else {}
    return types["std_msgs/msg/Header"](**sequence, stamp=stamp, frame_id=frame_id)


def _serialize(message: Any, msgtype: str, is_ros1: bool) -> memoryview:
    store = typestore(is_ros1)
    data: memoryview = (store.serialize_ros1 if is_ros1 else store.serialize_cdr)(message, msgtype)
    return data


class BagRecorder(AbstractContextManager["BagRecorder"]):
    """A bag open for writing; a context manager.

    Samples are written a megabyte at a time and are not kept in memory. A bag that was never closed, because
    the program was killed or the disk is full, lacks its index: `rosbag reindex` or `mcap recover` restores
    it.

    Attributes:
        path: a ROS 1 bag if it ends in .bag, else the folder of a ROS 2 bag (mcap).
    """

    def __init__(self, path: Path, rig: Rig) -> None:
        """Create an empty bag.

        Raises:
            SourceError: the path exists already, or cannot be written.
        """
        self.path = path
        self._rig = rig
        self._is_ros1 = path.suffix == ".bag"
        self._connections: dict[str, tuple[str, Any]] = {}
        self._failure: SourceError | None = None
        self._writer: Any = open_bag_writer(path)
        with self._disk():
            self._writer.open()

    @classmethod
    def in_folder(cls, folder: Path, rig: Rig, ros: int = 1) -> "BagRecorder":
        """Create recording.bag, or for ROS 2 recording/, in a new folder.

        Raises:
            SourceError: the folder exists already, or cannot be created.
        """
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            hint = "Name another folder: recordings are never overwritten."
            raise SourceError(f"{folder} exists already", hint) from None
        except OSError as error:
            raise _not_writable(folder, error) from error
        return cls(folder / _BAG_NAMES[ros], rig)

    def write(self, sample: Sample) -> None:
        """Add an image, a scan or a packet of events.

        Raises:
            SourceError: the disk is full, now or before; the rig lacks the sensor; or two sensors of the
                profile share a topic and differ in kind.
            ValueError: the sample has no timestamp at all.
        """
        if isinstance(sample, Events):
            channel = event_channel(self._rig, sample.sensor) or "events"
            topic, frame = self._camera_topic(sample.sensor, channel)
            if len(sample):
                arrival_ns = int(sample.t_ns[-1]) if sample.host_ns is None else sample.host_ns
                packet = encode_event_array(sample, frame, "ros1" if self._is_ros1 else "cdr")
                self._write(topic, EVENT_ARRAY_TYPE, arrival_ns, packet)
            return
        received_ns = sample.stamp_ns if sample.host_ns is None else sample.host_ns
        if received_ns is None:
            raise ValueError(f"a sample of {sample.sensor} carries no time")
        if isinstance(sample, Image):
            topic, frame = self._camera_topic(sample.sensor, sample.channel)
            image = encode_image(sample, frame, self._is_ros1)
            self._write(topic, IMAGE_TYPE, received_ns, image)
        else:
            if sample.sensor not in self._rig.lidars:
                raise SourceError(f"rig {self._rig.name!r} has no lidar {sample.sensor!r}")
            settings = self._rig.lidars[sample.sensor]
            topic = settings.topic or f"/{sample.sensor}/points"
            cloud = encode_scan(sample, settings, self._is_ros1)
            self._write(topic, CLOUD_TYPE, received_ns, cloud)

    def close(self) -> None:
        """Write the index; a second call, or one after a failure, has no effect.

        Raises:
            SourceError: the disk is full.
        """
        if self._writer is not None and self._failure is None:
            with self._disk():
                self._writer.close()
        self._writer = None

    def __exit__(self, _: object, error: BaseException | None, *__: object) -> None:
        try:
            self.close()
        except SourceError:
            if error is None:
                raise

    def _write(self, topic: str, msgtype: str, received_ns: int, data: bytes | memoryview) -> None:
        if topic not in self._connections:
            store = typestore(self._is_ros1)
            self._connections[topic] = msgtype, self._writer.add_connection(topic, msgtype, typestore=store)
        before, connection = self._connections[topic]
        if before != msgtype:
            hint = "Give each a topic in the profile."
            raise SourceError(f"topic {topic} would carry both {before} and {msgtype}", hint)
        with self._disk():
            self._writer.write(connection, received_ns, data)

    def _camera_topic(self, camera: str, channel: str) -> tuple[str, str]:
        settings = self._rig.cameras.get(camera)
        if settings is None or channel not in settings.channels:
            raise SourceError(f"rig {self._rig.name!r} has no camera channel {camera}.{channel}")
        return settings.channels[channel].topic or f"/{camera}/{channel}", settings.optical_frame

    @contextmanager
    def _disk(self) -> Iterator[None]:
        """Close the bag after a full disk or an interrupt; nothing is written after that."""
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except BaseException as error:
            self._failure = _not_writable(self.path, error)
            with suppress(OSError):
                # rosbags before 0.11 cannot close a file without trying to write the index.
                getattr(self._writer, "abort", self._writer.close)()
            if isinstance(error, OSError):
                raise self._failure from error
            raise


def _not_writable(path: Path, error: BaseException) -> SourceError:
    """Return the error for a failed write; its hint explains how to restore the data written so far."""
    return SourceError(
        f"{path} cannot be written: {getattr(error, 'strerror', '') or str(error) or type(error).__name__}",
        "Make room or record elsewhere; `rosbag reindex` or `mcap recover` restores what was recorded.",
    )
