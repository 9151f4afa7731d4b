"""A robot's own tree of frames, and what has to change in it for calibrations to hold."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.errors import SessionError
from lce_rig.core.geometry import Array, difference, invert, tangent_sizes
from lce_rig.core.results import Calibration
from lce_rig.export.frames import T_BODY_OPTICAL, Joint, choose_channels
from lce_rig.rig import Rig


@dataclass(frozen=True, eq=False)
class RobotJoint:
    """A joint of a robot.

    Attributes:
        parent: the frame above.
        T_parent_child: (4, 4), where a joint that moves stands at zero.
        is_fixed: whether it never moves.
        name: of the joint; "" where joints have none.
    """

    parent: str
    T_parent_child: Array
    is_fixed: bool = True
    name: str = ""


@dataclass(frozen=True, eq=False)
class RobotTree:
    """The frames of a robot.

    Attributes:
        source: the file it was read from, for messages.
        frames: all frames.
        above: the joint of each frame that has a parent.
    """

    source: str
    frames: frozenset[str]
    above: Mapping[str, RobotJoint]

    def chain(self, frame: str) -> list[str]:
        """List a frame and those above it, up to the root."""
        frames = [frame]
        while frames[-1] in self.above:
            frames.append(self.above[frames[-1]].parent)
            if frames[-1] in frames[:-1]:
                raise SessionError(f"{self.source}: the frames above {frame} form a loop")
        return frames

    def find_pose(self, frame_a: str, frame_b: str) -> Array:
        """Compute T_a_b (4, 4) between frames that fixed joints connect.

        Raises:
            SessionError: nothing connects them, or a joint between them moves.
        """
        chain_a, chain_b = self.chain(frame_a), self.chain(frame_b)
        common = next((frame for frame in chain_a if frame in chain_b), None)
        if common is None:
            raise SessionError(f"{self.source}: nothing connects {frame_a} and {frame_b}")
        return invert(self._from(common, chain_a)) @ self._from(common, chain_b)

    def _from(self, ancestor: str, chain: Sequence[str]) -> Array:
        """Compute the pose of a chain's first frame in one above it."""
        T = np.eye(4)
        for frame in chain[: chain.index(ancestor)]:
            joint = self.above[frame]
            if not joint.is_fixed:
                raise SessionError(
                    f"{self.source}: joint {joint.name} above {frame} moves",
                    "Extrinsics hold between sensors that are fixed to each other.",
                )
            T = joint.T_parent_child @ T
        return T

    def with_joint(self, joint: Joint) -> "RobotTree":
        """Set the pose of a frame in its parent, or add the frame."""
        old = self.above.get(joint.child)
        new = RobotJoint(joint.parent, joint.T_parent_child, name=old.name if old else "")
        return replace(self, frames=self.frames | {joint.child}, above={**self.above, joint.child: new})


@dataclass(frozen=True, eq=False)
class JointChange:
    """A joint that is new, or that has another pose.

    Attributes:
        joint: as it is to be.
        before: T_parent_child (4, 4) of the robot's own; None for a new joint.
    """

    joint: Joint
    before: Array | None

    @property
    def is_real(self) -> bool:
        """Whether it is more than rounding."""
        return self.before is None or not np.allclose(self.joint.T_parent_child, self.before, atol=1e-9)

    @property
    def moved(self) -> tuple[float, float] | None:
        """By how much, (deg, m); None for a new joint."""
        if self.before is None:
            return None
        angle_rad, distance_m = tangent_sizes(difference(self.joint.T_parent_child, self.before))
        return float(np.degrees(angle_rad)), distance_m


