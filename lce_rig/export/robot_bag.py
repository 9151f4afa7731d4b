"""A robot's tree of frames from the static transforms of a recording."""

from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.errors import SessionError, SourceError
from lce_rig.core.geometry import Array, pose
from lce_rig.export.robot_tree import RobotJoint, RobotTree
from lce_rig.export.rotations import rotation_from_quaternion
from lce_rig.io.ros.bag_file import BagFile, list_topics
from lce_rig.io.ros.rosbag import deserialize

_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
# Rounding of the float64 that ROS writes is far below; what differs more is no rotation.
_UNIT_TOLERANCE = 1e-3


def read_robot_bag(path: Path) -> RobotTree:
    """Read the transforms on /tf_static of a ROS 1 bag, a ROS 2 bag or an mcap file.

    Of several transforms to one frame the last counts, as in tf.

    Raises:
        SourceError: the bag cannot be read, is damaged, or has no static transforms.
        SessionError: a frame has two parents, or the frames make a loop; or a transform is not rigid.
    """
    bag = BagFile(path)
    topics = [
        topic for topic, (kind, _) in bag.topics.items() if topic.endswith("tf_static") and kind in _TYPES
    ]
    joints: dict[tuple[str, str], RobotJoint] = {}
    for message in bag.messages(topics):
        try:
            content = deserialize(message)
        except ValueError as error:
            raise SourceError(f"{path}: {message.topic}: {error}") from None
        for each in content.transforms:
            parent, child = (_name(text) for text in (each.header.frame_id, each.child_frame_id))
            joints.pop((parent, child), None)
            joints[parent, child] = RobotJoint(parent, _matrix(path, child, each.transform))
    if not joints:
        raise SourceError(f"{path} has no static transforms (/tf_static)", list_topics(bag.topics))
    return RobotTree.of_joints(
        str(path), [(child, joint) for (_, child), joint in joints.items()], has_one_root=False
    )


def _name(frame: str) -> str:
    """Give a frame's name as tf2 has it; tf began them with a slash."""
    return frame.removeprefix("/")


def _matrix(path: Path, child: str, transform: Any) -> Array:
    t, q = transform.translation, transform.rotation
    xyz, wxyz = np.array([t.x, t.y, t.z]), np.array([q.w, q.x, q.y, q.z])
    if not (np.isfinite(xyz).all() and abs(np.linalg.norm(wxyz) - 1) < _UNIT_TOLERANCE):
        raise SessionError(f"{path}: the static transform to {child} is not rigid")
    return pose(rotation_from_quaternion(wxyz), xyz)
