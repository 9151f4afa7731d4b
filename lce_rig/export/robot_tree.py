"""A robot's frame tree, and the changes to it that realise the calibrations.

The tree comes from the profile's `mount`, from the robot's URDF, or from the static transforms of a
recording. Without any of them the sensors form a tree of their own. `build_trees` is the source of all
outputs with frames.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import LceRigError, SessionError
from lce_rig.core.geometry import T_BODY_OPTICAL, Array, difference, invert, tangent_sizes
from lce_rig.rig import CameraSettings, Rig


class Joint(NamedTuple):
    """A joint between two frames.

    Attributes:
        parent, child: the frames.
        T_parent_child: (4, 4), the child's pose in the parent's frame; for moving joints, at zero.
        is_fixed: whether it never moves.
        name: name in the robot's URDF; "" if joints have none.
        is_given: whether the robot's own tree already contains it unchanged.
    """

    parent: str
    child: str
    T_parent_child: Array
    is_fixed: bool = True
    name: str = ""
    is_given: bool = False


class JointChange(NamedTuple):
    """A new joint, or one with a changed pose.

    Attributes:
        joint: the joint after the change.
        before: T_parent_child (4, 4) in the robot's own tree; None for a new joint.
    """

    joint: Joint
    before: Array | None

    @property
    def is_real(self) -> bool:
        """Whether the change is more than rounding."""
        return self.before is None or not np.allclose(self.joint.T_parent_child, self.before, atol=1e-9)

    @property
    def moved(self) -> tuple[float, float] | None:
        """Size of the change (deg, m); None for a new joint."""
        if self.before is None:
            return None
        return tangent_sizes(difference(self.joint.T_parent_child, self.before))


@dataclass(frozen=True, eq=False)
class RobotTree:
    """The frames of a robot.

    Attributes:
        source: the file it was read from, for messages.
        frames: all frames.
        above: joint of each frame that has a parent; in trees to be written, parents first.
    """

    source: str
    frames: frozenset[str]
    above: Mapping[str, Joint]

    @property
    def root(self) -> str:
        """The first frame without a parent."""
        return next(joint.parent for joint in self.above.values() if joint.parent not in self.above)

    @classmethod
    def of_joints(
        cls,
        source: str,
        joints: Sequence[Joint],
        links: Iterable[str] | None = None,
        *,
        has_one_root: bool = True,
    ) -> "RobotTree":
        """Build the tree of joints, and check its validity.

        Args:
            source: file, for messages.
            joints: joints in any order.
            links: the frames, if the source lists them.
            has_one_root: whether it must be one tree. Static transforms may form several, connected by
                transforms that change while the robot drives.

        Raises:
            SessionError: no frame, a name twice, an unknown frame, two parents, several roots, or a loop.
        """
        named = dict.fromkeys(frame for joint in joints for frame in (joint.parent, joint.child))
        counts = Counter(list(named) if links is None else links)
        above: dict[str, Joint] = {}
        faults = ["no links"] if not counts else []
        faults += [f"link {link} is defined twice" for link, count in counts.items() if count > 1]
        faults += [f"a joint names link {link}, which is not defined" for link in named if link not in counts]
        for joint in joints:
            if joint.child in above:
                parents = f"{above[joint.child].parent} and {joint.parent}"
                faults.append(f"link {joint.child} has two parents, {parents}")
            above[joint.child] = joint
        roots = [link for link in counts if link not in above]
        if has_one_root and len(roots) > 1:
            faults.append(f"several roots: {', '.join(roots)}")
        try:
            TopologicalSorter({child: [joint.parent] for child, joint in above.items()}).prepare()
        except CycleError as error:
            faults.append(f"a loop: {' < '.join(error.args[1])}")
        if faults:
            raise SessionError(f"{source}: not a tree of frames: {faults[0]}")
        return cls(source, frozenset(counts), above)

    def chain(self, frame: str) -> list[str]:
        """List a frame and its ancestors, up to the root."""
        frames = [frame]
        while frames[-1] in self.above:
            frames.append(self.above[frames[-1]].parent)
        return frames

    def fixed_chain(self, frame: str) -> list[str]:
        """List a frame and the ancestors fixed to it."""
        frames = [frame]
        while (joint := self.above.get(frames[-1])) is not None and joint.is_fixed:
            frames.append(joint.parent)
        return frames

    def find_pose(self, frame_a: str, frame_b: str) -> Array:
        """Compute T_a_b (4, 4) between frames connected by fixed joints.

        Raises:
            SessionError: nothing connects them, or a joint between them moves.
        """
        above_b = set(self.chain(frame_b))
        common = next((frame for frame in self.chain(frame_a) if frame in above_b), None)
        if common is None:
            raise SessionError(f"{self.source}: nothing connects {frame_a} and {frame_b}")
        return invert(self._from(common, frame_a)) @ self._from(common, frame_b)

    def _from(self, ancestor: str, frame: str) -> Array:
        """Compute the pose of a frame in one of its ancestors."""
        T = np.eye(4)
        while frame != ancestor:
            joint = self.above[frame]
            if not joint.is_fixed:
                raise SessionError(
                    f"{self.source}: joint {joint.name} above {frame} moves",
                    "Extrinsics hold between sensors that are fixed to each other.",
                )
            T = joint.T_parent_child @ T
            frame = joint.parent
        return T

    def with_joint(self, joint: Joint) -> "RobotTree":
        """Set the pose of a frame in its parent, or add the frame."""
        old = self.above.get(joint.child)
        new = Joint(joint.parent, joint.child, joint.T_parent_child, name=old.name if old else "")
        frames = self.frames | {joint.parent, joint.child}
        return replace(self, frames=frames, above={**self.above, joint.child: new})


def require_known(calibration: Calibration, rig: Rig) -> None:
    """Check that a calibration names sensors of the rig.

    Raises:
        LceRigError: a sensor or channel that the rig does not have.
    """
    camera = rig.cameras.get(calibration.camera)
    is_known = camera is not None and set(calibration.channels) <= set(camera.channels)
    if calibration.is_of_lidars:
        is_known = calibration.camera in rig.lidars
    if not is_known or calibration.lidar not in (rig.cameras if calibration.is_of_cameras else rig.lidars):
        pair = f"{calibration.camera}/{calibration.channel} and {calibration.lidar}"
        what = f"the result is for {pair}, which rig {rig.name} does not have"
        raise LceRigError(what, "Use the profile that the session was made with.")


def fit_tree(
    robot: RobotTree | None, calibrations: Sequence[Calibration], rig: Rig
) -> tuple[RobotTree, list[JointChange], list[tuple[str, ...]]]:
    """Change the joints of a robot's tree to match the poses of calibrated sensors.

    Of the sensors that calibrations connect, the one nearest to the root stays. Each other sensor of the
    robot keeps its parent, and only its joint's pose changes; a sensor that the robot lacks is added below
    the sensor it was calibrated with. An optical frame of the robot stays unchanged below its body. The
    profile's `mount` adds its sensor to a robot that lacks it.

    Args:
        robot: tree of the robot; None for one of the sensors alone, below the profile's `mount` if it has
            one.
        calibrations: calibrations of the rig's sensors.
        rig: the profile, which names the frames.

    Returns:
        The robot's tree with the changes, the changes, parents first, and the frames of sensors that
        calibrations connect, the one that stays first.

    Raises:
        SessionError: the robot has none of a calibration's frames, or a joint between two of them moves, or
            a frame would get two parents.
    """
    for calibration in calibrations:
        require_known(calibration, rig)
    tree, changes = _mounted(robot, rig)
    bodies = {name: lidar.frame for name, lidar in rig.lidars.items()}
    bodies |= {name: camera.frame for name, camera in rig.cameras.items()}
    groups: list[tuple[str, ...]] = []
    for names in _connected(calibrations, bodies):
        frames = [bodies[name] for name in names]
        if robot is None and not tree.frames.intersection(frames):
            root = rig.root_frame if rig.root_frame in frames else frames[0]
            tree = replace(tree, frames=tree.frames | {root})
        present = [frame for frame in frames if frame in tree.frames]
        if not present:
            raise SessionError(
                f"{tree.source} has none of the sensors' frames: {', '.join(frames)}",
                "Name the robot's frames in the profile (`frame` of each sensor), or set `mount` there.",
            )
        placed = [min(present, key=lambda frame: len(tree.chain(frame)))]
        for anchor in placed:  # which grows
            for calibration in calibrations:
                lidar, camera = bodies[calibration.lidar], bodies[calibration.camera]
                if anchor in (lidar, camera) and not {lidar, camera} <= set(placed):
                    tree, placing = _placed(tree, calibration, rig, anchor)
                    changes += placing
                    placed.append(camera if anchor == lidar else lidar)
        groups.append(tuple(placed))
    return tree, changes, groups


def build_trees(
    calibrations: Sequence[Calibration], rig: Rig, robot: RobotTree | None = None
) -> list[RobotTree]:
    """Connect all calibrated sensors to the robot's root, or to the rig's; unconnected ones form other trees.

    A tree holds the sensors, their optical frames and all that lies between them and the topmost frame that
    they never move against.

    Raises:
        LceRigError: a calibration names a sensor that the rig does not have.
        SessionError: the sensors do not fit into the robot's tree, see `fit_tree`.
    """
    tree, changes, groups = fit_tree(robot, calibrations, rig)
    optical = {camera.frame: camera.optical_frame for camera in rig.cameras.values()}
    changed = {change.joint.child for change in changes if change.is_real}
    joints: dict[str, dict[str, Joint]] = {}
    for group in groups:
        for frame in (*group, *(optical[body] for body in group if body in optical)):
            *below, root = tree.fixed_chain(frame)
            for child in reversed(below):
                joint = tree.above[child]._replace(is_given=child not in changed)
                joints.setdefault(root, {}).setdefault(child, joint)
    return [RobotTree("the tree", frozenset({root, *below}), below) for root, below in joints.items()]


def _mounted(robot: RobotTree | None, rig: Rig) -> tuple[RobotTree, list[JointChange]]:
    """Add the profile's mount to a robot that lacks the sensor."""
    tree = RobotTree("the profile", frozenset(), {}) if robot is None else robot
    mount = rig.mount
    if mount is None:
        return tree, []
    if mount.of in tree.frames:
        above = tree.above.get(mount.of)
        if above is None or above.parent != mount.parent:
            parent = "none" if above is None else above.parent
            raise SessionError(
                f"{tree.source}: the parent of {mount.of} is {parent}, and {mount.parent} by the profile",
                "A frame has one parent: correct one of them.",
            )
        return tree, []
    if robot is not None and mount.parent not in tree.frames:
        raise SessionError(
            f"{tree.source} has no frame {mount.parent}, below which the profile mounts {mount.of}",
            "Name a frame of the robot as `mount.parent` in the profile.",
        )
    joint = Joint(mount.parent, mount.of, mount.to_matrix())
    return tree.with_joint(joint), [JointChange(joint, None)]


