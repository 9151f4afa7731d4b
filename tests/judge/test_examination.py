"""Checks on a result's own captures: true where nothing is wrong, and each sees what it is made for."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.calibrate.options import Tolerances
from lce_rig.core.geometry import difference, perturb, tangent_sizes
from lce_rig.judge.local_quadratic import OF_PROFILE, expand, pattern_of, scale_of
from lce_rig.judge.split_consistency import contrast_halves, find_groups, find_turned, split_findings
from lce_rig.judge.validate import validate
from lce_rig.judge.verdict import judge
from lce_rig.lens.models import LensPrior
from lce_rig.rig import CalibrationSettings, load_rig
from tests.calibrate.boards import BOARD, CAMERA, T_FORWARD, Scenario, simulate

RIG = load_rig("rlfs")
TARGET = CalibrationSettings()
FAST = EstimateSettings("paper")
LETTERS = "abcdefghijklmnop"
# Any method's result lies about as far from the truth.
T_NEAR = perturb(T_FORWARD, np.array([0.003, -0.002, 0.004, 0.001, -0.001, 0.001]))


def calibrated(n=20, seed=1):
    return fit_extrinsic(simulate(n, seed), BOARD, FAST)


def observed(n=15, seed=1, scenario=None):
    return simulate(n, seed, scenario)


def expanded(observations, T=T_NEAR, is_profile_free=False, laser=0.008, offset=0.005):
    every = expand(observations, BOARD, T, laser_bias_sigma_m=laser, range_offset_sigma_m=offset)
    return every if is_profile_free else every.hold(OF_PROFILE)


def names_of(observations):
    return tuple(seen.capture for seen in observations)


def halves(observations):
    return contrast_halves(expanded(observations).settled(), middles(observations), names_of(observations))


def groups(observations):
    return find_groups(expanded(observations).settled(), names_of(observations))


def middles(observations):
    return np.array([seen.image.T_cam_board[:3, 3] for seen in observations])


def moved(seen, T_cam_board):
    return replace(seen, image=replace(seen.image, T_cam_board=T_cam_board))


def test_the_second_opinion_is_as_near_to_the_truth_as_its_covariance_says():
    nees = []
    for seed in range(6):
        expansion = expanded(observed(15, seed, Scenario(laser_bias_sigma_m=0.008)))
        error = difference(perturb(T_NEAR, expansion.optimum()[:6]), T_FORWARD)
        nees.append(error @ np.linalg.solve(expansion.covariance()[:6, :6], error))
    # Weights that come from medians make it careful: six is the mean where it is exact.
    assert 1.0 < np.mean(nees) < 8.0


def test_squares_of_another_size_are_found_as_a_scale():
    scale, sigma = scale_of(expanded(observed(), is_profile_free=True))
    assert abs(scale) < 3 * sigma < 0.02
    smaller = [
        moved(seen, np.vstack([seen.image.T_cam_board[:3] * [1, 1, 1, 0.97], [0, 0, 0, 1]]))
        for seen in observed()
    ]
    scale, sigma = scale_of(expanded(smaller, is_profile_free=True))
    assert scale == pytest.approx(-0.03, abs=3 * sigma)


@pytest.mark.parametrize("offset_m", [(0.0, 0.0), (0.02, 0.0), (0.0, -0.02)])
def test_a_pattern_beside_its_place_on_the_plate_is_measured_and_widens_the_claim(offset_m):
    profile = RIG.board.model_copy(update={"pattern_offset_m": offset_m})
    rig, sees = RIG.model_copy(update={"board": profile}), profile.to_board()
    aside = np.eye(4)
    aside[:2, 3] = -np.array(offset_m)
    captures = [moved(seen, seen.image.T_cam_board @ aside) for seen in observed(16, 3)]
    tolerances = Tolerances(LensPrior(CAMERA, 0.0, 0.0, 0.0, is_board_exact=True), 0.002, 0.003, 0.001, 0.001)
    estimate = fit_extrinsic(captures, sees, replace(FAST, tolerances=tolerances))
    validation = validate(estimate, rig, rig.lidars["lidar"], CAMERA)
    (measured_m, cov), error = pattern_of(expanded(captures, estimate.T_cam_lidar, True)), -np.array(offset_m)
    assert (measured_m - error) @ np.linalg.solve(cov, measured_m - error) < 13.8
    assert (validation.pattern is not None) == any(offset_m)
    off = difference(estimate.T_cam_lidar, T_FORWARD)
    assert off @ np.linalg.solve(validation.cov, off) < 16.8
    verdict, findings = judge(estimate, validation, rig, "cam", "lidar", 16)
    codes = [finding.code for finding in findings if finding.severity != "note"]
    assert (verdict, codes[:1]) == (
        ("marginal", ["verdict.pattern_offset"]) if any(offset_m) else ("pass", [])
    )


@pytest.mark.parametrize(("angle_deg", "severity"), [(0.0, None), (0.6, "warning"), (2.0, "error")])
def test_a_sensor_nudged_on_the_way_is_found_with_the_capture(angle_deg, severity):
    nudge = perturb(np.eye(4), np.array([0, 0, 0, np.radians(angle_deg), 0, 0]))
    nudged = [
        moved(seen, nudge @ seen.image.T_cam_board) if k >= 12 else seen
        for k, seen in enumerate(observed(20, 4))
    ]
    contrasts = halves(nudged)
    findings = split_findings(contrasts[:1], TARGET)
    assert [finding.severity for finding in findings] == ([] if severity is None else [severity])
    if severity is not None:
        assert abs(len(contrasts[0].captures) - 8) <= 1
        assert abs(tangent_sizes(contrasts[0].apart)[0] - angle_deg) < 0.3 * angle_deg


@pytest.mark.parametrize(
    ("turned", "is_told"), [((13, 14), True), ((0, 1), True), ((14,), False)], ids=["last", "first", "one"]
)
def test_two_captures_at_an_end_that_agree_on_another_mounting_are_a_change_and_an_outlier_is_none(
    turned, is_told
):
    turn = perturb(np.eye(4), np.array([0, 0, 0, np.radians(1.5), 0, 0]))
    boards = [
        moved(seen, turn @ seen.image.T_cam_board) if k in turned else seen
        for k, seen in enumerate(observed(15, 4))
    ]
    findings = split_findings(halves(boards)[:1], TARGET)
    told = [(finding.severity, finding.figures["captures"]) for finding in findings]
    assert told == ([("error", tuple(f"{k:06d}" for k in turned))] if is_told else [])


def test_near_boards_that_say_something_else_than_far_ones_are_found():
    turn = perturb(np.eye(4), np.array([0, 0, 0, 0, np.radians(1.0), 0]))
    boards = observed(24, 5)
    distances_m = [np.linalg.norm(seen.image.T_cam_board[:3, 3]) for seen in boards]
    boards = [
        moved(seen, turn @ seen.image.T_cam_board) if distance_m < np.median(distances_m) else seen
        for seen, distance_m in zip(boards, distances_m, strict=True)
    ]
    findings = split_findings(halves(boards), TARGET)
    assert any(finding.figures.get("first") == "near" for finding in findings)


def test_boards_held_near_first_and_far_later_are_told_by_their_places_and_not_as_a_sensor_that_moved():
    turn = perturb(np.eye(4), np.array([0, 0, 0, 0, np.radians(1.0), 0]))
    boards = sorted(observed(24, 5), key=lambda seen: float(np.linalg.norm(seen.image.T_cam_board[:3, 3])))
    boards = [moved(seen, turn @ seen.image.T_cam_board) if k < 12 else seen for k, seen in enumerate(boards)]
    findings = split_findings((*halves(boards), *groups(boards)), TARGET)
    assert {finding.code for finding in findings} == {"verdict.shares_differ"}


@pytest.mark.parametrize("angle_deg", [1.0, 0.45])
def test_captures_of_a_sensor_that_moves_to_and_fro_are_told_from_the_rest(angle_deg):
    nudge = perturb(np.eye(4), np.array([0, 0, 0, np.radians(angle_deg), 0, 0]))
    away = (1, 4, 5, 9, 13)
    nudged = [
        moved(seen, nudge @ seen.image.T_cam_board) if k in away else seen
        for k, seen in enumerate(observed(16, 4))
    ]
    (finding,) = split_findings(groups(nudged), TARGET)
    assert (finding.code, finding.severity) == ("verdict.moved", "warning")
    assert (finding.figures["captures"], finding.figures["place"]) == (tuple(f"{k:06d}" for k in away), "")
    assert "5 captures (000001, 000004, 000005, 000009 ...) fit" in finding.text
    assert finding.figures["rotation_deg"] == pytest.approx(angle_deg, abs=0.3)


@pytest.mark.parametrize(("angle_deg", "least", "most"), [(0.0, 0, 0), (0.5, 3, 4)])
def test_a_sensor_that_turns_to_and_fro_about_the_line_of_sight_is_told_and_claimed(angle_deg, least, most):
    turn, told = perturb(np.eye(4), np.array([0, 0, 0, 0, 0, np.radians(angle_deg)])), 0
    for seed in range(4):
        boards = [
            moved(seen, turn @ seen.image.T_cam_board) if k % 2 else seen
            for k, seen in enumerate(observed(16, seed))
        ]
        estimate = fit_extrinsic(boards, BOARD, EstimateSettings("ml"))
        validation = validate(estimate, RIG, RIG.lidars["lidar"], CAMERA)
        verdict, findings = judge(estimate, validation, RIG, "cam", "lidar", 16)
        assert verdict == ("pass" if all(f.severity == "note" for f in findings) else "marginal")
        if any(f.code == "verdict.moved" for f in findings):
            told += 1
            off_rad = difference(estimate.T_cam_lidar, T_FORWARD)[5]
            assert abs(off_rad) < 3 * np.sqrt(validation.cov[5, 5])
    assert least <= told <= most


def test_captures_of_one_placement_count_once_in_a_search_for_turns():
    angles = np.radians(np.tile([0.0, 0.4], 4))
    turns, centres = np.array([angles, np.full(8, np.radians(0.1))]), np.tile([0.0, 0.0, 3.0], (8, 1))
    once, _ = find_turned(turns, centres, np.eye(8), "abcdefgh")
    twice, _ = find_turned(
        np.repeat(turns, 2, axis=1),
        np.repeat(centres, 2, axis=0),
        np.repeat(np.eye(8), 2, axis=1),
        "aabbccddeeffgghh",
    )
    assert once.chance < 0.001
    assert twice.chance == pytest.approx(once.chance)
    assert once.captures in (tuple("aceg"), tuple("bdfh"))
    assert len(twice.captures) == 8
    assert tangent_sizes(once.apart)[0] == pytest.approx(0.4)


def test_groups_and_changes_are_named_in_few_sessions_with_turns_of_the_noise_that_is_stated():
    rng = np.random.default_rng(1)
    found = [
        find_turned(np.array([rng.standard_normal(16), np.ones(16)]), np.ones((16, 3)), np.eye(16), LETTERS)
        for _ in range(4000)
    ]
    groups, changes = np.array([[each.chance for each in both] for both in found]).T
    for level in (0.1, 0.01, 0.001):
        n_expected = 4000 * level
        assert abs(np.count_nonzero(groups < level) - n_expected) < 4 * np.sqrt(n_expected)
        # Corrected for the number of captures tried as if they told different things.
        assert np.count_nonzero(changes < level) < n_expected + 4 * np.sqrt(n_expected)


@pytest.mark.parametrize(
    ("turned", "fewer"),
    [((14, 15), "op"), ((0, 1), "ab"), ((9, 10, 11, 12, 13, 14, 15), "jklmnop"), ((15,), "")],
)
def test_turns_tell_a_sensor_that_moved_at_a_capture_from_an_outlier(turned, fewer):
    angles = np.radians(np.tile([0.05, -0.05], 8))
    angles[[*turned]] += np.radians(0.6)
    turns, centres = np.array([angles, np.full(16, np.radians(0.12))]), np.tile([0.0, 0.0, 3.0], (16, 1))
    _, change = find_turned(turns, centres, np.eye(16), LETTERS)
    assert (change.chance < 0.001) == bool(fewer)
    if fewer:
        assert change.captures == tuple(fewer)
        assert tangent_sizes(change.apart)[0] == pytest.approx(0.6, abs=0.1)


@pytest.mark.parametrize("method", ["paper", "ml"])
def test_a_sensor_turned_about_the_line_of_sight_before_the_last_two_captures_does_not_pass(method):
    turn = perturb(np.eye(4), np.array([0, 0, 0, 0, 0, np.radians(0.8)]))
    boards = [
        moved(seen, turn @ seen.image.T_cam_board) if k >= 14 else seen
        for k, seen in enumerate(observed(16, 2))
    ]
    estimate = fit_extrinsic(boards, BOARD, EstimateSettings(method))
    validation = validate(estimate, RIG, RIG.lidars["lidar"], CAMERA)
    verdict, findings = judge(estimate, validation, RIG, "cam", "lidar", 16)
    assert (verdict, findings[0].code) == ("fail", "verdict.moved")
    off_rad = difference(estimate.T_cam_lidar, turn @ T_FORWARD)[5]
    assert abs(off_rad) < 2 * np.sqrt(validation.cov[5, 5])


def test_a_change_at_one_capture_is_not_told_as_two_groups_as_well():
    nudge = perturb(np.eye(4), np.array([0, 0, 0, np.radians(1.0), 0, 0]))
    nudged = [
        moved(seen, nudge @ seen.image.T_cam_board) if k >= 8 else seen
        for k, seen in enumerate(observed(16, 4))
    ]
    contrasts = (*halves(nudged), *groups(nudged))
    assert contrasts[-1].excess(TARGET) > 1
    (finding,) = split_findings(contrasts, TARGET)
    assert finding.figures["place"]


def test_a_sound_session_has_no_groups_more_often_than_by_chance():
    chances = [groups(observed(15, seed))[0].chance for seed in range(8)]
    assert min(chances) > 0.001
    assert np.median(chances) > 0.05


def test_a_sound_session_shows_no_contrast_more_often_than_by_chance():
    chances = [contrast.chance for seed in range(8) for contrast in halves(observed(15, seed))]
    assert np.mean(np.array(chances) < 0.001) == 0
    assert np.mean(np.array(chances) < 0.05) < 0.2


def test_few_placements_leave_nothing_to_be_left_out():
    estimate = calibrated(20, 1)
    few = {name: estimate.fitted[estimate.used[k % 3]] for k, name in enumerate(estimate.used)}
    estimate = replace(estimate, fitted=few)
    examination = validate(estimate, RIG, RIG.lidars["lidar"], CAMERA)
    assert examination.scale is None
    assert examination.contrasts == ()
    np.testing.assert_allclose(examination.cov, estimate.cov, rtol=1e-9)
