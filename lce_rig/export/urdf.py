"""URDF: LiDAR, camera body and optical frame as links, the calibration as fixed joints.

References:
    https://nvidia-isaac-ros.github.io/robots/isaac_urdf_requirements (base_link; body and optical frames)
"""

from pathlib import Path
from xml.sax.saxutils import quoteattr

from lce_rig.export.files import number
from lce_rig.export.findings import NO_FRAME
from lce_rig.export.job import ExportJob
from lce_rig.export.robot_tree import FrameTree, Joint
from lce_rig.export.rotations import RPY_BODY_OPTICAL, rpy

_ISAAC_FILE, _ISAAC_BASE = "isaac_calibration.urdf", "base_link"


def export_urdf(job: ExportJob) -> list[Path]:
    """Write RIG.urdf, and RIG-ROOT.urdf for sensors not connected with the base."""
    names = [f"-{tree.root.replace('/', '_')}" if index else "" for index, tree in enumerate(job.trees)]
    return [
        job.write(f"{job.rig.name}{name}.urdf", _urdf(tree, job))
        for name, tree in zip(names, job.trees, strict=True)
    ]


def export_isaac(job: ExportJob) -> list[Path]:
    """Write isaac_calibration.urdf, the tree below base_link, for Isaac's /etc/nova/calibration."""
    paths = []
    for tree in job.trees:
        if tree.root == _ISAAC_BASE:
            paths.append(job.write(_ISAAC_FILE, _urdf(tree, job)))
        else:
            finding = NO_FRAME(tree.root, format="isaac", file=_ISAAC_FILE, frame=_ISAAC_BASE, root=tree.root)
            job.findings.append(finding)
    return paths


def _urdf(tree: FrameTree, job: ExportJob) -> list[str]:
    lines = ['<?xml version="1.0" encoding="utf-8"?>']
    # A double hyphen would end an XML comment early. ROS 2 reads a parameter's value as YAML, in which ": "
    # makes a mapping: `robot_description:="$(cat rig.urdf)"` would be refused.
    head = job.head("URDF", *job.chosen)
    lines += [f"<!-- {line.replace('--', '- -').replace(': ', ' - ')} -->" for line in head]
    lines.append(f"<robot name={quoteattr(job.rig.name)}>")
    lines += [f"  <link name={quoteattr(frame)}/>" for frame in tree.frames]
    lines += [line for joint in tree.joints for line in joint_lines(joint)]
    return [*lines, "</robot>"]


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