def _connected(calibrations: Sequence[Calibration], bodies: Mapping[str, str]) -> list[list[str]]:
    """Group the sensors that calibrations connect, in the order of the rig."""
    groups: list[set[str]] = []
    for calibration in calibrations:
        joined = {calibration.camera, calibration.lidar}
        touching = [group for group in groups if group & joined]
        groups = [group for group in groups if not group & joined] + [joined.union(*touching)]
    ordered = [[name for name in bodies if name in group] for group in groups]
    return sorted(ordered, key=lambda names: list(bodies).index(names[0]))


def _placed(
    tree: RobotTree, calibration: Calibration, rig: Rig, anchor: str
) -> tuple[RobotTree, list[JointChange]]:
    """Place the other sensor of a calibration, relative to the one already placed."""
    first, second = rig.frame_of(calibration.camera), rig.frame_of(calibration.lidar)
    T_first_second, opticals = calibration.T_cam_lidar, []
    if calibration.camera in rig.cameras:
        opticals.append(_optical(tree, rig.cameras[calibration.camera]))
        T_first_second = opticals[0].T_parent_child @ T_first_second
    if calibration.lidar in rig.cameras:
        opticals.append(_optical(tree, rig.cameras[calibration.lidar]))
        T_first_second = T_first_second @ invert(opticals[1].T_parent_child)
    if anchor == first:
        joint = _place(tree, first, second, T_first_second)
    else:
        joint = _place(tree, second, first, invert(T_first_second))
    above = tree.above.get(joint.child)
    changes = [JointChange(joint, None if above is None else above.T_parent_child)]
    tree = tree.with_joint(joint)
    for optical in opticals:
        if optical.child not in tree.frames:
            changes.append(JointChange(optical, None))
            tree = tree.with_joint(optical)
    return tree, changes


def _optical(tree: RobotTree, camera: CameraSettings) -> Joint:
    """Return the joint of a camera's optical frame: the robot's own, or the standard rotation.

    Raises:
        SessionError: the robot has the optical frame elsewhere than below the camera's frame.
    """
    T_body_optical = T_BODY_OPTICAL
    if camera.optical_frame in tree.frames:
        if camera.frame not in tree.frames or camera.frame not in tree.chain(camera.optical_frame):
            raise SessionError(
                f"{tree.source}: {camera.optical_frame} is not below {camera.frame}",
                f"Name the frame above {camera.optical_frame} as this camera's `frame` in the profile.",
            )
        T_body_optical = tree.find_pose(camera.frame, camera.optical_frame)
    return Joint(camera.frame, camera.optical_frame, T_body_optical)


def _place(tree: RobotTree, anchor: str, child: str, T_anchor_child: Array) -> Joint:
    """Build the joint that places a frame relative to the anchor, below its present parent."""
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
