"""Files for ROS: camera_info, static transforms as commands for ROS 1 and ROS 2, and a ROS 2 launch file.

Transforms that the robot's own tree already has are not repeated.
"""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.export import ExportJob
from lce_rig.export.robot_tree import Joint
from lce_rig.export.writing import number, quaternion_xyzw, yaml_text
from lce_rig.session.durable import write_atomically


def export_camera_info(job: ExportJob) -> list[Path]:
    """Write camera_info_CAMERA.yaml for ROS camera drivers."""
    paths = []
    for name, calibration in job.by_camera.items():
        path = job.folder / f"camera_info_{name}.yaml"
        head = job.head("camera_info", calibration, of_one_camera=True)
        write_atomically(path, camera_info_text(name, job.rig.cameras[name].to_intrinsics(), head))
        paths.append(path)
    return paths


def ros_distortion(intrinsics: Intrinsics) -> tuple[str, tuple[float, ...]]:
    """Return the name of the ROS distortion model and its coefficients (4, 5 or 8)."""
    coefficients = intrinsics.distortion
    if intrinsics.model == "equidistant":
        return "equidistant", coefficients
    # plumb_bob has five coefficients, k3 last; rational_polynomial eight.
    model, count = ("plumb_bob", 5) if len(coefficients) <= 5 else ("rational_polynomial", 8)
    return model, (*coefficients, *(0.0,) * (count - len(coefficients)))


def camera_info_text(name: str, intrinsics: Intrinsics, head: Sequence[str]) -> str:
    """Write the content of a camera_info file, after `head` as comments."""
    model, coefficients = ros_distortion(intrinsics)
    document = {
        "image_width": intrinsics.width_px,
        "image_height": intrinsics.height_px,
        "camera_name": name,
        "camera_matrix": _matrix(intrinsics.matrix),
        "distortion_model": model,
        "distortion_coefficients": _matrix(np.array([coefficients])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.hstack([intrinsics.matrix, np.zeros((3, 1))])),
    }
    return yaml_text(head, document)


def _matrix(matrix: Array) -> dict[str, Any]:
    n_rows, n_cols = matrix.shape
    return {"rows": n_rows, "cols": n_cols, "data": matrix.ravel()}


_OPTIONS = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")


def _own_joints(job: ExportJob) -> list[Joint]:
    return [joint for tree in job.trees for joint in tree.above.values() if not joint.is_given]


def export_static_tf(job: ExportJob) -> list[Path]:
    """Write static_transforms.txt: static_transform_publisher lines, ROS 1 and 2."""
    joints = _own_joints(job)
    lines = [f"# {line}" for line in job.head("static transforms", *job.calibrations)]
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
    """Write RIG.launch.py, a ROS 2 launch file with one static_transform_publisher per joint."""
    lines = [f"# {line}" for line in job.head("ROS 2 launch file", *job.calibrations)]
    lines += [
        "from launch import LaunchDescription",
        "from launch_ros.actions import Node",
        "",
        "",
        "def generate_launch_description():",
        "    return LaunchDescription(",
        "        [",
        *(line for joint in _own_joints(job) for line in _node(joint)),
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
    T = joint.T_parent_child
    return [number(value) for value in (*T[:3, 3], *quaternion_xyzw(T[:3, :3]))]


def _publisher_options(joint: Joint) -> list[str]:
    """List the arguments of ROS 2's static_transform_publisher."""
    named = [word for pair in zip(_OPTIONS, _pose_values(joint), strict=True) for word in pair]
    return [*named, "--frame-id", joint.parent, "--child-frame-id", joint.child]
