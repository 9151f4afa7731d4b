"""Frames and fixed joints, and the check that they make a tree."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, pose
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
        is_given: whether the robot's own tree has it like this already.
    """

    parent: str
    child: str
    T_parent_child: Array
    is_optical: bool = False
    is_given: bool = False


@dataclass(frozen=True, eq=False)
class FrameTree:
    """Frames under one root.

    Attributes:
        joints: parents first.
        pairs: (camera, LiDAR) of the calibrations that the joints express; others close a loop.
    """

    root: str
    joints: tuple[Joint, ...]
    pairs: frozenset[tuple[str, str]]

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames, the root first."""
        return (self.root, *(joint.child for joint in self.joints))


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


def check_tree(links: Sequence[str], joints: Iterable[tuple[str, str]], *, has_one_root: bool = True) -> None:
    """Check that links and (parent, child) joints make a tree, which no available URDF parser does.

    Args:
        links: names.
        joints: between them.
        has_one_root: whether it has to be one tree; else several, as static transforms make where others
            change while the robot drives.

    Raises:
        LceRigError: no link, a name twice, an unknown link, two parents, several roots, or a loop.
    """
    if not links:
        raise LceRigError("no links")
    twice = sorted(link for link, count in Counter(links).items() if count > 1)
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
    if has_one_root and len(roots) > 1:
        raise LceRigError(f"several roots: {', '.join(roots)}")
    for link in links:
        seen = [link]
        while seen[-1] in parents:
            seen.append(parents[seen[-1]])
            if seen[-1] in seen[:-1]:
                raise LceRigError(f"a loop: {' < '.join(seen)}")
