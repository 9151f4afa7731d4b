"""sensor_kit_calibration.yaml: joint origins under one frame, as Autoware's sensor kits read them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lce_rig.core.geometry import Array, invert, pose
from lce_rig.core.results import Calibration
from lce_rig.export.files import header, number, quoted, reads_back
from lce_rig.export.frames import T_BODY_OPTICAL, FrameTree, build_trees, choose_channels
from lce_rig.export.probes import check_pose
from lce_rig.export.rotations import rotation_from_rpy, rpy
from lce_rig.rig import Rig
from lce_rig.session.durable import write_atomically

FILE_NAME = "sensor_kit_calibration.yaml"
_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")


def export_autoware(calibrations: Sequence[Calibration], rig: Rig, folder: Path) -> list[Path]:
    """Write sensor_kit_calibration.yaml, each sensor's pose in its tree's root, and read it back.

    Raises:
        LceRigError: the file reads back differently.
    """
    chosen = choose_channels(calibrations, rig)
    trees = build_trees(calibrations, rig)
    lines = [f"# {line}" for line in header("Autoware sensor kit calibration", rig, chosen)]
    lines += [
        "# poses of the sensors in the frame above them; camera frames are bodies (x forward), not optical"
    ]
    for tree in trees:
        lines += _block(tree)
    path = folder / FILE_NAME
    write_atomically(path, "\n".join(lines) + "\n")
    _check(path, trees, chosen, rig)
    return [path]


def _block(tree: FrameTree) -> list[str]:
    lines = [f"{quoted(tree.root)}:"]
    poses = {tree.root: np.eye(4)}
    for joint in tree.joints:
        poses[joint.child] = poses[joint.parent] @ joint.T_parent_child
        if not joint.is_optical:
            T = poses[joint.child]
            values = (*T[:3, 3], *rpy(T[:3, :3]))
            lines.append(f"  {quoted(joint.child)}:")
            lines += [f"    {key}: {number(value)}" for key, value in zip(_KEYS, values, strict=True)]
    return lines


@reads_back
def _check(path: Path, trees: Sequence[FrameTree], chosen: Sequence[Calibration], rig: Rig) -> None:
    import yaml

    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    for tree in trees:
        poses: dict[str, Array] = {tree.root: np.eye(4)}
        for frame, block in data[tree.root].items():
            x, y, z, *angles = (float(block[key]) for key in _KEYS)
            poses[frame] = pose(rotation_from_rpy(np.array(angles)), np.array([x, y, z]))
        joined = {frozenset((joint.parent, joint.child)) for joint in tree.joints}
        for calibration in chosen:
            camera, lidar = rig.cameras[calibration.camera].frame, rig.lidars[calibration.lidar].frame
            if frozenset((camera, lidar)) in joined:
                T_cam_lidar = invert(poses[camera] @ T_BODY_OPTICAL) @ poses[lidar]
                check_pose(path, f"{lidar} to {camera}", T_cam_lidar, calibration, rig)
