"""A simulated person who follows a guide, without images: the board is where the person holds it."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lce_rig.collect.guidance.instructions import HeldPose, build_pose
from lce_rig.collect.guidance.planner import MIN_MOVE_M, MIN_TURN_DEG
from lce_rig.collect.guidance.sensor_model import SensorPlace, model_sensors
from lce_rig.collect.live.guide import Guide, make_guides
from lce_rig.collect.live.simulated import Person
from lce_rig.core.geometry import Array, rotation_angle
from lce_rig.rig import Rig

# The simulated person tries again after so long; longer than that a walk seldom takes.
_TRY_S = 7.0
# A placement nearer than both to a capture is not new.
NEW_M, NEW_DEG = MIN_MOVE_M, MIN_TURN_DEG


@dataclass
class Followed:
    """How a person followed a guide.

    Attributes:
        captured: (4, 4) each.
        proposed: (4, 4) each, with what was held when it was.
        n_refused: placements that were refused.
        simulated_s: how long it took them.
    """

    captured: list[Array] = field(default_factory=list)
    proposed: list[tuple[Array, int]] = field(default_factory=list)
    n_refused: int = 0
    simulated_s: float = 0.0

    def nearest(self) -> list[tuple[float, float]]:
        """Measure how far each proposal was from the nearest capture before it, m and deg."""
        return [min(_apart(T, held) for held in self.captured[:n]) for T, n in self.proposed if n]


def follow_guide(
    rig: Rig,
    n_wanted: int,
    seed: int = 0,
    person: Person | None = None,
    can_be_held: Callable[[Array], bool] = lambda _T_cam_board: True,
    patience_s: float = 600.0,
) -> Followed:
    """Follow a rig's first guide until there are as many captures as wanted, or none for long.

    Args:
        rig: the profile.
        n_wanted: captures.
        seed: of the person.
        person: who follows.
        can_be_held: tells where nothing is in the way of T_cam_board (4, 4).
        patience_s: simulated time without a capture after which it ends.
    """
    guide, view = make_guides(rig)[0], first_view(rig)
    person, rng, walk = person or Person(), np.random.default_rng(seed), Followed()
    present = build_pose(view, HeldPose(0.0, 2.5, 0.0, 0.0, 0.0, 45.0))
    captured_s = 0.0
    while len(walk.captured) < n_wanted and walk.simulated_s - captured_s < patience_s:
        _ask(guide, present, walk)
        walk.simulated_s += _TRY_S
        if guide.wanted is None:
            continue
        reached = person.follow(view, present, guide.wanted, rng)
        if not can_be_held(reached):
            continue
        present = reached
        if guide.adds_nothing(present) is not None:
            walk.n_refused += 1
            guide.note_refusal(present)
            continue
        guide.add(f"{len(walk.captured):06d}", present)
        walk.captured.append(present)
        captured_s = walk.simulated_s
    return walk


def first_view(rig: Rig) -> SensorPlace:
    """Look through a rig's first camera as its drawing has it."""
    camera, lidar = next(iter(rig.cameras)), next(iter(rig.lidars))
    nominal = rig.nominal(camera, lidar)
    assert nominal is not None
    return SensorPlace.upright(model_sensors(rig, camera, lidar), nominal.to_matrix())


def _ask(guide: Guide, present: Array, walk: Followed) -> None:
    """Let the guide plan, and note what it newly proposes."""
    before = guide.wanted
    guide.plan(present, walk.simulated_s)
    if guide.wanted is not None and guide.wanted is not before:
        walk.proposed.append((guide.wanted, len(walk.captured)))


def _apart(T_1: Array, T_2: Array) -> tuple[float, float]:
    # The pattern may be read from either end.
    flipped = T_1[:3, :3] @ np.diag([-1.0, -1.0, 1.0])
    turn_rad = min(float(rotation_angle(R, T_2[:3, :3])) for R in (T_1[:3, :3], flipped))
    return float(np.linalg.norm(T_1[:3, 3] - T_2[:3, 3])), float(np.degrees(turn_rad))
