"""A simulated person who follows instructions, more or less: how guidance is put to the test."""

from dataclasses import dataclass, replace

import numpy as np

from lce_rig.collect.guidance.candidates import SensorPlace
from lce_rig.collect.guidance.instructions import HeldPose, build_pose, describe_pose, instruct
from lce_rig.core.geometry import Array, exp_so3, pose

_FIGURE = {
    "sideways": "right_m",
    "nearer": "ahead_m",
    "height": "up_m",
    "tilt": "tilt_deg",
    "turn": "turn_deg",
    "roll": "roll_deg",
}


@dataclass(frozen=True)
class Person:
    """How somebody follows instructions.

    Attributes:
        place_sigma_m: error along each axis.
        turn_sigma_deg: error about each axis.
        ignored_share: how often one of the instructions is not followed.
    """

    place_sigma_m: float = 0.10
    turn_sigma_deg: float = 8.0
    ignored_share: float = 0.2

    def follow(self, view: SensorPlace, present: Array, wanted: Array, rng: np.random.Generator) -> Array:
        """Move a board T_cam_board (4, 4) to where it is wanted, more or less."""
        aim = describe_pose(view, wanted)
        instructions = instruct(view, present, wanted)
        if instructions and rng.random() < self.ignored_share:
            ignored = rng.choice([each.kind for each in instructions])
            aim = _without(aim, describe_pose(view, present), ignored)
        aimed = build_pose(view, aim)
        turn = exp_so3(np.radians(self.turn_sigma_deg) * rng.standard_normal(3))
        place = aimed[:3, 3] + self.place_sigma_m * rng.standard_normal(3)
        return pose(turn @ aimed[:3, :3], place)


def _without(aim: HeldPose, present: HeldPose, kind: str) -> HeldPose:
    """Leave one instruction out."""
    return replace(aim, **{_FIGURE[kind]: getattr(present, _FIGURE[kind])})
