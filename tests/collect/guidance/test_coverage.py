"""Bars that fill while captures spread over what is reachable."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.collect.guidance.instructions import HeldPose, build_pose
from lce_rig.collect.guidance.planner import Coverage, Planner, measure_coverage
from tests.collect.guidance.boards import view

VIEW = view()
HERE = HeldPose(right_m=0.0, ahead_m=2.5, up_m=0.0, tilt_deg=0.0, turn_deg=0.0, roll_deg=45.0)


@pytest.fixture(scope="module")
def reachable():
    return Planner(VIEW, n_places=100).candidates


def coverage(reachable, *changes):
    poses = [build_pose(VIEW, replace(HERE, **change)) for change in changes]
    return measure_coverage(VIEW, np.array(poses).reshape(-1, 4, 4), reachable)


def test_nothing_is_covered_by_nothing_nor_by_one_board(reachable):
    assert coverage(reachable) == Coverage(0, 0, 0, 0, 0)
    assert coverage(reachable, {}) == Coverage(0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("bar", "changes"),
    [
        ("left_right", [{"right_m": -1.2}, {"right_m": 1.2}]),
        ("up_down", [{"up_m": -0.5}, {"up_m": 0.5}]),
        ("near_far", [{"ahead_m": 1.4}, {"ahead_m": 5.5}]),
        ("roll", [{"roll_deg": 30.0}, {"roll_deg": 60.0}]),
        ("tilt", [{"tilt_deg": 20.0}, {"tilt_deg": -20.0}, {"turn_deg": 20.0}, {"turn_deg": -20.0}]),
    ],
)
def test_each_bar_fills_by_its_own_movement(reachable, bar, changes):
    assert getattr(coverage(reachable, *changes), bar) == pytest.approx(1.0, abs=0.15)
    others = replace(coverage(reachable, *changes), **{bar: 0.0})
    assert max(vars(others).values()) < 0.6
