"""URDF: LiDAR, camera body and optical frame as links, the calibration as fixed joints."""

from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import pose
from lce_rig.export.files import header, number, reads_back
from lce_rig.export.frames import RPY_BODY_OPTICAL, FrameTree, Joint
from lce_rig.export.job import ExportJob
from lce_rig.export.robot_tree import RobotJoint, RobotTree, check_frames
from lce_rig.export.rotations import rotation_from_rpy, rpy
from lce_rig.session.durable import write_atomically


def export_urdf(job: ExportJob) -> list[Path]:
    """Write RIG.urdf, and RIG-ROOT.urdf for sensors not connected with the base, and read them back.

    Raises:
        LceRigError: a file is not a tree or reads back differently.
    """
    paths = []
    for index, tree in enumerate(job.trees):
        suffix = f"-{tree.root.replace('/', '_')}" if index else ""
        paths.append(write_urdf(job.folder / f"{job.rig.name}{suffix}.urdf", tree, job))
    return paths


def write_urdf(path: Path, tree: FrameTree, job: ExportJob) -> Path:
    """Write a tree as a URDF and check it by reading it back.

    Raises:
        LceRigError: the file is not a tree or reads back differently.
    """
    write_atomically(path, _text(tree, header("URDF", job.rig, job.chosen), job.rig.name))
    _check(path, tree, job)
    return path


def _text(tree: FrameTree, head: list[str], name: str) -> str:
    lines = ['<?xml version="1.0" encoding="utf-8"?>']
    # A double hyphen would end an XML comment early. ROS 2 reads a parameter's value as YAML, in which ": "
    # makes a mapping: `robot_description:="$(cat rig.urdf)"` would be refused.
    lines += [f"<!-- {line.replace('--', '- -').replace(': ', ' - ')} -->" for line in head]
    lines.append(f"<robot name={quoteattr(name)}>")
    lines += [f"  <link name={quoteattr(frame)}/>" for frame in tree.frames]
    lines += [line for joint in tree.joints for line in joint_lines(joint)]
    return "\n".join([*lines, "</robot>"]) + "\n"


def joint_lines(joint: Joint) -> list[str]:
    """Write a fixed joint."""
    return [
        f'  <joint name={quoteattr(f"{joint.parent}_to_{joint.child}")} type="fixed">',
        f"    <parent link={quoteattr(joint.parent)}/>",
        f"    <child link={quoteattr(joint.child)}/>",
        f"    {origin(joint)}",
        "  </joint>",
    ]


def origin(joint: Joint) -> str:
    """Write the origin of a joint."""
    angles = RPY_BODY_OPTICAL if joint.is_optical else rpy(joint.T_parent_child[:3, :3])
    xyz = " ".join(number(value) for value in joint.T_parent_child[:3, 3])
    turn = " ".join(number(value) for value in angles)
    return f'<origin xyz="{xyz}" rpy="{turn}"/>'


@reads_back
def read_urdf(path: Path) -> RobotTree:
    """Read a URDF of fixed joints.

    Raises:
        LceRigError: not XML, or not one tree.
    """
    try:
        robot = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    except ElementTree.ParseError as error:
        raise LceRigError(f"{path}: not XML: {error}") from error
    links = [link.attrib["name"] for link in robot.findall("link")]
    joints = []
    for joint in robot.findall("joint"):
        parent, child = (joint.find(end).attrib["link"] for end in ("parent", "child"))  # type: ignore[union-attr]
        origin = joint.find("origin")
        text = {} if origin is None else origin.attrib
        xyz, angles = (np.array(text.get(key, "0 0 0").split(), dtype=np.float64) for key in ("xyz", "rpy"))
        joints.append((child, RobotJoint(parent, pose(rotation_from_rpy(angles), xyz))))
    return RobotTree.of_joints(str(path), joints, links)


@reads_back
def _check(path: Path, tree: FrameTree, job: ExportJob) -> None:
    read = read_urdf(path)
    if read.frames != set(tree.frames):
        raise LceRigError(f"{path}: links {sorted(read.frames)} read back, {sorted(tree.frames)} written")
    check_frames(path, "", read, [tree], job.chosen, job.rig)
