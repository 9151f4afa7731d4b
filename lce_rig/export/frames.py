"""The tree of frames for URDF and static transforms, and the check that it is a tree."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, invert, pose
from lce_rig.core.results import Calibration
from lce_rig.rig import Rig

# REP-103: z forward, x right, y down in the optical frame; x forward, y left, z up in the camera's own.
R_BODY_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
T_BODY_OPTICAL = pose(R_BODY_OPTICAL, np.zeros(3))
RPY_BODY_OPTICAL = (-np.pi / 2, 0.0, -np.pi / 2)

_VERDICTS = ("pass", "marginal", "fail")


@dataclass(frozen=True, eq=False)
class Joint:
    """A fixed joint.

    Attributes:
        T_parent_child: (4, 4), the child's pose in the parent's frame.
        is_optical: whether it is the rotation from a camera's body to its optical frame.
    """

    parent: str
    child: str
    T_parent_child: Array
    is_optical: bool = False


@dataclass(frozen=True, eq=False)
class FrameTree:
    """Frames under one root, joints listed parents first."""

    root: str
    joints: tuple[Joint, ...]

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames, the root first."""
        return (self.root, *(joint.child for joint in self.joints))


def build_trees(calibrations: Sequence[Calibration], rig: Rig) -> list[FrameTree]:
    """Connect all calibrated sensors to the rig's root frame; unconnected ones form other trees.

    The tree that holds the sensor of the profile's `mount` hangs from the robot's frame.
    Each camera has one pose; of several channels the one from `choose_channels` is used.

    Raises:
        LceRigError: a calibration names a sensor that the rig does not have.
    """
    chosen = choose_channels(calibrations, rig)
    bodies = {name: lidar.frame for name, lidar in rig.lidars.items()}
    bodies |= {name: camera.frame for name, camera in rig.cameras.items()}
    used = [name for name in bodies if any(name in (c.camera, c.lidar) for c in chosen)]
    used.sort(key=lambda name: bodies[name] != rig.root_frame)
    optical = {camera.frame: camera.optical_frame for camera in rig.cameras.values()}
    trees: list[FrameTree] = []
    placed: set[str] = set()
    for name in used:
        if name not in placed:
            joints = _grow(name, chosen, bodies, placed)
            frames = [bodies[name], *(joint.child for joint in joints)]
            joints += [Joint(f, optical[f], T_BODY_OPTICAL, is_optical=True) for f in frames if f in optical]
            root = bodies[name]
            if rig.mount is not None and rig.mount.of == root:
                joints.insert(0, Joint(rig.mount.parent, root, rig.mount.to_matrix()))
                root = rig.mount.parent
            trees.append(FrameTree(root, tuple(joints)))
    return trees


def _grow(root: str, chosen: list[Calibration], bodies: dict[str, str], placed: set[str]) -> list[Joint]:
    """Walk breadth first from one sensor to all that calibrations connect it with."""
    joints: list[Joint] = []
    placed.add(root)
    queue = [root]
    while queue:
        here = queue.pop(0)
        for calibration in chosen:
            T_lidar_camera = invert(calibration.T_cam_lidar) @ invert(T_BODY_OPTICAL)
            for parent, child, T in (
                (calibration.lidar, calibration.camera, T_lidar_camera),
                (calibration.camera, calibration.lidar, invert(T_lidar_camera)),
            ):
                if parent == here and child not in placed:
                    joints.append(Joint(bodies[parent], bodies[child], T))
                    placed.add(child)
                    queue.append(child)
    return joints


def choose_channels(calibrations: Sequence[Calibration], rig: Rig) -> list[Calibration]:
    """Keep one calibration of each camera and LiDAR: by verdict, then by the smaller sigma.

    Raises:
        LceRigError: a calibration names a sensor or channel that the rig does not have.
    """
    best: dict[tuple[str, str], Calibration] = {}
    ranks: dict[tuple[str, str], tuple[int, float, float]] = {}
    for calibration in calibrations:
        require_known(calibration, rig)
        pair = calibration.camera, calibration.lidar
        sigmas = calibration.sigma_rotation_deg, calibration.sigma_translation_m
        rank = _VERDICTS.index(calibration.verdict), *sigmas
        if pair not in best or rank < ranks[pair]:
            best[pair], ranks[pair] = calibration, rank
    return list(best.values())


def require_known(calibration: Calibration, rig: Rig) -> None:
    """Check that a calibration names sensors of the rig.

    Raises:
        LceRigError: a sensor or channel that the rig does not have.
    """
    camera = rig.cameras.get(calibration.camera)
    is_known = camera is not None and set(calibration.channels) <= set(camera.channels)
    if not is_known or calibration.lidar not in rig.lidars:
        pair = f"{calibration.camera}/{calibration.channel} and {calibration.lidar}"
        what = f"the result is for {pair}, which rig {rig.name} does not have"
        raise LceRigError(what, "Use the profile that the session was made with.")


def check_tree(links: Sequence[str], joints: Iterable[tuple[str, str]]) -> None:
    """Check that links and (parent, child) joints make one tree, which no available URDF parser does.

    Raises:
        LceRigError: no link, a name twice, an unknown link, two parents, several roots, or a loop.
    """
    if not links:
        raise LceRigError("no links")
    twice = sorted({link for link in links if list(links).count(link) > 1})
    if twice:
        raise LceRigError(f"link {twice[0]} is defined twice")
    parents: dict[str, str] = {}
    for parent, child in joints:
        for link in (parent, child):
            if link not in links:
                raise LceRigError(f"a joint names link {link}, which is not defined")
        if child in parents:
            raise LceRigError(f"link {child} has two parents, {parents[child]} and {parent}")
        parents[child] = parent
    roots = [link for link in links if link not in parents]
    if len(roots) > 1:
        raise LceRigError(f"several roots: {', '.join(roots)}")
    for link in links:
        seen = [link]
        while seen[-1] in parents:
            seen.append(parents[seen[-1]])
            if seen[-1] in seen[:-1]:
                raise LceRigError(f"a loop: {' < '.join(seen)}")
