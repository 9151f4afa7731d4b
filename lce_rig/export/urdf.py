"""URDF: calibrated sensors as links and fixed joints, in a separate file or in the robot's.

The robot's tree of frames is read from its URDF or from a recording. An edited URDF keeps its comments, its
order and everything else.
"""

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from lce_rig.core.bounds import MAX_BYTES
from lce_rig.core.calibration import MADE_BY, Calibration
from lce_rig.core.errors import SessionError, SourceError, reading
from lce_rig.core.geometry import pose
from lce_rig.export import ExportJob
from lce_rig.export.robot_tree import Joint, JointChange, RobotTree, fit_tree
from lce_rig.export.writing import number, rpy
from lce_rig.rig import Rig
from lce_rig.session.durable import write_atomically

_TF_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
# Tolerance of a quaternion's norm, far above the rounding of ROS's float64; more is not a rotation.
_UNIT_TOLERANCE = 1e-3
_ORIGIN = re.compile(rb"""<origin\b(?:[^>"']|"[^"]*"|'[^']*')*>""")
_TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")


def export_urdf(job: ExportJob) -> list[Path]:
    """Write RIG.urdf for robot_state_publisher, and RIG-ROOT.urdf for sensors not connected with the base."""
    names = [f"-{tree.root.replace('/', '_')}" if index else "" for index, tree in enumerate(job.trees)]
    return [
        job.write(f"{job.rig.name}{name}.urdf", _urdf(tree, job))
        for name, tree in zip(names, job.trees, strict=True)
    ]


def _urdf(tree: RobotTree, job: ExportJob) -> list[str]:
    lines = ['<?xml version="1.0" encoding="utf-8"?>']
    # A double hyphen would end an XML comment early. ROS 2 reads a parameter's value as YAML, in which ": "
    # makes a mapping: `robot_description:="$(cat rig.urdf)"` would be refused.
    head = job.head("URDF", *job.calibrations)
    lines += [f"<!-- {line.replace('--', '- -').replace(': ', ' - ')} -->" for line in head]
    lines.append(f"<robot name={quoteattr(job.rig.name)}>")
    lines += [f"  <link name={quoteattr(frame)}/>" for frame in (tree.root, *tree.above)]
    lines += [line for joint in tree.above.values() for line in joint_lines(joint)]
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
    xyz = " ".join(number(value) for value in joint.T_parent_child[:3, 3])
    turn = " ".join(number(value) for value in rpy(joint.T_parent_child[:3, :3]))
    return f'<origin xyz="{xyz}" rpy="{turn}"/>'


def read_robot(path: Path) -> RobotTree:
    """Read a robot's tree from its URDF, or from the static transforms of a recording.

    Raises:
        SessionError: the file cannot be read, or its frames are not a tree.
        SourceError: the recording cannot be read or has no static transforms.
    """
    if path.suffix.lower() in (".urdf", ".xml", ".xacro"):
        return read_robot_urdf(path)
    return read_robot_bag(path)


def read_robot_bag(path: Path) -> RobotTree:
    """Read the transforms on /tf_static of a ROS 1 bag, a ROS 2 bag or an mcap file.

    The last of several transforms to one frame counts, as in tf.

    Raises:
        SourceError: the bag cannot be read, is damaged, or has no static transforms.
        SessionError: a frame has two parents, or the frames make a loop; or a transform is not rigid.
    """
    from lce_rig.io.ros.bag_file import BagFile, list_topics
    from lce_rig.io.ros.messages import deserialize

    bag = BagFile(path)
    topics = [
        topic for topic, (kind, _) in bag.topics.items() if topic.endswith("tf_static") and kind in _TF_TYPES
    ]
    joints: dict[tuple[str, str], Joint] = {}
    for message in bag.messages(topics):
        with reading(path):
            transforms = deserialize(message).transforms
        for stamped in transforms:
            # tf names start with a slash, tf2 names do not.
            frames = stamped.header.frame_id.removeprefix("/"), stamped.child_frame_id.removeprefix("/")
            t, q = stamped.transform.translation, stamped.transform.rotation
            xyz, xyzw = np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w])
            if not (np.isfinite(xyz).all() and abs(np.linalg.norm(xyzw) - 1) < _UNIT_TOLERANCE):
                raise SessionError(f"{path}: the static transform to {frames[1]} is not rigid")
            joints.pop(frames, None)
            joints[frames] = Joint(*frames, pose(Rotation.from_quat(xyzw).as_matrix(), xyz))
    if not joints:
        raise SourceError(f"{path} has no static transforms (/tf_static)", list_topics(bag.topics))
    return RobotTree.of_joints(str(path), [*joints.values()], has_one_root=False)


def read_robot_urdf(path: Path) -> RobotTree:
    """Read a robot's tree of frames from its URDF.

    Raises:
        SessionError: the file cannot be read or is not a URDF; xacro has to be expanded first.
    """
    return _parse(path, _read(path))


