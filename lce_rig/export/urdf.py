"""URDF: LiDAR, camera body and optical frame as links, the calibration as fixed joints."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, invert, pose
from lce_rig.core.results import Calibration
from lce_rig.export.files import header, number, reads_back
from lce_rig.export.frames import RPY_BODY_OPTICAL, FrameTree, Joint, build_trees, check_tree, choose_channels
from lce_rig.export.probes import check_pose
from lce_rig.export.rotations import rotation_from_rpy, rpy
from lce_rig.rig import Rig
from lce_rig.session.durable import write_atomically


def export_urdf(calibrations: Sequence[Calibration], rig: Rig, folder: Path) -> list[Path]:
    """Write RIG.urdf, and RIG-ROOT.urdf for sensors not connected with the base, and read them back.

    Raises:
        LceRigError: a file is not a tree or reads back differently.
    """
    chosen = choose_channels(calibrations, rig)
    paths = []
    for index, tree in enumerate(build_trees(calibrations, rig)):
        suffix = f"-{tree.root.replace('/', '_')}" if index else ""
        path = folder / f"{rig.name}{suffix}.urdf"
        write_atomically(path, _text(tree, header("URDF", rig, chosen), rig.name))
        _check(path, tree, chosen, rig)
        paths.append(path)
    return paths


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
def read_urdf(path: Path) -> dict[str, Array]:
    """Read the pose T_root_link (4, 4) of each link from a URDF of fixed joints.

    Raises:
        LceRigError: not XML, or not one tree.
    """
    try:
        robot = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    except ElementTree.ParseError as error:
        raise LceRigError(f"{path}: not XML: {error}") from error
    links = [link.attrib["name"] for link in robot.findall("link")]
    steps: dict[str, tuple[str, Array]] = {}
    pairs = []
    for joint in robot.findall("joint"):
        parent, child = (joint.find(end).attrib["link"] for end in ("parent", "child"))  # type: ignore[union-attr]
        origin = joint.find("origin")
        text = {} if origin is None else origin.attrib
        xyz, angles = (np.array(text.get(key, "0 0 0").split(), dtype=np.float64) for key in ("xyz", "rpy"))
        pairs.append((parent, child))
        steps[child] = parent, pose(rotation_from_rpy(angles), xyz)
    try:
        check_tree(links, pairs)
    except LceRigError as error:
        raise LceRigError(f"{path}: not one tree: {error.what}") from error
    return {link: _from_root(link, steps) for link in links}


def _from_root(link: str, steps: dict[str, tuple[str, Array]]) -> Array:
    T = np.eye(4)
    while link in steps:
        link, T_parent_child = steps[link]
        T = T_parent_child @ T
    return T


@reads_back
def _check(path: Path, tree: FrameTree, chosen: Sequence[Calibration], rig: Rig) -> None:
    poses = read_urdf(path)
    if set(poses) != set(tree.frames):
        raise LceRigError(f"{path}: links {sorted(poses)} read back, {sorted(tree.frames)} written")
    joined = {frozenset((joint.parent, joint.child)) for joint in tree.joints}
    for calibration in chosen:
        camera, lidar = rig.cameras[calibration.camera], rig.lidars[calibration.lidar]
        # The tree omits a pair that closes a loop; the file does not mention it.
        if frozenset((camera.frame, lidar.frame)) in joined:
            T_cam_lidar = invert(poses[camera.optical_frame]) @ poses[lidar.frame]
            check_pose(
                path, f"the chain {lidar.frame} to {camera.optical_frame}", T_cam_lidar, calibration, rig
            )
