"""The next placement, the end of the collection, and refused placements."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lce_rig.collect.guidance.evidence import sigmas
from lce_rig.collect.guidance.instructions import HeldPose, build_pose, is_there
from lce_rig.collect.guidance.planner import Coverage, Planner, measure_coverage
from lce_rig.collect.guidance.sensor_model import NEAREST_M, SensorPlace, is_reachable
from lce_rig.core.geometry import invert, perturb, transform
from lce_rig.detect.events.figures import outline_px
from lce_rig.rig import load_rig
from tests.calibrate.boards import T_FORWARD
from tests.collect.guidance.boards import model, placements, predict_covariance, view

NONE = np.zeros((0, 4, 4))


@pytest.fixture(scope="module")
def planner():
    return Planner(view(), n_places=100)


@pytest.mark.parametrize(("profile", "camera"), [("rlfs", "cam"), ("rles", "davis")])
def test_guide_asks_for_named_distances(profile, camera):
    rig = load_rig(profile)
    view = SensorPlace.nominal(rig, camera, next(iter(rig.lidars)))
    distance_m = np.linalg.norm(Planner(view).candidates[:, :3, 3], axis=1)
    near_m, far_m = distance_m.min(), distance_m.max()
    limits = rig.quality
    assert max(NEAREST_M, limits.min_distance_m) <= near_m < 1.3
    assert near_m < far_m <= limits.max_distance_m
    guide = (Path(__file__).parents[3] / "docs" / "collect.md").read_text()
    assert f"Distances from {NEAREST_M:g} m" in guide
    assert re.search(rf"{far_m:.1f} m [^.]*`{profile}`", guide)


@pytest.fixture(scope="module")
def guided(planner):
    held = NONE
    while len(held) < 12:
        held = np.concatenate([held, planner.guide(held).T_cam_board[None]])
    return held


def test_every_candidate_is_seen_by_both_sensors(planner):
    limits = planner.view.model.limits
    assert len(planner.candidates) > 100
    distance_m = np.linalg.norm(planner.candidates[:, :3, 3], axis=1)
    assert distance_m.min() >= 1.2 - 1e-6
    assert distance_m.max() <= limits.max_distance_m
    for T_cam_board in planner.candidates:
        outline = outline_px(T_cam_board, planner.view.model.board, planner.view.model.lens)
        assert planner.view.model.lens.is_inside(outline).all()


def test_guided_placements_are_more_informative_than_random(guided):
    random = [sigmas(predict_covariance(model(), placements(12, seed), T_FORWARD)) for seed in range(5)]
    rotation, translation = sigmas(predict_covariance(model(), guided, T_FORWARD))
    assert rotation < 0.8 * np.median([each[0] for each in random])
    assert translation < 0.9 * np.median([each[1] for each in random])


def test_target_placement_lowers_prediction(planner, guided):
    before, after = planner.guide(guided[:5]), planner.guide(guided[:6])
    rotation, translation = sigmas(predict_covariance(planner.view.model, guided[:6], T_FORWARD))
    assert after.sigma_rotation_deg == pytest.approx(np.degrees(rotation))
    assert after.sigma_translation_m == pytest.approx(translation)
    assert after.sigma_rotation_deg < before.sigma_rotation_deg


def test_planner_never_repeats_a_placement(guided):
    for k, T_cam_board in enumerate(guided):
        way_m = np.linalg.norm(guided[:k, :3, 3] - T_cam_board[:3, 3], axis=1)
        turn = guided[:k, :3, 2] @ T_cam_board[:3, 2]
        roll = np.abs(guided[:k, :3, 0] @ T_cam_board[:3, 0])
        assert not np.any((way_m < 0.01) & (turn > 0.9999) & (roll > 0.9999))


def test_planner_skips_unreachable_placement(planner):
    first = planner.guide(NONE).T_cam_board
    second = planner.guide(NONE, avoid=first[None]).T_cam_board
    assert np.linalg.norm(second[:3, 3] - first[:3, 3]) >= 0.4
    assert planner.guide(NONE, avoid=planner.candidates).T_cam_board is None


def test_planner_prefers_nearest_of_similar_placements(planner, guided):
    held = guided[:8]
    free = planner.guide(held).T_cam_board
    nearby = planner.guide(held, present=planner.candidates[3]).T_cam_board
    reach_m = [np.linalg.norm(T[:3, 3] - planner.candidates[3, :3, 3]) for T in (nearby, free)]
    assert reach_m[0] <= reach_m[1]


def test_planner_enough_at_predicted_target(guided):
    modest = replace(model(), target_sigma_rad=np.radians(0.5), target_sigma_m=0.03)
    strict = replace(model(), target_sigma_rad=np.radians(0.02), target_sigma_m=0.001)
    few = Planner(SensorPlace(modest, T_FORWARD), n_places=20)
    assert few.guide(guided).is_enough
    assert not few.guide(guided[: model().limits.min_captures - 1]).is_enough
    assert not Planner(SensorPlace(strict, T_FORWARD), n_places=20).guide(guided).is_enough


def test_planner_known_placement_is_refused(planner, guided):
    again = perturb(guided[2], np.array([0.02, 0.0, 0.02, 0.03, 0.0, 0.0]))
    refusal = planner.adds_nothing(guided[:6], again)
    assert (refusal.code, refusal.figures["capture"]) == ("calibrate.known_placement", "3")
    assert refusal.figures["instruction"]
    assert planner.adds_nothing(guided[:6], again, names=list("abcdef")).figures["capture"] == "c"


def test_reachable_far_poses_are_excluded():
    poses = placements(40, seed=9)
    is_fine = is_reachable(view(), poses)
    assert is_fine.any()
    raised, aside, far = poses.copy(), poses.copy(), poses.copy()
    raised[:, :3, 3] += 2.0 * T_FORWARD[:3, 2]
    aside[:, 0, 3] += 4.0
    far[:, :3, 3] *= 7.0 / np.linalg.norm(poses[:, :3, 3], axis=1)[:, None]
    for moved in (raised, aside, far):
        assert not is_reachable(view(), moved).any()


def test_planner_no_rings_keeps_whole_plate():
    shape = {"elevations_rad": np.radians(np.arange(-20.0, 20.5, 0.5)), "width_rad": np.radians(60.0)}
    n_placed = []
    for pattern in ("rings", "any", "rosette"):
        place = SensorPlace(replace(model(), pattern=pattern, **shape), T_FORWARD)
        poses = Planner(place, n_places=100).candidates
        n_placed.append(len(poses))
        outline = transform(invert(T_FORWARD) @ poses, model().board.outline())
        elevation = np.arctan2(outline[..., 2], np.hypot(outline[..., 0], outline[..., 1]))
        azimuth = np.arctan2(outline[..., 1], outline[..., 0])
        is_inside = bool(np.all(abs(elevation) < np.radians(20)) and np.all(abs(azimuth) < np.radians(30)))
        assert is_inside == (pattern != "rings")
    assert n_placed[0] > n_placed[1] > n_placed[2] > 0


def test_planner_moves_person_away_from_capture(planner, guided):
    for k in range(1, len(guided)):
        present = guided[k - 1]
        wanted = planner.guide(guided[:k], present).T_cam_board
        assert not is_there(planner.view, present, wanted)
    # A board beside the first candidate, and no other place to go: better that one than none.
    present = perturb(planner.candidates[0], np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.2]))
    far = np.linalg.norm(planner.candidates[:, :3, 3] - present[:3, 3], axis=1) > 0.4
    guidance = planner.guide(present[None], present, avoid=planner.candidates[far])
    assert guidance.T_cam_board is not None


def test_planner_without_placements_refuses_with_reason(planner):
    refusal = planner.adds_nothing(planner.candidates, planner.candidates[7])
    assert (refusal.figures["capture"], refusal.action) == ("8", "nowhere")


def crowded():
    """Captures close to one place, and a board among them with little information."""
    bold = Planner(view(), 0.001, 0.05, n_places=100)
    near = bold.guide(NONE).T_cam_board
    crowd = np.array([perturb(near, np.r_[0.02 * k, 0, 0, 0, 0, 0.01 * k]) for k in range(-6, 7)])
    return bold, crowd, perturb(near, np.array([0.012, 0.0, 0.0, 0.0, 0.0, 0.015]))


def test_planner_target_met_refuses_repeats():
    bold, crowd, present = crowded()
    refusal = bold.adds_nothing(crowd, present)
    assert refusal.code == "calibrate.little_gain" and refusal.figure("gain") < refusal.figure("best_gain")
    modest = replace(model(), target_sigma_rad=np.radians(20.0), target_sigma_m=1.0)
    met = Planner(SensorPlace(modest, T_FORWARD), 0.001, 0.05, n_places=100)
    assert met.guide(crowd).is_enough
    assert met.adds_nothing(crowd, present) is None
    assert met.adds_nothing(crowd, crowd[2]).figures["capture"] == "3"


def test_planner_asked_place_is_accepted():
    """A board at the requested placement is refused only if it was captured there."""
    bold, crowd, present = crowded()
    assert bold.adds_nothing(crowd, present, asked=present) is None
    assert bold.adds_nothing(crowd, crowd[2], asked=crowd[2]).figures["capture"] == "3"


def test_planner_unreachable_gain_is_ignored():
    bold, crowd, present = crowded()
    assert bold.adds_nothing(crowd, present, avoid=bold.candidates) is None


HERE = HeldPose(right_m=0.0, ahead_m=2.5, up_m=0.0, tilt_deg=0.0, turn_deg=0.0, roll_deg=45.0)


def coverage(planner, *changes):
    poses = [build_pose(planner.view, replace(HERE, **change)) for change in changes]
    return measure_coverage(view(), np.array(poses).reshape(-1, 4, 4), planner.candidates)


def test_coverage_of_one_board_is_zero(planner):
    assert coverage(planner) == Coverage(0, 0, 0, 0, 0)
    assert coverage(planner, {}) == Coverage(0, 0, 0, 0, 0)


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
def test_each_bar_fills_by_its_own_movement(planner, bar, changes):
    assert getattr(coverage(planner, *changes), bar) == pytest.approx(1.0, abs=0.15)
    others = replace(coverage(planner, *changes), **{bar: 0.0})
    assert max(vars(others).values()) < 0.6