def _read(path: Path) -> bytes:
    with reading(path, SessionError, most_bytes=MAX_BYTES):
        return path.read_bytes()


def _parse(path: Path, text: bytes) -> RobotTree:
    if b"xacro:" in text or b"${" in text:
        hint = f"Expand it first: `xacro {path.name} > robot.urdf`. Then copy the figures back by hand."
        raise SessionError(f"{path} is xacro, not URDF", hint)
    joints = []
    with reading(path, SessionError, "Give the robot's URDF."):
        robot = ElementTree.fromstring(text)
        if robot.tag != "robot" or b"\0" in text:
            raise ValueError("it is not a URDF in UTF-8")
        links = [link.attrib["name"] for link in robot.iterfind("link")]
        for joint in robot.iterfind("joint"):
            name = joint.attrib["name"]
            parent, child = (
                element.attrib["link"] for end in ("parent", "child") for element in joint.findall(end)
            )
            element = joint.find("origin")
            figures = {} if element is None else element.attrib
            xyz, angles = (np.array(figures.get(key, "0 0 0").split(), np.float64) for key in ("xyz", "rpy"))
            if not (xyz.shape == angles.shape == (3,) and np.isfinite([xyz, angles]).all()):
                raise ValueError(f"the origin of joint {name} is not six finite numbers")
            T = pose(Rotation.from_euler("xyz", angles).as_matrix(), xyz)
            joints.append(Joint(parent, child, T, joint.attrib["type"] == "fixed", name))
    return RobotTree.of_joints(str(path), joints, links)


def write_into_urdf(
    path: Path, calibrations: Sequence[Calibration], rig: Rig, now: datetime
) -> tuple[Path | None, list[JointChange]]:
    """Replace or add the joints of calibrated sensors in a robot's URDF; a backup of it is kept.

    Args:
        path: the robot's URDF, replaced in one step; for a link, the file that it leads to.
        calibrations: calibrations of the rig's sensors.
        rig: the profile, which names the frames.
        now: time in the backup's name, path.urdf.2026-11-22T101500.bak.

    Returns:
        The file with the earlier text, None if nothing had to change, and the joints that are new or moved.

    Raises:
        SessionError: the file is not a URDF, does not fit (`fit_tree`), or cannot be written. It is
            unchanged.
    """
    before = _read(path)
    tree = _parse(path, before)
    _, changes, _ = fit_tree(tree, calibrations, rig)
    changes = [change for change in changes if change.is_real]
    if not changes:
        return None, []
    after = _edited(before, changes, tree)
    path = path.resolve()
    backup = path.with_name(f"{path.name}.{now:%Y-%m-%dT%H%M%S}.bak")
    while backup.exists():  # a second one within the same second
        backup = backup.with_name(f"{backup.name.removesuffix('.bak')}+.bak")
    write_atomically(backup, before)
    write_atomically(path, after)
    return backup, changes


def _edited(text: bytes, changes: Sequence[JointChange], tree: RobotTree) -> bytes:
    """Change the origins of joints, and add new ones before the end of the robot."""
    places = _find_joints(text)
    edits = []
    added = []
    for change in changes:
        joint = change.joint
        if joint.child in tree.above:
            start, end = places[tree.above[joint.child].name]
            # An <origin> inside a comment does not count.
            blanked = re.sub(
                rb"<!--.*?-->", lambda comment: b" " * len(comment.group()), text[start:end], flags=re.S
            )
            old, new = _ORIGIN.search(blanked), origin(joint).encode()
            if old is None:
                tag = _TAG.match(blanked)
                assert tag is not None
                edits.append((start + tag.end(), start + tag.end(), b"\n    " + new))
            else:
                if not old.group().endswith(b"/>"):
                    new = new.removesuffix(b"/>") + b">"
                edits.append((start + old.start(), start + old.end(), new))
        else:
            added += [f"  <link name={quoteattr(joint.child)}/>", *joint_lines(joint)]
    if added:
        end = text.rindex(b"</robot")
        lines = [f"  <!-- added by {MADE_BY} -->", *added]
        # Character references are valid in any encoding that the file declares.
        edits.append((end, end, ("\n".join(lines) + "\n").encode("ascii", "xmlcharrefreplace")))
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


def _find_joints(text: bytes) -> dict[str, tuple[int, int]]:
    """Find the first and last byte of each joint of the robot, by name."""
    parser = expat.ParserCreate()
    depth, begun, places = 0, ("", 0), {}

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, begun
        depth += 1
        if tag == "joint" and depth == 2:
            begun = attributes["name"], parser.CurrentByteIndex

    def end(tag: str) -> None:
        nonlocal depth
        if tag == "joint" and depth == 2:
            places[begun[0]] = begun[1], parser.CurrentByteIndex
        depth -= 1

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(text, True)
    return places
