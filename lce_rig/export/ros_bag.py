"""ROS 2 bags as outputs: static transforms alone, or the session with them.

References:
    https://github.com/ros2/rosbag2 (metadata.yaml, offered_qos_profiles)
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.errors import SessionError
from lce_rig.export.files import header, reads_back
from lce_rig.export.frames import Joint
from lce_rig.export.job import ExportJob
from lce_rig.export.robot_bag import read_robot_bag
from lce_rig.export.robot_tree import check_frames
from lce_rig.export.rotations import quaternion_wxyz
from lce_rig.io.ros.message_fields import typestore

TF_TYPE = "tf2_msgs/msg/TFMessage"
TF_STATIC = "/tf_static"
_FOLDER = "tf_static"
_NS_PER_S = 10**9


def export_tf_static_bag(job: ExportJob) -> list[Path]:
    """Write the bag tf_static/ with one latched message of all transforms, and check it by reading it back.

    It holds the robot's own transforms on the way to the sensors too, as nobody else publishes while a bag is
    played.

    Raises:
        LceRigError: the bag reads back differently.
        SessionError: a full disk, no permission.
    """
    folder = job.folder / _FOLDER
    with bag_writer(folder, "ROS 2 bag of static transforms", job) as writer:
        write_tf_static(writer, job, 0)
    check_bag(folder, job)
    return sorted(folder.iterdir())


@contextmanager
def bag_writer(folder: Path, what: str, job: ExportJob) -> Iterator[Any]:
    """Begin a ROS 2 bag (mcap) in place of an earlier one; metadata.yaml says who wrote it.

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
        for index, line in enumerate(header(what, job.rig, job.chosen)):
            writer.set_custom_data(f"about_{index}", line)
        with writer:
            yield writer
    except OSError as error:
        hint = "Free space or choose another folder."
        raise SessionError(f"{folder}: cannot be written: {error.strerror or error}", hint) from error


def write_tf_static(writer: Any, job: ExportJob, stamp_ns: int) -> None:
    """Write all transforms as one message on /tf_static, reliable and transient local as tf2 wants it."""
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
    topic = writer.add_connection(TF_STATIC, TF_TYPE, typestore=store, offered_qos_profiles=[latched])
    joints = [joint for tree in job.trees for joint in tree.joints]
    message = store.types[TF_TYPE](transforms=[_stamped(store, joint, stamp_ns) for joint in joints])
    writer.write(topic, stamp_ns, store.serialize_cdr(message, TF_TYPE))


def ros_header(stamp_ns: int, frame_id: str) -> Any:
    """Build a std_msgs/Header."""
    types = typestore(False).types
    seconds, nanoseconds = divmod(stamp_ns, _NS_PER_S)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def _stamped(store: Any, joint: Joint, stamp_ns: int) -> Any:
    x, y, z = (float(value) for value in joint.T_parent_child[:3, 3])
    qw, qx, qy, qz = (float(value) for value in quaternion_wxyz(joint.T_parent_child[:3, :3]))
    geometry = {name: store.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion")}
    transform = store.types["geometry_msgs/msg/Transform"](
        translation=geometry["Vector3"](x=x, y=y, z=z),
        rotation=geometry["Quaternion"](x=qx, y=qy, z=qz, w=qw),
    )
    return store.types["geometry_msgs/msg/TransformStamped"](
        header=ros_header(stamp_ns, joint.parent), child_frame_id=joint.child, transform=transform
    )


@reads_back
def check_bag(folder: Path, job: ExportJob) -> None:
    """Check the static transforms of a bag by reading them back.

    Raises:
        LceRigError: a point lands elsewhere.
    """
    read = read_robot_bag(folder)
    wanted = {frame for tree in job.trees for frame in tree.frames}
    if read.frames != wanted:
        raise SessionError(f"{folder}: frames {sorted(read.frames)} read back, {sorted(wanted)} written")
    check_frames(folder, "", read, job.trees, job.chosen, job.rig)


def camera_info(job: ExportJob, camera: str, stamp_ns: int) -> Any:
    """Build the sensor_msgs/CameraInfo of a camera as calibrated."""
    from lce_rig.export.camera_info import ros_distortion

    intrinsics = job.rig.cameras[camera].to_intrinsics()
    model, coefficients = ros_distortion(intrinsics)
    types = typestore(False).types
    return types["sensor_msgs/msg/CameraInfo"](
        header=ros_header(stamp_ns, job.rig.cameras[camera].optical_frame),
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
