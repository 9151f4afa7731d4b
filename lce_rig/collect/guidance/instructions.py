"""Instructions that guide the person with the board from its present pose to the target pose.

The person faces the rig: the right side of the camera's view is on the person's left.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lce_rig.collect.guidance.sensor_model import SensorPlace, face_camera, facing_axes
from lce_rig.core.geometry import Array, exp_so3

Kind = Literal["sideways", "nearer", "height", "tilt", "turn", "roll"]

_STEP_M = 0.6  # Length of a person's step to the side.
_ROTATIONS = ("tilt", "turn", "roll")
#: Differences, m and deg, below which no instruction is given: people cannot correct smaller ones.
DEAD_BANDS = {"sideways": 0.12, "nearer": 0.15, "height": 0.10, "tilt": 8.0, "turn": 8.0, "roll": 15.0}
#: Tolerance of every pose figure at the target, in dead bands.
THERE = 1.5


@dataclass(frozen=True)
class HeldPose:
    """Pose of a board as seen by the person holding it.

    Attributes:
        right_m: offset of its centre to the right of the camera's sight line, level.
        ahead_m: level distance from the camera along that line.
        up_m: height above the camera.
        tilt_deg: tilt of the top towards the rig.
        turn_deg: rotation of the person's left side towards the rig.
        roll_deg: rotation in its plane, counter-clockwise in the image, 0 with level width.
    """

    right_m: float
    ahead_m: float
    up_m: float
    tilt_deg: float
    turn_deg: float
    roll_deg: float


def describe_pose(view: SensorPlace, T_cam_board: Array) -> HeldPose:
    """Decompose a pose T_cam_board (4, 4)."""
    centre = T_cam_board[:3, 3]
    right, ahead = _level_axes(view)
    ray = centre / np.linalg.norm(centre)
    R = facing_axes(view, ray[None])[0].T @ T_cam_board[:3, :3]
    normal = R[:, 2]
    # Rotate the normal to horizontal by the shortest way; the remaining rotation is the roll.
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, normal[2])
    upright = exp_so3(axis / max(sine, 1e-12) * angle) @ R
    return HeldPose(
        right_m=float(right @ centre),
        ahead_m=float(ahead @ centre),
        up_m=float(view.up @ centre),
        tilt_deg=float(np.degrees(-np.arcsin(np.clip(normal[1], -1.0, 1.0)))),
        turn_deg=float(np.degrees(-np.arctan2(normal[0], normal[2]))),
        roll_deg=float(np.degrees(np.arctan2(upright[1, 0], upright[0, 0]))),
    )


def build_pose(view: SensorPlace, held: HeldPose) -> Array:
    """Build T_cam_board (4, 4), the inverse of `describe_pose`."""
    right, ahead = _level_axes(view)
    centre = held.right_m * right + held.ahead_m * ahead + held.up_m * view.up
    distance_m = float(np.linalg.norm(centre))
    tilt, turn = np.radians([held.tilt_deg, held.turn_deg])
    level = np.cos(tilt)
    normal = np.array([-np.sin(turn) * level, -np.sin(tilt), np.cos(turn) * level])
    axis = np.cross([0.0, 0.0, 1.0], normal)
    sine = float(np.linalg.norm(axis))
    vector = axis / max(sine, 1e-12) * np.arctan2(sine, normal[2])
    ray = (centre / distance_m)[None]
    roll = np.radians(np.array([held.roll_deg]))
    poses = face_camera(view, ray, np.array([distance_m]), vector[None, :2], roll)
    return np.asarray(poses[0])


def instruct(view: SensorPlace, present: Array, wanted: Array) -> dict[Kind, str]:
    """List the moves to the target pose, translations first, then by size; empty at the target.

    Args:
        view: the sensors.
        present: (4, 4) T_cam_board now.
        wanted: (4, 4) T_cam_board to reach.
    """
    changes = _changes(view, present, wanted)
    # Dead bands make ways and angles comparable.
    sizes = {kind: abs(amount) / DEAD_BANDS[kind] for kind, amount in changes.items()}
    ordered = sorted(
        (kind for kind in sizes if sizes[kind] > 1), key=lambda kind: (kind in _ROTATIONS, -sizes[kind])
    )
    return {kind: _in_words(kind, changes[kind]) for kind in ordered}


def say(instructions: Mapping[Kind, str]) -> str:
    """Return the first instruction, since people follow one at a time; "hold still" if there are none."""
    return next(iter(instructions.values()), "hold still")


def is_there(view: SensorPlace, present: Array, wanted: Array) -> bool:
    """Check whether a board (4, 4) is as close to its target pose (4, 4) as people can hold it."""
    changes = _changes(view, present, wanted)
    return all(abs(amount) <= THERE * DEAD_BANDS[kind] for kind, amount in changes.items())


def _changes(view: SensorPlace, present: Array, wanted: Array) -> dict[Kind, float]:
    """Compute the signed changes by kind, m and deg.

    They are positive to the camera's right, nearer, up, the top towards the rig, the person's left side
    towards the rig, and clockwise as the person sees it.
    """
    now, then = describe_pose(view, present), describe_pose(view, wanted)
    # A pattern looks the same upside down.
    roll_deg = (then.roll_deg - now.roll_deg + 90) % 180 - 90
    # Forwards is towards the rig, as seen by the person.
    sight = np.array([now.right_m, now.ahead_m]) / max(np.hypot(now.right_m, now.ahead_m), 1e-9)
    way = np.array([then.right_m - now.right_m, then.ahead_m - now.ahead_m])
    return {
        "sideways": float(way @ [sight[1], -sight[0]]),
        "nearer": float(-way @ sight),
        "height": then.up_m - now.up_m,
        "tilt": then.tilt_deg - now.tilt_deg,
        "turn": then.turn_deg - now.turn_deg,
        "roll": roll_deg,
    }


def _in_words(kind: Kind, amount: float) -> str:
    size = abs(amount)
    if kind == "sideways":
        steps = round(size / _STEP_M)
        way = "one step" if steps == 1 else f"{steps} steps"
        way = f"{10 * round(10 * size)} cm" if size < 0.75 * _STEP_M else way
        return f"{way} {'left' if amount > 0 else 'right'}"
    if kind == "nearer":
        return f"{size:.1f} m {'closer' if amount > 0 else 'back'}"
    if kind == "height":
        return f"{'raise' if amount > 0 else 'lower'} it {100 * size:.0f} cm"
    if kind == "tilt":
        return f"tilt the {'top' if amount > 0 else 'bottom'} {_angle(size)}towards the rig"
    if kind == "turn":
        return f"turn the {'left' if amount > 0 else 'right'} side {_angle(size)}towards the rig"
    return f"rotate it {_angle(size)}{'clockwise' if amount > 0 else 'anticlockwise'}"


def _angle(size_deg: float) -> str:
    return "a little " if size_deg < 15 else "far " if size_deg > 45 else ""


def _level_axes(view: SensorPlace) -> tuple[Array, Array]:
    """Build the horizontal directions to the camera's right and ahead of it, frame camera."""
    right = np.cross(np.array([0.0, 0.0, 1.0]), view.up)
    right /= max(float(np.linalg.norm(right)), 1e-9)
    return right, np.asarray(np.cross(view.up, right))
