"""sensor_kit_calibration.yaml and sensors_calibration.yaml, as Autoware's individual_params hold them.

Autoware's kit frame is `sensor_kit_base_link`. A LiDAR's entry there is the base of its housing, from which
its description leads to the frame of the points; a camera's is its body, `NAME/camera_link`.

References:
    https://autowarefoundation.github.io/autoware-documentation (creating a sensor model)
    https://github.com/ros-drivers/velodyne (velodyne_description: from the base to the centre)
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lce_rig.core.geometry import Array, invert, pose
from lce_rig.export.findings import NO_FRAME
from lce_rig.export.job import ExportJob
from lce_rig.export.robot_tree import FrameTree, RobotTree
from lce_rig.export.writing import number, quoted, rpy

KIT, BASE = "sensor_kit_base_link", "base_link"
KIT_FILE, BASE_FILE = "sensor_kit_calibration.yaml", "sensors_calibration.yaml"
_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
# Height of the points' origin above the base of the housing in the LiDAR's description, m.
_CENTRE_M = {"VLP-16": 0.0377, "VLP16": 0.0377}


class _Entry(NamedTuple):
    """A sensor of the kit.

    Attributes:
        key: its name in the file.
        frame: of the LiDAR's points or the camera's body.
        T_key_frame: (4, 4), which Autoware's description of the sensor adds.
    """

    key: str
    frame: str
    T_key_frame: Array


def export_autoware(job: ExportJob) -> list[Path]:
    """Write the sensors' poses in the kit, and the kit's on the vehicle where that is known.

    Without a frame `sensor_kit_base_link` in the robot's tree, the kit is where the first sensor's entry is.
    """
    paths = []
    for index, tree in enumerate(job.trees):
        robot = RobotTree.of_joints("the tree", tree.joints)
        entries = _entries(tree, robot, job)
        if KIT in tree.frames:
            T_root_kit = robot.find_pose(tree.root, KIT)
        else:
            first = min(entries, key=lambda entry: len(robot.chain(entry.frame)))
            T_root_kit = robot.find_pose(tree.root, first.frame) @ invert(first.T_key_frame)
        T_kit_root = invert(T_root_kit)
        poses = {
            entry.key: T_kit_root @ robot.find_pose(tree.root, entry.frame) @ invert(entry.T_key_frame)
            for entry in entries
        }
        suffix = f"-{tree.root.replace('/', '_')}" if index else ""
        lines = _content("Autoware sensor kit calibration", KIT, poses, entries, job)
        paths.append(job.write(KIT_FILE.replace(".yaml", f"{suffix}.yaml"), lines))
        if tree.root == BASE or BASE in tree.frames:
            T_base_kit = invert(robot.find_pose(tree.root, BASE)) @ T_root_kit
            lines = _content("Autoware sensors calibration", BASE, {KIT: T_base_kit}, (), job)
            paths.append(job.write(BASE_FILE, lines))
        else:
            figures = {"format": "autoware", "file": BASE_FILE, "frame": BASE, "root": tree.root}
            job.findings.append(NO_FRAME(tree.root, severity="note", **figures))
    return paths


def _entries(tree: FrameTree, robot: RobotTree, job: ExportJob) -> list[_Entry]:
    """List the sensors of a tree with their names in Autoware."""
    entries = []
    for lidar in job.rig.lidars.values():
        if lidar.frame in tree.frames:
            # The base of the housing, where the LiDAR's description is known to begin.
            model = lidar.model.upper()
            heights_m = [height for name, height in _CENTRE_M.items() if model.startswith(name)]
            entry = _Entry(lidar.frame, lidar.frame, np.eye(4))
            if heights_m and not lidar.frame.endswith("_base_link"):
                T_base_lidar = pose(np.eye(3), np.array([0.0, 0.0, heights_m[0]]))
                entry = _Entry(f"{lidar.frame}_base_link", lidar.frame, T_base_lidar)
            entries.append(_below_kit(robot, job, lidar.frame) or entry)
    for name, camera in job.rig.cameras.items():
        if camera.frame in tree.frames:
            key = camera.frame if "/" in camera.frame else f"{name}/camera_link"
            entry = _Entry(key, camera.frame, np.eye(4))
            entries.append(_below_kit(robot, job, camera.frame) or entry)
    return entries


def _below_kit(robot: RobotTree, job: ExportJob, frame: str) -> _Entry | None:
    """Find the sensor's frame directly below the kit in the robot's own tree, with the robot's way to it."""
    if job.robot is None or frame not in job.robot.frames or KIT not in robot.chain(frame)[1:]:
        return None
    chain = robot.chain(frame)
    between = chain[1 : chain.index(KIT)]
    bodies = {lidar.frame for lidar in job.rig.lidars.values()}
    bodies |= {camera.frame for camera in job.rig.cameras.values()}
    if bodies.intersection(between):
        return None
    key = [frame, *between][-1]
    # What lies between is the sensor's description, which stays as the robot has it.
    return _Entry(key, frame, job.robot.find_pose(key, frame))


def _content(
    content: str, root: str, poses: Mapping[str, Array], entries: Sequence[_Entry], job: ExportJob
) -> list[str]:
    lines = [f"# {line}" for line in job.head(content, *job.chosen)]
    for entry in entries:
        place = "the frame of the profile"
        if entry.key != entry.frame:
            x, y, z = entry.T_key_frame[:3, 3]
            is_same = np.allclose(entry.T_key_frame, np.eye(4))
            at = f"lies at ({x:.4f}, {y:.4f}, {z:.4f}) m in it, as its description must say"
            place = f"{entry.frame} {'of the profile' if is_same else at}"
        lines.append(f"# {entry.key}: {place}")
    lines.append(f"{root}:")
    for frame, T in poses.items():
        values = (*T[:3, 3], *rpy(T[:3, :3]))
        lines.append(f"  {quoted(frame)}:")
        lines += [f"    {key}: {number(value)}" for key, value in zip(_KEYS, values, strict=True)]
    return lines
