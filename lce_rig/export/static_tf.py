"""static_transforms.txt: commands to paste that publish the calibration in ROS 1 and ROS 2."""

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, invert, pose
from lce_rig.core.results import Calibration
from lce_rig.export.files import header, number, reads_back
from lce_rig.export.frames import Joint, build_trees, choose_channels
from lce_rig.export.probes import check_pose
from lce_rig.export.rotations import quaternion_wxyz, rotation_from_quaternion
from lce_rig.rig import Rig
from lce_rig.session.durable import write_atomically

FILE_NAME = "static_transforms.txt"
_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")


def export_static_tf(calibrations: Sequence[Calibration], rig: Rig, folder: Path) -> list[Path]:
    """Write static_transforms.txt and check it by reading it back.

    Raises:
        LceRigError: the file reads back differently.
    """
    chosen = choose_channels(calibrations, rig)
    joints = [joint for tree in build_trees(calibrations, rig) for joint in tree.joints]
    lines = [f"# {line}" for line in header("static transforms", rig, chosen)]
    lines += [
        "# each line gives the pose of the child in its parent; publish either these or the URDF, not both"
    ]
    lines += ["", "# ROS 1"]
    lines += [_ros1(joint) for joint in joints]
    lines += ["", "# ROS 2"]
    lines += [_ros2(joint) for joint in joints]
    path = folder / FILE_NAME
    write_atomically(path, "\n".join(lines) + "\n")
    _check(path, joints, chosen, rig)
    return [path]


def _values(joint: Joint) -> list[str]:
    xyzw = np.roll(quaternion_wxyz(joint.T_parent_child[:3, :3]), -1)
    return [number(value) for value in (*joint.T_parent_child[:3, 3], *xyzw)]


def _ros1(joint: Joint) -> str:
    return (
        f"rosrun tf2_ros static_transform_publisher {' '.join(_values(joint))} {joint.parent} {joint.child}"
    )


def _ros2(joint: Joint) -> str:
    named = " ".join(f"--{name} {value}" for name, value in zip(_NAMES, _values(joint), strict=True))
    frames = f"--frame-id {joint.parent} --child-frame-id {joint.child}"
    return f"ros2 run tf2_ros static_transform_publisher {named} {frames}"


@reads_back
def read_static_tf(path: Path) -> dict[str, dict[tuple[str, str], Array]]:
    """Read T_parent_child (4, 4) by (parent, child) from the commands of each ROS ("ros1", "ros2")."""
    found: dict[str, dict[tuple[str, str], Array]] = {"ros1": {}, "ros2": {}}
    for line in path.read_text(encoding="utf-8").splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["rosrun"]:
            *values, parent, child = words[3:]
            found["ros1"][parent, child] = _pose(values)
        elif words[:1] == ["ros2"]:
            options = dict(zip(words[4::2], words[5::2], strict=True))
            values = [options[f"--{name}"] for name in _NAMES]
            found["ros2"][options["--frame-id"], options["--child-frame-id"]] = _pose(values)
    return found


def _pose(values: Sequence[str]) -> Array:
    x, y, z, qx, qy, qz, qw = (float(value) for value in values)
    return pose(rotation_from_quaternion(np.array([qw, qx, qy, qz])), np.array([x, y, z]))


@reads_back
def _check(path: Path, joints: Sequence[Joint], chosen: Sequence[Calibration], rig: Rig) -> None:
    wanted = {(joint.parent, joint.child) for joint in joints}
    for version, poses in read_static_tf(path).items():
        if set(poses) != wanted:
            raise LceRigError(f"{path}: {version}: reads back with different frames")
        for calibration in chosen:
            camera, lidar = rig.cameras[calibration.camera], rig.lidars[calibration.lidar]
            T_body_optical = poses[camera.frame, camera.optical_frame]
            if (lidar.frame, camera.frame) in poses:
                T_cam_lidar = invert(poses[lidar.frame, camera.frame] @ T_body_optical)
            elif (camera.frame, lidar.frame) in poses:
                T_cam_lidar = invert(T_body_optical) @ poses[camera.frame, lidar.frame]
            else:
                continue  # closes a loop, not in the tree
            check_pose(path, f"{version} {lidar.frame} to {camera.frame}", T_cam_lidar, calibration, rig)
