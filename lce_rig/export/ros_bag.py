"""ROS 2 bags (mcap): static transforms alone, or with the session's data for Foxglove and RViz.

References:
    https://github.com/ros2/rosbag2 (metadata.yaml, offered_qos_profiles)
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.export import NO_IMAGES, NO_SESSION, ExportJob
from lce_rig.export.ros_files import ros_distortion
from lce_rig.export.writing import quaternion_xyzw
from lce_rig.io.ros.bag_recorder import CLOUD_TYPE, IMAGE_TYPE, encode_image, encode_scan
from lce_rig.io.ros.messages import typestore
from lce_rig.show.overlays.overlay import draw_projection, range_limits
from lce_rig.timing.clock import NS_PER_S

_TF_TYPE, _TF_STATIC = "tf2_msgs/msg/TFMessage", "/tf_static"
_INFO_TYPE, _JPEG_TYPE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/CompressedImage"
_JPEG_QUALITY = 92
# Interval between captures without timestamps, ns.
_STEP_NS = NS_PER_S


class _Topics:
    """The topics of a bag, each created with its first message."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, msgtype: str, time_ns: int, message: Any) -> None:
        store = typestore(False)
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, msgtype, typestore=store)
        data = message if isinstance(message, bytes | memoryview) else store.serialize_cdr(message, msgtype)
        self._writer.write(self._connections[topic], time_ns, data)


def export_tf_static_bag(job: ExportJob) -> list[Path]:
    """Write tf_static/, a ROS 2 bag with all transforms in one latched message; replace an earlier one.

    The bag also holds the robot's own transforms between root and sensors, as no other program publishes them
    during playback. The message is reliable and transient local, as tf2 requires. metadata.yaml names lce-rig
    as its writer.

    Raises:
        SessionError: a full disk, no permission.
    """
    folder = job.folder / "tf_static"
    with _bag_writer(folder, "ROS 2 bag of static transforms", job) as writer:
        _write_tf_static(writer, job, 0)
    return sorted(folder.iterdir())


def export_mcap(job: ExportJob) -> list[Path]:
    """Write the bag RIG_session/: images, point clouds, camera models and transforms.

    Besides the images, the bag holds images with the projected point cloud.

    Raises:
        SessionError: a capture is damaged, or the disk is full.
    """
    if job.session is None:
        job.findings.append(NO_SESSION(format="mcap"))
        return []
    captures = job.session.captures
    folder = job.folder / f"{job.rig.name}_session"
    shown: set[str] = set()
    with _bag_writer(folder, "session as a ROS 2 bag", job) as writer:
        topics = _Topics(writer)
        before_ns, limits_m = 0, None
        for index, capture in enumerate(captures):
            scans = [capture.scan(lidar) for lidar in capture.lidars]
            images = [capture.image(*key) for key in capture.image_keys if key[0] in job.rig.cameras]
            # The time of its scan, as the LiDAR's clock is the rig's.
            samples: list[Scan | Image] = [*scans, *images]
            stamps_ns = [sample.stamp_ns for sample in samples if sample.stamp_ns]
            time_ns = stamps_ns[0] if stamps_ns else before_ns + _STEP_NS
            before_ns = time_ns
            limits_m = limits_m or range_limits(scans)  # the same colours in all captures
            if not index:
                _write_tf_static(writer, job, time_ns)
            for scan in scans:
                scan = scan if scan.stamp_ns is not None else replace(scan, stamp_ns=time_ns)
                settings = job.rig.lidars[scan.sensor]
                topic = settings.topic or f"/{scan.sensor}/points"
                data = encode_scan(scan, settings, False)
                topics.write(topic, CLOUD_TYPE, time_ns, data)
            for image in images:
                shown.add(image.sensor)
                image = image if image.stamp_ns is not None else replace(image, stamp_ns=time_ns)
                topic = image_topic(job, image.sensor, image.channel)
                frame = job.rig.cameras[image.sensor].optical_frame
                data = encode_image(image, frame, False)
                topics.write(topic, IMAGE_TYPE, time_ns, data)
                info = _camera_info(job, image.sensor, image.stamp_ns or 0)
                topics.write(f"{topic.rpartition('/')[0]}/camera_info", _INFO_TYPE, time_ns, info)
            for calibration in job.of_cameras:
                _write_projected(topics, calibration, scans, images, time_ns, limits_m, job)
    for name in job.by_camera:
        if name not in shown:
            job.findings.append(NO_IMAGES(name, format="mcap"))
    return sorted(folder.iterdir())


