"""Static transforms for ROS: commands to paste for ROS 1 and ROS 2, and a ROS 2 launch file.

Transforms that the robot's own tree has already are left to the robot.
"""

import shlex
from pathlib import Path

import numpy as np

from lce_rig.export.job import ExportJob
from lce_rig.export.robot_tree import Joint
from lce_rig.export.writing import number, quaternion_wxyz

_OPTIONS = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")


def export_static_tf(job: ExportJob) -> list[Path]:
    """Write static_transforms.txt."""
    joints = [joint for tree in job.trees for joint in tree.joints if not joint.is_given]
    lines = [f"# {line}" for line in job.head("static transforms", *job.chosen)]
    lines += [
        "# each line gives the pose of the child in its parent; publish either these or the URDF, not both"
    ]
    lines += ["", "# ROS 1"]
    for joint in joints:
        words = shlex.join([*_pose_values(joint), joint.parent, joint.child])
        lines.append(f"rosrun tf2_ros static_transform_publisher {words}")
    lines += ["", "# ROS 2"]
    for joint in joints:
        lines.append(f"ros2 run tf2_ros static_transform_publisher {shlex.join(_publisher_options(joint))}")
    return [job.write("static_transforms.txt", lines)]


def export_ros2_launch(job: ExportJob) -> list[Path]:
    """Write RIG.launch.py, one static_transform_publisher a joint."""
    lines = [f"# {line}" for line in job.head("ROS 2 launch file", *job.chosen)]
    lines += [
        "from launch import LaunchDescription",
        "from launch_ros.actions import Node",
        "",
        "",
        "def generate_launch_description():",
        "    return LaunchDescription(",
        "        [",
        *(line for tree in job.trees for joint in tree.joints if not joint.is_given for line in _node(joint)),
        "        ]",
        "    )",
    ]
    return [job.write(f"{job.rig.name}.launch.py", lines)]


def _node(joint: Joint) -> list[str]:
    name = "".join(c if c.isascii() and c.isalnum() else "_" for c in f"{joint.parent}_to_{joint.child}")
    words = _publisher_options(joint)
    pairs = [f"                    {a!r}, {b!r}," for a, b in zip(words[::2], words[1::2], strict=True)]
    return [
        "            Node(",
        "                package='tf2_ros',",
        "                executable='static_transform_publisher',",
        f"                name={name!r},",
        "                arguments=[",
        *pairs,
        "                ],",
        "            ),",
    ]


def _pose_values(joint: Joint) -> list[str]:
    """Write x, y, z in m and the quaternion x, y, z, w of a joint."""
    xyzw = np.roll(quaternion_wxyz(joint.T_parent_child[:3, :3]), -1)
    return [number(value) for value in (*joint.T_parent_child[:3, 3], *xyzw)]


def _publisher_options(joint: Joint) -> list[str]:
    """List the arguments of ROS 2's static_transform_publisher."""
    named = [word for pair in zip(_OPTIONS, _pose_values(joint), strict=True) for word in pair]
    return [*named, "--frame-id", joint.parent, "--child-frame-id", joint.child]
