"""sensor_kit_calibration.yaml and sensors_calibration.yaml, as Autoware's individual_params hold them.

Autoware's kit frame is `sensor_kit_base_link`. A LiDAR's entry there is the base of its housing, from which
its description leads to the frame of the points; a camera's is its body, `NAME/camera_link`.

References:
    https://autowarefoundation.github.io/autoware-documentation (creating a sensor model)
    https://github.com/ros-drivers/velodyne (velodyne_description: from the base to the centre)
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, invert, pose
from lce_rig.export.files import header, number, quoted, reads_back
from lce_rig.export.findings import NO_FRAME
from lce_rig.export.frames import T_BODY_OPTICAL, FrameTree
from lce_rig.export.job import ExportJob
from lce_rig.export.probes import check_pose
from lce_rig.export.robot_tree import RobotJoint, RobotTree
from lce_rig.export.rotations import rotation_from_rpy, rpy
from lce_rig.session.durable import write_atomically

KIT, BASE = "sensor_kit_base_link", "base_link"
KIT_FILE, BASE_FILE = "sensor_kit_calibration.yaml", "sensors_calibration.yaml"
_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
# Height of the points' origin above the base of the housing in the LiDAR's description, m.
_CENTRE_M = {"VLP-16": 0.0377, "VLP16": 0.0377}


@dataclass(frozen=True, eq=False)
class _Entry:
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
    """Write the sensors' poses in the kit, and the kit's on the vehicle where that is known; read both back.

    Without a frame `sensor_kit_base_link` in the robot's tree, the kit is where the first sensor's entry is.

    Raises:
        LceRigError: a file reads back differently.
    """
    paths = []
    for index, tree in enumerate(job.trees):
        robot = _as_robot(tree)
        entries = _entries(tree, robot, job)
        T_root_kit = _kit(tree, robot, entries)
        poses = {e.key: _in(T_root_kit, robot, tree, e) for e in entries}
        suffix = f"-{tree.root.replace('/', '_')}" if index else ""
        path = job.folder / KIT_FILE.replace(".yaml", f"{suffix}.yaml")
        write_atomically(path, _text("Autoware sensor kit calibration", KIT, poses, entries, job))
        _check(path, tree, entries, job)
        paths.append(path)
        if tree.root == BASE or BASE in tree.frames:
            T_base_kit = invert(robot.find_pose(tree.root, BASE)) @ T_root_kit
            path = job.folder / BASE_FILE
            write_atomically(path, _text("Autoware sensors calibration", BASE, {KIT: T_base_kit}, (), job))
            _check_base(path, T_base_kit)
            paths.append(path)
        else:
            figures = {"format": "autoware", "file": BASE_FILE, "frame": BASE, "root": tree.root}
            job.findings.append(NO_FRAME(tree.root, severity="note", **figures))
    return paths


def _as_robot(tree: FrameTree) -> RobotTree:
    joints = [(joint.child, RobotJoint(joint.parent, joint.T_parent_child)) for joint in tree.joints]
    return RobotTree.of_joints("the tree", joints)


def _entries(tree: FrameTree, robot: RobotTree, job: ExportJob) -> list[_Entry]:
    """List the sensors of a tree with their names in Autoware."""
    entries = []
    for lidar in job.rig.lidars.values():
        if lidar.frame in tree.frames:
            entries.append(_below_kit(robot, job, lidar.frame) or _housing(lidar.frame, lidar.model))
    for name, camera in job.rig.cameras.items():
        if camera.frame in tree.frames:
            key = camera.frame if "/" in camera.frame else f"{name}/camera_link"
            own = _Entry(key, camera.frame, np.eye(4))
            entries.append(_below_kit(robot, job, camera.frame) or own)
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


def _housing(frame: str, model: str) -> _Entry:
    """Name the base of a LiDAR's housing, where its description is known to begin."""
    height_m = next((m for name, m in _CENTRE_M.items() if model.upper().startswith(name)), None)
    if frame.endswith("_base_link") or height_m is None:
        return _Entry(frame, frame, np.eye(4))
    return _Entry(f"{frame}_base_link", frame, pose(np.eye(3), np.array([0.0, 0.0, height_m])))


def _kit(tree: FrameTree, robot: RobotTree, entries: list[_Entry]) -> Array:
    if KIT in tree.frames:
        return robot.find_pose(tree.root, KIT)
    first = min(entries, key=lambda entry: len(robot.chain(entry.frame)))
    return robot.find_pose(tree.root, first.frame) @ invert(first.T_key_frame)


def _in(T_root_kit: Array, robot: RobotTree, tree: FrameTree, entry: _Entry) -> Array:
    T_root_key = robot.find_pose(tree.root, entry.frame) @ invert(entry.T_key_frame)
    return np.asarray(invert(T_root_kit) @ T_root_key)


def _text(
    what: str, root: str, poses: Mapping[str, Array], entries: "list[_Entry] | tuple[()]", job: ExportJob
) -> str:
    lines = [f"# {line}" for line in header(what, job.rig, job.chosen)]
    for entry in entries:
        lines.append(f"# {entry.key}: {_described(entry)}")
    lines.append(f"{root}:")
    for frame, T in poses.items():
        values = (*T[:3, 3], *rpy(T[:3, :3]))
        lines.append(f"  {quoted(frame)}:")
        lines += [f"    {key}: {number(value)}" for key, value in zip(_KEYS, values, strict=True)]
    return "\n".join(lines) + "\n"


def _described(entry: _Entry) -> str:
    if entry.key == entry.frame:
        return "the frame of the profile"
    x, y, z = entry.T_key_frame[:3, 3]
    if np.allclose(entry.T_key_frame, np.eye(4)):
        return f"{entry.frame} of the profile"
    return f"{entry.frame} lies at ({x:.4f}, {y:.4f}, {z:.4f}) m in it, as its description must say"


@reads_back
def _check(path: Path, tree: FrameTree, entries: list[_Entry], job: ExportJob) -> None:
    frames = {entry.frame: read_block(path, KIT)[entry.key] @ entry.T_key_frame for entry in entries}
    optical = {}
    for joint in tree.joints:
        if joint.parent in frames:
            optical[joint.child] = joint.T_parent_child
    for calibration in job.chosen:
        camera, lidar = job.rig.cameras[calibration.camera], job.rig.lidars[calibration.lidar].frame
        if (calibration.camera, calibration.lidar) in tree.pairs:
            T_body_optical = optical.get(camera.optical_frame, T_BODY_OPTICAL)
            T_cam_lidar = invert(frames[camera.frame] @ T_body_optical) @ frames[lidar]
            check_pose(path, f"{lidar} to {camera.frame}", T_cam_lidar, calibration, job.rig)


@reads_back
def _check_base(path: Path, T_base_kit: Array) -> None:
    if not np.allclose(read_block(path, BASE)[KIT], T_base_kit, rtol=0, atol=1e-9):
        raise LceRigError(f"{path}: reads back differently")


@reads_back
def read_block(path: Path, root: str) -> dict[str, Array]:
    """Read the poses (4, 4) of the frames below one from a file of Autoware's.

    Raises:
        LceRigError: it has no such frame, or is damaged.
    """
    import yaml

    poses = {}
    for frame, block in yaml.safe_load(path.read_text(encoding="utf-8"))[root].items():
        x, y, z, *angles = (float(block[key]) for key in _KEYS)
        poses[frame] = pose(rotation_from_rpy(np.array(angles)), np.array([x, y, z]))
    return poses