def fit_tree(
    tree: RobotTree, calibrations: Sequence[Calibration], rig: Rig
) -> tuple[RobotTree, list[JointChange]]:
    """Change the joints of a robot's tree so that calibrated sensors lie as the calibrations say.

    The sensor nearest to the root stays. Each other one that the robot has keeps its parent, and only its
    joint's pose changes; one that it lacks is added below the sensor it was calibrated with. An optical frame
    that the robot has stays as it is below its body.

    Args:
        tree: of the robot.
        calibrations: of the rig's sensors; one each of a camera and LiDAR is used.
        rig: the profile, which names the frames.

    Returns:
        The new tree and its changes, parents first.

    Raises:
        SessionError: the robot has none of a calibration's frames, or a joint between two of them moves, or
            a frame would get two parents.
    """
    chosen = choose_channels(calibrations, rig)
    bodies = {name: lidar.frame for name, lidar in rig.lidars.items()}
    bodies |= {name: camera.frame for name, camera in rig.cameras.items()}
    names = [name for name in bodies if any(name in (c.camera, c.lidar) for c in chosen)]
    placed = _anchors(tree, [bodies[name] for name in names])
    changes: list[JointChange] = []
    is_open = True
    while is_open:
        is_open = False
        for calibration in chosen:
            lidar = rig.lidars[calibration.lidar].frame
            camera = rig.cameras[calibration.camera]
            if (lidar in placed) == (camera.frame in placed):
                continue
            tree, optical = _with_optical(tree, camera.frame, camera.optical_frame)
            T_lidar_body = invert(calibration.T_cam_lidar) @ invert(optical.T_parent_child)
            if lidar in placed:
                found = _place(tree, lidar, camera.frame, T_lidar_body)
            else:
                found = _place(tree, camera.frame, lidar, invert(T_lidar_body))
            changes += [JointChange(found, _pose_before(tree, found.child))]
            tree = tree.with_joint(found)
            if camera.optical_frame not in tree.frames:
                changes.append(JointChange(optical, None))
                tree = tree.with_joint(optical)
            placed |= {lidar, camera.frame}
            is_open = True
    return tree, changes


def _anchors(tree: RobotTree, frames: Sequence[str]) -> set[str]:
    """Choose the frame that stays: of those that the robot has, the one nearest to its root."""
    known = [frame for frame in frames if frame in tree.frames]
    if not known:
        raise SessionError(
            f"{tree.source} has none of the sensors' frames: {', '.join(frames)}",
            "Name the robot's frames in the profile (`frame` of each sensor), or set `mount` there.",
        )
    return {min(known, key=lambda frame: len(tree.chain(frame)))}


def _pose_before(tree: RobotTree, frame: str) -> Array | None:
    joint = tree.above.get(frame)
    return None if joint is None else joint.T_parent_child


def _with_optical(tree: RobotTree, body: str, optical: str) -> tuple[RobotTree, Joint]:
    """Find the joint of a camera's optical frame: the robot's own, or the standard rotation."""
    if optical not in tree.frames:
        return tree, Joint(body, optical, T_BODY_OPTICAL, is_optical=True)
    if body not in tree.frames or body not in tree.chain(optical):
        raise SessionError(
            f"{tree.source}: {optical} is not below {body}",
            f"Name the frame above {optical} as this camera's `frame` in the profile.",
        )
    return tree, Joint(body, optical, tree.find_pose(body, optical), is_optical=True)


def _place(tree: RobotTree, anchor: str, child: str, T_anchor_child: Array) -> Joint:
    """Build the joint that puts a frame where it belongs, below the parent that it has."""
    if child not in tree.frames:
        return Joint(anchor, child, T_anchor_child)
    joint = tree.above.get(child)
    if joint is None or child in tree.chain(anchor):
        raise SessionError(
            f"{tree.source}: {anchor} hangs below {child}, which cannot be moved without it",
            "Calibrate with the sensor nearest to the robot's base as the profile's `base_frame`.",
        )
    if not joint.is_fixed:
        raise SessionError(
            f"{tree.source}: joint {joint.name} above {child} moves",
            "Extrinsics hold between sensors that are fixed to each other.",
        )
    return Joint(joint.parent, child, tree.find_pose(joint.parent, anchor) @ T_anchor_child)
