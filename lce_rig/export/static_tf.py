"""static_transforms.txt: commands to paste that publish the calibration in ROS 1 and ROS 2."""

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, pose
from lce_rig.export.files import header, number, reads_back
from lce_rig.export.frames import Joint
from lce_rig.export.job import ExportJob
from lce_rig.export.robot_tree import RobotJoint, RobotTree, check_frames
from lce_rig.export.rotations import quaternion_wxyz, rotation_from_quaternion
from lce_rig.session.durable import write_atomically

FILE_NAME = "static_transforms.txt"
OPTIONS = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
"""ROS 2's names of what `pose_values` lists."""


def export_static_tf(job: ExportJob) -> list[Path]:
    """Write static_transforms.txt and check it by reading it back.

    Transforms that the robot's own tree has like this are left to the robot.

    Raises:
        LceRigError: the file reads back differently.
    """
    joints = [joint for tree in job.trees for joint in tree.joints if not joint.is_given]
    lines = [f"# {line}" for line in header("static transforms", job.rig, job.chosen)]
    lines += [
        "# each line gives the pose of the child in its parent; publish either these or the URDF, not both"
    ]
    lines += ["", "# ROS 1"]
    lines += [_ros1(joint) for joint in joints]
    lines += ["", "# ROS 2"]
    lines += [_ros2(joint) for joint in joints]
    path = job.folder / FILE_NAME
    write_atomically(path, "\n".join(lines) + "\n")
    _check(path, job)
    return [path]


def pose_values(joint: Joint) -> list[str]:
    """Write x, y, z in m and the quaternion x, y, z, w of a joint."""
    xyzw = np.roll(quaternion_wxyz(joint.T_parent_child[:3, :3]), -1)
    return [number(value) for value in (*joint.T_parent_child[:3, 3], *xyzw)]


def publisher_options(joint: Joint) -> list[str]:
    """List the arguments of ROS 2's static_transform_publisher."""
    named = [word for pair in zip(OPTIONS, pose_values(joint), strict=True) for word in pair]
    return [*named, "--frame-id", joint.parent, "--child-frame-id", joint.child]


def read_options(words: Sequence[str]) -> tuple[str, RobotJoint]:
    """Read a frame and the joint above it from the arguments of ROS 2's static_transform_publisher."""
    options = dict(zip(words[::2], words[1::2], strict=True))
    T_parent_child = _pose([options[name] for name in OPTIONS])
    return options["--child-frame-id"], RobotJoint(options["--frame-id"], T_parent_child)


def check_published(
    path: Path, what: str, published: Sequence[tuple[str, RobotJoint]], job: ExportJob
) -> None:
    """Check transforms read back from a file, on top of those that the robot has.

    Raises:
        LceRigError: other frames, two parents, or a point that lands elsewhere.
    """
    joints = [joint for tree in job.trees for joint in tree.joints]
    wanted = {(joint.parent, joint.child) for joint in joints if not joint.is_given}
    if {(joint.parent, child) for child, joint in published} != wanted:
        raise LceRigError(f"{path}: {what}reads back with different frames")
    given = [
        (joint.child, RobotJoint(joint.parent, joint.T_parent_child)) for joint in joints if joint.is_given
    ]
    read = RobotTree.of_joints(str(path), [*given, *published], has_one_root=False)
    check_frames(path, what, read, job.trees, job.chosen, job.rig)


def _ros1(joint: Joint) -> str:
    words = [*pose_values(joint), joint.parent, joint.child]
    return f"rosrun tf2_ros static_transform_publisher {shlex.join(words)}"


def _ros2(joint: Joint) -> str:
    return f"ros2 run tf2_ros static_transform_publisher {shlex.join(publisher_options(joint))}"


@reads_back
def read_static_tf(path: Path) -> dict[str, list[tuple[str, RobotJoint]]]:
    """Read frames and the joints above them from the commands of each ROS ("ros1", "ros2")."""
    found: dict[str, list[tuple[str, RobotJoint]]] = {"ros1": [], "ros2": []}
    for line in path.read_text(encoding="utf-8").splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["rosrun"]:
            *values, parent, child = words[3:]
            found["ros1"].append((child, RobotJoint(parent, _pose(values))))
        elif words[:1] == ["ros2"]:
            found["ros2"].append(read_options(words[4:]))
    return found


def _pose(values: Sequence[str]) -> Array:
    x, y, z, qx, qy, qz, qw = (float(value) for value in values)
    return pose(rotation_from_quaternion(np.array([qw, qx, qy, qz])), np.array([x, y, z]))


@reads_back
def _check(path: Path, job: ExportJob) -> None:
    for version, published in read_static_tf(path).items():
        check_published(path, f"{version} ", published, job)
