"""Write calibrations into a robot's own URDF, which keeps its comments, its order and everything else."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from lce_rig.core.calibration import MADE_BY, Calibration
from lce_rig.core.errors import SessionError, SourceError, reading
from lce_rig.export.frames import Joint, choose_channels
from lce_rig.export.probes import check_pose
from lce_rig.export.robot_tree import JointChange, RobotJoint, RobotTree, fit_tree
from lce_rig.export.urdf import joint_lines, origin
from lce_rig.rig import Rig
from lce_rig.session.durable import write_atomically

_MOST_BYTES = 64 * 2**20
_ORIGIN = re.compile(rb"""<origin\b(?:[^>"']|"[^"]*"|'[^']*')*>""")
_TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")


def read_robot_urdf(path: Path) -> RobotTree:
    """Read a robot's tree of frames by yourdfpy.

    Raises:
        SessionError: the file cannot be read or is no URDF; xacro has to be expanded first.
        SourceError: yourdfpy is not installed.
    """
    return _parse(path, _text(path))


def _parse(path: Path, text: bytes) -> RobotTree:
    try:
        from yourdfpy import URDF
    except ImportError as error:
        what = "reading a robot's URDF needs the package yourdfpy"
        raise SourceError(what, "pip install 'lce-rig[urdf]'") from error
    if b"xacro:" in text or b"${" in text:
        hint = f"Expand it first: `xacro {path.name} > robot.urdf`. Then copy the figures back by hand."
        raise SessionError(f"{path} is xacro, not URDF", hint)
    try:
        _find_joints(text)  # yourdfpy guesses where XML is damaged.
        robot: Any = URDF.load(
            BytesIO(text), build_scene_graph=False, load_meshes=False, mesh_dir=str(path.parent)
        )
    except Exception as error:  # yourdfpy and lxml raise whatever they meet
        said = " ".join(str(error).split())[:160]
        raise SessionError(f"{path} is not a URDF: {said}") from error
    joints = []
    for name, joint in robot.joint_map.items():
        T = np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=np.float64)
        joints.append((joint.child, RobotJoint(joint.parent, T, joint.type == "fixed", name)))
    return RobotTree.of_joints(str(path), joints, robot.link_map)


def _text(path: Path) -> bytes:
    with reading(path, SessionError):
        if path.stat().st_size > _MOST_BYTES:
            raise SessionError(f"{path} is larger than a URDF ever is ({_MOST_BYTES >> 20} MB)")
        return path.read_bytes()


@dataclass(frozen=True, eq=False)
class UrdfUpdate:
    """What was written into a robot's URDF.

    Attributes:
        path: the URDF.
        backup: its earlier text; None where nothing had to change.
        changes: the joints that are new or moved.
    """

    path: Path
    backup: Path | None
    changes: tuple[JointChange, ...]


def write_into_urdf(path: Path, calibrations: Sequence[Calibration], rig: Rig, now: datetime) -> UrdfUpdate:
    """Replace or add the joints of calibrated sensors in a robot's URDF; its earlier text stays beside it.

    Args:
        path: the robot's URDF.
        calibrations: of the rig's sensors.
        rig: the profile, which names the frames.
        now: names the backup, path.urdf.2026-11-22T101500.bak.

    Raises:
        SessionError: it is not a URDF, does not fit (`fit_tree`), or cannot be written; it is unchanged.
        LceRigError: the new text reads back differently; the file is unchanged.
    """
    before = _text(path)
    tree = _parse(path, before)
    changes = [change for change in fit_tree(tree, calibrations, rig).changes if change.is_real]
    if not changes:
        return UrdfUpdate(path, None, ())
    after = _edited(before, changes, tree)
    draft = path.with_name(f".{path.name}.new.urdf")
    write_atomically(draft, after)
    try:
        _check(draft, calibrations, rig)
    except BaseException:
        draft.unlink()
        raise
    backup = path.with_name(f"{path.name}.{now:%Y-%m-%dT%H%M%S}.bak")
    while backup.exists():  # a second one within the same second
        backup = backup.with_name(f"{backup.name.removesuffix('.bak')}+.bak")
    write_atomically(backup, before)
    draft.replace(path)
    return UrdfUpdate(path, backup, tuple(changes))


def _check(path: Path, calibrations: Sequence[Calibration], rig: Rig) -> None:
    tree = read_robot_urdf(path)
    for c in choose_channels(calibrations, rig):
        optical, lidar = rig.cameras[c.camera].optical_frame, rig.lidars[c.lidar].frame
        check_pose(path, f"the chain {lidar} to {optical}", tree.find_pose(optical, lidar), c, rig)


def _edited(text: bytes, changes: Sequence[JointChange], tree: RobotTree) -> bytes:
    """Change the origins of joints, and add what is new before the end of the robot."""
    places = _find_joints(text)
    edits = []
    added = []
    for change in changes:
        joint = change.joint
        if joint.child in tree.above:
            start, end = places[tree.above[joint.child].name]
            edits.append(_origin_edit(text, start, end, joint))
        else:
            added += [f"  <link name={quoteattr(joint.child)}/>", *joint_lines(joint)]
    if added:
        end = text.rindex(b"</robot")
        lines = [f"  <!-- added by {MADE_BY} -->", *added]
        edits.append((end, end, ("\n".join(lines) + "\n").encode()))
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


def _find_joints(text: bytes) -> dict[str, tuple[int, int]]:
    """Find the first and last byte of each joint below the robot, by its name."""
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


def _origin_edit(text: bytes, start: int, end: int, joint: Joint) -> tuple[int, int, bytes]:
    """Replace the origin of a joint, or put one behind its opening tag; comments are no origins."""
    blanked = re.sub(rb"<!--.*?-->", lambda found: b" " * len(found.group()), text[start:end], flags=re.S)
    found = _ORIGIN.search(blanked)
    if found is None:
        tag = _TAG.match(blanked)
        assert tag is not None
        return start + tag.end(), start + tag.end(), b"\n    " + origin(joint).encode()
    new = origin(joint).encode()
    if not found.group().endswith(b"/>"):
        new = new.removesuffix(b"/>") + b">"
    return start + found.start(), start + found.end(), new