def image_topic(job: ExportJob, camera: str, channel: str) -> str:
    """Return the topic of a camera's images, in a separate namespace for its camera_info."""
    topic = job.rig.cameras[camera].channels[channel].topic or f"/{camera}/{channel}"
    topic = topic if topic.startswith("/") else f"/{topic}"
    return topic if topic.count("/") > 1 else f"{topic}/image"


def _write_projected(
    topics: _Topics,
    calibration: Calibration,
    scans: list[Scan],
    images: list[Image],
    time_ns: int,
    limits_m: tuple[float, float],
    job: ExportJob,
) -> None:
    import cv2

    scan = next((scan for scan in scans if scan.sensor == calibration.lidar), None)
    of_camera = [image for image in images if image.sensor == calibration.camera]
    of_camera.sort(key=lambda image: image.channel not in calibration.channels)
    if scan is None or not of_camera:
        return
    camera = job.rig.cameras[calibration.camera]
    picture = draw_projection(of_camera[0], scan, camera.to_intrinsics(), calibration.T_cam_lidar, limits_m)
    is_done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    assert is_done
    message = typestore(False).types[_JPEG_TYPE](
        header=_ros_header(of_camera[0].stamp_ns or time_ns, camera.optical_frame),
        format="jpeg",
        data=np.asarray(data, dtype=np.uint8).ravel(),
    )
    topic = f"/lce_rig/{calibration.camera}/{calibration.lidar}/projected/compressed"
    topics.write(topic, _JPEG_TYPE, time_ns, message)


@contextmanager
def _bag_writer(folder: Path, content: str, job: ExportJob) -> Iterator[Any]:
    """Open a ROS 2 bag (mcap), replacing an earlier one; metadata.yaml names lce-rig as its writer.

    Raises:
        SessionError: a full disk, no permission.
    """
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    try:
        if folder.is_dir():
            shutil.rmtree(folder)
        # Version 8 states QoS in the numbers that Humble reads as well; 9 does in words, since Jazzy.
        writer = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        for index, line in enumerate(job.head(content, *job.calibrations)):
            writer.set_custom_data(f"about_{index}", line)
        with writer:
            yield writer
    except OSError as error:
        hint = "Free space or choose another folder."
        raise SessionError(f"{folder}: cannot be written: {error.strerror or error}", hint) from error


def _write_tf_static(writer: Any, job: ExportJob, stamp_ns: int) -> None:
    """Write all transforms as one message on /tf_static, reliable and transient local as tf2 requires."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(sec=0, nsec=0)
    latched = Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL,
        deadline=never,
        lifespan=never,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )
    store = typestore(False)
    topic = writer.add_connection(_TF_STATIC, _TF_TYPE, typestore=store, offered_qos_profiles=[latched])
    joints = [joint for tree in job.trees for joint in tree.above.values()]
    names = ("Vector3", "Quaternion", "Transform", "TransformStamped")
    vector, quaternion, transform, stamped = (store.types[f"geometry_msgs/msg/{name}"] for name in names)
    transforms = []
    for joint in joints:
        x, y, z = joint.T_parent_child[:3, 3].tolist()
        qx, qy, qz, qw = quaternion_xyzw(joint.T_parent_child[:3, :3]).tolist()
        pose = transform(translation=vector(x=x, y=y, z=z), rotation=quaternion(x=qx, y=qy, z=qz, w=qw))
        header = _ros_header(stamp_ns, joint.parent)
        transforms.append(stamped(header=header, child_frame_id=joint.child, transform=pose))
    message = store.types[_TF_TYPE](transforms=transforms)
    writer.write(topic, stamp_ns, store.serialize_cdr(message, _TF_TYPE))


def _ros_header(stamp_ns: int, frame_id: str) -> Any:
    """Build a std_msgs/Header."""
    types = typestore(False).types
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def _camera_info(job: ExportJob, camera: str, stamp_ns: int) -> Any:
    """Build the sensor_msgs/CameraInfo of a camera as calibrated."""
    intrinsics = job.rig.cameras[camera].to_intrinsics()
    model, coefficients = ros_distortion(intrinsics)
    types = typestore(False).types
    return types["sensor_msgs/msg/CameraInfo"](
        header=_ros_header(stamp_ns, job.rig.cameras[camera].optical_frame),
        height=intrinsics.height_px,
        width=intrinsics.width_px,
        distortion_model=model,
        d=np.array(coefficients),
        k=intrinsics.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([intrinsics.matrix, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )
