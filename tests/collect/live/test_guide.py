"""Guidance during a session: next placement, useless placements, learning from captures."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from lce_rig.calibrate.likelihood.levels import Levels
from lce_rig.collect.guidance.instructions import HeldPose, build_pose
from lce_rig.collect.guidance.sensor_model import SensorPlace
from lce_rig.collect.live.guide import GIVE_UP_S, make_guides
from lce_rig.collect.live.simulated import Person
from lce_rig.collect.placement_dedupe import Placements
from lce_rig.core.geometry import Array, exp_so3, pose
from lce_rig.rig import load_rig
from tests.collect.live.replay import rig
from tests.shared import changed

TWO_LIDARS = Path(__file__).parents[2] / "rigs" / "two_lidars.yaml"


@pytest.fixture
def guide():
    (guide,) = make_guides(rig())
    return guide


def test_guide_capture_lowers_prediction(guide):
    sigmas = []
    for k in range(8):
        guide.plan(None, float(k))
        assert guide.wanted is not None and guide.guidance is not None
        assert guide.adds_nothing(guide.wanted) is None
        sigmas.append(guide.guidance.sigma_rotation_deg)
        guide.add(f"{k:06d}", guide.wanted)
    known = [sigma for sigma in sigmas if np.isfinite(sigma)]
    assert known[-1] < known[0]
    coverage = guide.coverage()
    assert coverage is not None and coverage.left_right > 0 and coverage.tilt > 0
    assert guide.n_held == 8


def test_guide_two_lidars_counts_placements():
    (guide,) = make_guides(load_rig(str(TWO_LIDARS)))
    assert guide.key == ("front", "") and guide.lidar == "side"
    assert guide.problem is not None
    n_enough = int(guide.problem.figure("n_captures"))
    for k in range(n_enough):
        there = pose(exp_so3(np.array([0.0, 0.3 * (k % 2), 0.0])), np.array([2.0 + 0.1 * k, 0.0, 0.0]))
        assert not guide.is_enough and guide.adds_nothing(there) is None
        guide.add(f"{k:06d}", there)
        same = guide.adds_nothing(there)
        assert same is not None and same.code == "calibrate.same_placement"
    assert guide.is_enough and guide.has_enough and guide.wanted is None
    guide.remove("000000")
    assert not guide.is_enough


def test_rejected_capture_frees_its_placement(guide):
    for k in range(3):
        guide.plan(None, float(k))
        last = guide.wanted
        assert last is not None
        guide.add(f"{k:06d}", last)
    guide.plan(None, 5.0)
    refused = guide.adds_nothing(last)
    assert refused is not None and refused.figures["capture"] == "000002"
    assert guide.guidance is not None and guide.guidance.n_captures == 3
    guide.remove("000002")
    guide.plan(None, 6.0)
    assert guide.n_held == guide.guidance.n_captures == 2
    assert guide.adds_nothing(last) is None


def test_guide_explains_missing_captures():
    modest = changed(rig(), calibration__target_sigma_deg=5.0, calibration__target_sigma_m=0.5)
    (guide,) = make_guides(modest)
    assert guide.explain() is None and guide.predict() is None, "before the first capture nothing is known"
    for k in range(6):
        guide.plan(None, float(k))
        why = guide.explain()
        if k >= 2:
            assert why is not None and why.code == "guide.continues"
            assert (why.figures["n_more"], why.figures["n_least"]) == (6 - k, 6)
        assert guide.wanted is not None
        guide.add(f"{k:06d}", guide.wanted)
    guide.plan(None, 6.0)
    assert guide.explain() is None
    predicted = guide.predict()
    assert predicted is not None and predicted.figures["is_enough"] is True
    assert predicted.figures["n_captures"] == 6


def test_guide_unreachable_target_no_number():
    (guide,) = make_guides(changed(rig(), calibration__target_sigma_m=0.003))
    for k in range(12):
        guide.plan(None, float(k))
        assert guide.wanted is not None
        guide.add(f"{k:06d}", guide.wanted)
    guide.plan(None, 12.0)
    why = guide.explain()
    assert why is not None and why.figures["n_more"] is None
    assert why.figure("position_mm") > why.figure("limit_mm") == pytest.approx(2.7)


def test_guide_keeps_target_until_given_up(guide):
    guide.plan(None, 0.0)
    first = guide.wanted
    guide.plan(None, GIVE_UP_S - 1)
    assert guide.wanted is first
    guide.plan(None, GIVE_UP_S + 1)
    assert first is not None and guide.wanted is not None
    assert np.linalg.norm(guide.wanted[:3, 3] - first[:3, 3]) > 0.3
    second = guide.wanted
    guide.give_up()
    guide.plan(None, GIVE_UP_S + 2)
    assert guide.wanted is not None
    for old in (first, second):
        assert np.linalg.norm(guide.wanted[:3, 3] - old[:3, 3]) > 0.3


def test_guide_no_nominal_starts_calibrated(guide):
    (blind,) = make_guides(changed(rig(), nominal_extrinsics=()))
    blind.plan(None, 0.0)
    assert blind.problem is not None and blind.problem.code == "guide.no_nominal"
    assert blind.wanted is None
    assert blind.coverage() is None and blind.adds_nothing(np.eye(4)) is None
    nominal = rig().nominal("davis", "lidar")
    planner = blind.prepare(nominal.to_matrix(), Levels(), 1.0)
    assert planner is not None
    blind.adopt(planner)
    blind.plan(None, 1.0)
    assert blind.wanted is not None and blind.problem is None
    blind.adopt(None)
    assert blind.problem is not None and blind.wanted is None, "what was learned was taken back"


def test_guide_unknown_beams_has_no_target():
    (guide,) = make_guides(changed(rig(), lidars__lidar__model="HDL-64"))
    guide.plan(None, 0.0)
    assert guide.problem is not None and guide.problem.code == "guide.no_beams"
    assert guide.wanted is None and "HDL-64" in str(guide.problem.figures["cause"])
    assert guide.outline_px(np.eye(4)) is None


def test_guide_refused_placement_is_replaced(guide):
    guide.plan(None, 0.0)
    first = guide.wanted
    assert first is not None
    guide.note_refusal(first + np.array([[0, 0, 0, 0.5], *np.zeros((3, 4))]))
    assert guide.wanted is first, "the board is not there yet"
    guide.note_refusal(first)
    guide.plan(None, 1.0)
    assert guide.wanted is not None and not np.array_equal(guide.wanted, first)


def test_guide_unasked_time_is_not_counted(guide):
    guide.plan(None, 0.0)
    first = guide.wanted
    for now_s in (10.0, 50.0, 90.0):
        guide.plan(None, now_s, is_asked=False)
    guide.plan(None, 90.0 + GIVE_UP_S - 1)
    assert guide.wanted is first
    guide.plan(None, 90.0 + GIVE_UP_S + 1)
    assert guide.wanted is not first


# The simulated person tries again after so long; longer than that a walk seldom takes.
_TRY_S = 7.0


@dataclass
class Followed:
    """How a person followed a guide."""

    captured: list[Array] = field(default_factory=list)
    proposed: list[tuple[Array, int]] = field(default_factory=list)
    simulated_s: float = 0.0


def follow_guide(rig, n_wanted, person=None, can_be_held=lambda _T_cam_board: True):
    """Follow a rig's first guide until the requested number of captures, or none for ten minutes."""
    guide = make_guides(rig)[0]
    view = SensorPlace.nominal(rig, guide.key[0], guide.lidar)
    person, rng, walk = person or Person(), np.random.default_rng(0), Followed()
    present = build_pose(view, HeldPose(0.0, 2.5, 0.0, 0.0, 0.0, 45.0))
    captured_s = 0.0
    while len(walk.captured) < n_wanted and walk.simulated_s - captured_s < 600.0:
        before = guide.wanted
        guide.plan(present, walk.simulated_s)
        if guide.wanted is not None and guide.wanted is not before:
            walk.proposed.append((guide.wanted, len(walk.captured)))
        walk.simulated_s += _TRY_S
        reached = None if guide.wanted is None else person.follow(view, present, guide.wanted, rng)
        if reached is None or not can_be_held(reached):
            continue
        present = reached
        if guide.adds_nothing(present) is not None:
            guide.note_refusal(present)
            continue
        guide.add(f"{len(walk.captured):06d}", present)
        walk.captured.append(present)
        captured_s = walk.simulated_s
    return walk


