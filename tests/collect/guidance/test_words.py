"""Instructions for the person behind the board, facing the rig."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.collect.guidance.instructions import HeldPose, build_pose, describe_pose, instruct, is_there, say
from tests.collect.guidance.boards import placements, view

VIEW = view()
HERE = HeldPose(right_m=0.0, ahead_m=2.5, up_m=0.0, tilt_deg=0.0, turn_deg=0.0, roll_deg=45.0)


def words(now=HERE, **changes):
    said = instruct(VIEW, build_pose(VIEW, now), build_pose(VIEW, replace(now, **changes)))
    return list(said.values())


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"right_m": 0.6}, "one step left"),
        ({"right_m": -1.2}, "2 steps right"),
        ({"right_m": 0.3}, "30 cm left"),
        ({"ahead_m": 2.0}, "0.5 m closer"),
        ({"ahead_m": 3.0}, "0.5 m back"),
        ({"up_m": 0.2}, "raise it 20 cm"),
        ({"up_m": -0.2}, "lower it 20 cm"),
        ({"tilt_deg": 25.0}, "tilt the top towards the rig"),
        ({"tilt_deg": -25.0}, "tilt the bottom towards the rig"),
        ({"tilt_deg": 10.0}, "tilt the top a little towards the rig"),
        ({"turn_deg": 25.0}, "turn the left side towards the rig"),
        ({"turn_deg": -25.0}, "turn the right side towards the rig"),
        ({"roll_deg": 65.0}, "rotate it clockwise"),
        ({"roll_deg": 25.0}, "rotate it anticlockwise"),
    ],
)
def test_one_change_is_one_instruction(changes, text):
    assert words(**changes) == [text]


def test_instructions_left_is_the_persons_left():
    left = build_pose(VIEW, replace(HERE, right_m=0.6))
    pixels, _ = VIEW.model.lens.project(left[:3, 3])
    middle, _ = VIEW.model.lens.project(build_pose(VIEW, HERE)[:3, 3])
    assert pixels[0] > middle[0] + 100


def test_tilt_towards_rig_moves_top_closer():
    held = build_pose(VIEW, replace(HERE, tilt_deg=30.0))
    along = (held[:3, :3].T @ VIEW.up) * [1, 1, 0]
    top = held[:3, 3] + 0.3 * held[:3, :3] @ (along / np.linalg.norm(along))
    assert np.linalg.norm(top) < np.linalg.norm(held[:3, 3]) - 0.1


def test_instruct_place_comes_before_rotation():
    texts = words(right_m=2.0, ahead_m=2.2, up_m=0.3, tilt_deg=20.0, turn_deg=-40.0)
    assert texts[0] == "3 steps left"
    assert ["towards" in text for text in texts] == [False, False, False, True, True]
    assert "right side" in texts[3]


def test_say_several_moves_gives_first():
    assert say({"sideways": "3 steps left", "tilt": "tilt the top towards the rig"}) == "3 steps left"


def test_instruct_ignores_small_differences():
    assert words(right_m=0.05, ahead_m=2.55, up_m=0.03, tilt_deg=4.0, turn_deg=-4.0, roll_deg=50.0) == []
    assert say({}) == "hold still"


def test_pattern_rotated_by_180_deg_is_same_placement():
    held = build_pose(VIEW, HERE)
    flipped = held @ np.diag([-1.0, -1.0, 1.0, 1.0])
    assert instruct(VIEW, flipped, held) == {}
    assert is_there(VIEW, flipped, held)


def test_following_instructions_reaches_target():
    for present, wanted in zip(placements(12, 1), placements(12, 2), strict=True):
        there = describe_pose(VIEW, wanted)
        for _ in range(4):
            kinds = instruct(VIEW, present, wanted).keys()
            now = describe_pose(VIEW, present)
            keys = {"tilt": "tilt_deg", "turn": "turn_deg", "roll": "roll_deg", "height": "up_m"}
            followed = {key: getattr(there, key) for kind, key in keys.items() if kind in kinds}
            if kinds & {"sideways", "nearer"}:
                followed |= {"right_m": there.right_m, "ahead_m": there.ahead_m}
            present = build_pose(VIEW, replace(now, **followed))
        assert is_there(VIEW, present, wanted)


def test_is_there_distant_pose_is_false():
    held = build_pose(VIEW, HERE)
    assert not is_there(VIEW, build_pose(VIEW, replace(HERE, tilt_deg=25.0)), held)
    assert not is_there(VIEW, build_pose(VIEW, replace(HERE, right_m=0.4)), held)
    assert is_there(VIEW, build_pose(VIEW, replace(HERE, right_m=0.1, tilt_deg=6.0)), held)
