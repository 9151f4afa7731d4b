"""A ROS 2 bag (mcap) of static transforms.

References:
    https://github.com/ros2/rosbag2 (metadata.yaml, offered_qos_profiles)
"""

import shutil
from pathlib import Path
from typing import Any

from lce_rig.core.errors import SessionError
from lce_rig.export import ExportJob
from lce_rig.export.writing import quaternion_xyzw
from lce_rig.io.ros.messages import typestore

_TF_TYPE, _TF_STATIC = "tf2_msgs/msg/TFMessage", "/tf_static"


def export_tf_static_bag(job: ExportJob) -> list[Path]:
    """Write tf_static/, a ROS 2 bag with one latched message of all transforms, in place of an earlier one.

    It holds the robot's own transforms on the way to the sensors too, as no other program publishes while a
    bag is played. The message is reliable and transient local, as tf2 wants it. metadata.yaml names lce-rig
    as its writer.

    Raises:
        SessionError: a full disk, no permission.
    """
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

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
    folder, store = job.folder / "tf_static", typestore(False)
    try:
        if folder.is_dir():
            shutil.rmtree(folder)
        # Version 8 states QoS in the numbers that Humble reads as well; 9 does in words, since Jazzy.
        writer = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        for index, line in enumerate(job.head("ROS 2 bag of static transforms", *job.calibrations)):
            writer.set_custom_data(f"about_{index}", line)
        with writer:
            topic = writer.add_connection(
                _TF_STATIC, _TF_TYPE, typestore=store, offered_qos_profiles=[latched]
            )
            writer.write(topic, 0, store.serialize_cdr(_transforms(job), _TF_TYPE))
    except OSError as error:
        hint = "Free space or choose another folder."
        raise SessionError(f"{folder}: cannot be written: {error.strerror or error}", hint) from error
    return sorted(folder.iterdir())


def _transforms(job: ExportJob) -> Any:
    """Build the tf2_msgs/TFMessage of all joints."""
    types = typestore(False).types
    names = ("Vector3", "Quaternion", "Transform", "TransformStamped")
    vector, quaternion, transform, stamped = (types[f"geometry_msgs/msg/{name}"] for name in names)
    header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    transforms = []
    for joint in (joint for tree in job.trees for joint in tree.above.values()):
        x, y, z = joint.T_parent_child[:3, 3].tolist()
        qx, qy, qz, qw = quaternion_xyzw(joint.T_parent_child[:3, :3]).tolist()
        pose = transform(translation=vector(x=x, y=y, z=z), rotation=quaternion(x=qx, y=qy, z=qz, w=qw))
        above = header(stamp=time, frame_id=joint.parent)
        transforms.append(stamped(header=above, child_frame_id=joint.child, transform=pose))
    return types[_TF_TYPE](transforms=transforms)