@pytest.mark.long
def test_walk_continued_gets_new_placements():
    walk = follow_guide(rig(), 20)
    assert len(walk.captured) == 20
    assert len(walk.proposed) >= 20
    places, key = Placements(), ("davis", "frames")
    for T_cam_board, n_held in walk.proposed:
        assert not any(places.are_alike({key: T_cam_board}, {key: T}) for T in walk.captured[:n_held])


@pytest.mark.long
def test_guide_succeeds_in_half_a_room():
    careless = Person(place_sigma_m=0.2, turn_sigma_deg=15.0, ignored_share=0.5)

    def is_left(T_cam_board):
        return bool(T_cam_board[0, 3] < 0)

    walk = follow_guide(rig(), 16, person=careless, can_be_held=is_left)
    assert len(walk.captured) == 16
    assert all(is_left(T_cam_board) for T_cam_board in walk.captured)


def test_walk_unreachable_ends_after_10_min():
    walk = follow_guide(rig(), 3, can_be_held=lambda _T_cam_board: False)
    assert not walk.captured and walk.simulated_s == pytest.approx(600.0, abs=10.0)
    places = np.array([T_cam_board[:3, 3] for T_cam_board, _ in walk.proposed])
    assert len(places) >= 14
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).min() > 0.3, "one after the other elsewhere"
