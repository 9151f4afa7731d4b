"""Each error is named by the table of explanations, first and with its size; sound captures have none."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2 as chi_squared

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.calibrate.likelihood.hypothesis import at_full_weight
from lce_rig.calibrate.options import Tolerances
from lce_rig.core.geometry import Array, fit_plane, invert, perturb, tangent_sizes, transform
from lce_rig.core.pattern import is_dark
from lce_rig.judge.causes import find_causes, hypothesis_of
from lce_rig.judge.explanations import ALL, MOUNTINGS, Table, explain, log10_chance
from lce_rig.lens.models import LensPrior
from lce_rig.rig import CalibrationSettings
from tests.calibrate.boards import BOARD, CAMERA, Scenario, simulate

REAL = Scenario(laser_bias_sigma_m=0.008, footprint_m=0.006)
KNOWN = Tolerances(LensPrior(CAMERA, 0.0, 0.0, 0.0, is_board_exact=True), 0.002, 0.003, 0.002, 0.001)
SETTINGS = EstimateSettings(laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005, tolerances=KNOWN)


def observed(n=16, seed=1):
    return simulate(n, seed, REAL)


def seen_at(observation, T_cam_board):
    return replace(observation, pose=replace(observation.image, T_cam_board=T_cam_board))


def moved(observations, is_moved, tangent):
    """Move the camera by a tangent for some captures."""
    T = perturb(np.eye(4), np.array(tangent))
    return [seen_at(o, T @ o.image.T_cam_board) if is_moved(k) else o for k, o in enumerate(observations)]


def with_points(observation, change):
    """Change the LiDAR's points (N, 3) and ring ends, by their rings."""
    lidar = observation.lidar
    points, ends = change(lidar.points, lidar.ring), change(lidar.edge_points, lidar.edge_ring)
    return replace(
        observation, surface=replace(lidar, points=points, edge_points=ends, plane=fit_plane(points)[0])
    )


def longer(offset_m=0.0, share=0.0):
    def change(points: Array, ring: Array) -> Array:
        range_m = np.linalg.norm(points, axis=1, keepdims=True)
        return points * (1 + share + offset_m / range_m)

    return lambda observations: [with_points(o, change) for o in observations]


def squares(factor):
    def farther(o):
        T = o.image.T_cam_board.copy()
        T[:3, 3] *= factor
        return seen_at(o, T)

    return lambda observations: [farther(o) for o in observations]


def shorter_on_dark(excess_m):
    def change(o):
        rays = o.lidar.points / np.linalg.norm(o.lidar.points, axis=1, keepdims=True)
        seen = transform(invert(o.lidar.T_lidar_board), o.lidar.points)[:, :2]
        points = o.lidar.points - excess_m * is_dark(BOARD, seen)[:, None] * rays
        return replace(o, surface=replace(o.lidar, points=points, plane=fit_plane(points)[0]))

    return lambda observations: [change(o) for o in observations]


def explained(observations, method="ml"):
    estimate = fit_extrinsic(observations, BOARD, replace(SETTINGS, method=method))
    joint, camera = estimate.joint
    return list(explain(at_full_weight(joint, observations, [estimate.lens], camera), ALL))


def causes(observations, method="ml"):
    return [each.gain.cause for each in explained(observations, method)]


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 8), marks=pytest.mark.long)])
def test_explain_sound_captures_finds_nothing(seeds):
    found = [causes(observed(16, seed)) for seed in seeds]
    assert found == [[]] * len(seeds)


@pytest.mark.parametrize("method", ["ml", pytest.param("paper", marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (squares(0.97), "squares"),
        (longer(offset_m=0.06), "range_offset"),
        (lambda o: moved(o, lambda k: k >= 8, [0.01, 0, 0.01, np.radians(0.8), 0, 0]), "moved"),
        pytest.param(
            lambda o: moved(o, lambda k: k >= 14, [0, 0, 0, np.radians(3), 0, 0]),
            "moved",
            marks=pytest.mark.long,
        ),
        (lambda o: moved(o, lambda k: k % 3 == 0, [0, 0, 0, 0, np.radians(0.8), 0.01]), "groups"),
        (lambda o: moved(o, lambda k: k == 7, [0, 0, 0, 0, np.radians(0.8), 0.02]), "alone"),
    ],
    ids=["squares", "range_offset", "moved", "moved_late", "groups", "alone"],
)
def test_explain_one_error_is_named_alone(change, cause, method):
    assert causes(change(observed(16, 3)), method) == [cause]


@pytest.mark.long
def test_explain_two_boards_are_named():
    observations = observed(16, 3)
    smaller = squares(0.9)(observations[8:])
    found, *_ = explained([*observations[:8], *smaller])
    assert (found.gain.cause, found.gain.explanation.cut) == ("two_boards", 8)
    assert float(found.gain.value[0]) == pytest.approx(0.1, abs=0.03)


def test_explain_groups_are_divided_exactly():
    observations = moved(observed(16, 3), lambda k: k % 4 == 1, [0, 0, 0, 0, np.radians(1.5), 0])
    found, *_ = explained(observations)
    assert found.gain.cause == "groups"
    assert np.flatnonzero(found.gain.explanation.weights).tolist() == [1, 5, 9, 13]
    assert tangent_sizes(found.change)[0] == pytest.approx(1.5, abs=0.1)


def test_explain_focus_drift_is_no_drift_of_the_mounting():
    drifted = []
    for k, o in enumerate(observed(16, 3)):
        T = o.image.T_cam_board.copy()
        T[2, 3] /= 1 + 0.01 * k / 15
        drifted.append(seen_at(o, T))
    found, *_ = explained(drifted)
    assert found.gain.cause == "focus_drift"
    assert found.gain.value[2] == pytest.approx(-0.01, abs=0.003)


def test_explain_noisy_ranges_name_no_constant_error():
    rng = np.random.default_rng(2)

    def noisy(points: Array, ring: Array) -> Array:
        range_m = np.linalg.norm(points, axis=1, keepdims=True)
        return points * (1 + 0.05 * rng.standard_normal(range_m.shape) / range_m)

    assert causes([with_points(o, noisy) for o in observed(16, 3)]) == []


@pytest.mark.long
def test_explain_drift_is_named():
    observations = [
        seen_at(o, perturb(np.eye(4), np.array([0, 0, 0, np.radians(0.1 * k), 0, 0])) @ o.image.T_cam_board)
        for k, o in enumerate(observed(16, 3))
    ]
    assert causes(observations)[0] in ("drift", "moved")


@pytest.mark.parametrize(
    ("angle_deg", "first"),
    [(0.8, 8), pytest.param(3.0, 13, marks=pytest.mark.long), pytest.param(5.0, 2, marks=pytest.mark.long)],
)
def test_explain_moved_reports_size_and_capture(angle_deg, first):
    found, *_ = explained(
        moved(observed(16, 4), lambda k: k >= first, [0, 0, 0, np.radians(angle_deg), 0, 0])
    )
    assert (found.gain.cause, found.gain.explanation.cut) == ("moved", first)
    assert tangent_sizes(found.change)[0] == pytest.approx(angle_deg, abs=0.1 if 4 < first < 12 else 0.4)


def test_explain_range_offset_reports_size():
    found, *_ = explained(longer(offset_m=0.06)(observed(16, 5)))
    assert found.after.state.lasers[0].mean() == pytest.approx(0.06, abs=0.012)


@pytest.mark.parametrize(
    "part",
    [
        slice(0, 5),
        *(pytest.param(p, marks=pytest.mark.long) for p in (slice(5, 10), slice(10), slice(0, 10, 2))),
    ],
    ids=["first", "second", "all", "even"],
)
def test_find_causes_long_ranges_in_few_captures_are_named_first(part):
    observations = longer(offset_m=0.08)(observed(10, 8))[part]
    estimate = fit_extrinsic(observations, BOARD, SETTINGS)
    hypothesis = hypothesis_of(estimate, ())
    *_, reason = find_causes(hypothesis, estimate, CalibrationSettings(), ALL)
    assert reason.gain.cause == "range_offset"
    assert reason.after.state.lasers[0].mean() == pytest.approx(0.08, abs=0.02)


@pytest.mark.long
def test_explain_scattered_images_is_no_moved_sensor():
    rng = np.random.default_rng(0)
    scattered = [
        seen_at(o, perturb(o.image.T_cam_board, rng.standard_t(3, 6) * np.repeat([0.03, 0.02], 3)))
        for o in observed(18, 6)
    ]
    assert "moved" not in causes(scattered) and "groups" not in causes(scattered)


def test_explain_level_of_noise_does_not_hide_a_move():
    """Noise fitted to captures that moved would grow until it explains the move."""
    observations = moved(observed(16, 7), lambda k: k >= 8, [0, 0, 0, np.radians(0.3), 0, 0])
    (found,) = explained(observations)
    assert found.gain.cause == "moved"
    assert found.gain.log10_chance < -6


@pytest.mark.parametrize(("excess_m", "first"), [(0.008, 7), pytest.param(0.015, 3, marks=pytest.mark.long)])
def test_find_causes_harmless_contrast_hides_no_move(excess_m, first):
    sound = shorter_on_dark(excess_m)(observed(10, 9))
    observations = moved(sound, lambda k: k >= first, [0, 0, 0, 0, np.radians(1.5), 0])
    estimate = fit_extrinsic(observations, BOARD, SETTINGS)
    hypothesis = hypothesis_of(estimate, ())
    found = find_causes(hypothesis, estimate, CalibrationSettings(), ALL)
    (reason,) = (each for each in found if each.gain.cause in MOUNTINGS)
    assert reason.gain.cause == "moved"
    assert hypothesis.captures[reason.gain.explanation.cut] == f"{first:06d}"
    assert tangent_sizes(reason.change)[0] == pytest.approx(1.5, abs=0.4)


@pytest.mark.long
def test_table_chances_of_sound_captures_are_uniform():
    """Of the chances of an absent error, one in ten is below 0.1."""
    chances = []
    for seed in range(30):
        observations = observed(14, 100 + seed)
        estimate = fit_extrinsic(observations, BOARD, SETTINGS)
        rows = Table(at_full_weight(estimate.joint[0], observations, [None]), frozenset(ALL)).rows()
        chances += [
            row.log10_chance for row in rows if row.cause in ("squares", "pattern", "range_offset", "bow")
        ]
    assert np.mean(np.array(chances) < -1) < 0.2
    assert min(chances) > -4


@pytest.mark.parametrize("freedoms", [1, 6, 40])
def test_log10_chance_far_out_continues(freedoms):
    chi2 = np.array([freedoms, 50.0, 900.0])
    expected = chi_squared.logsf(chi2, freedoms) / np.log(10)
    assert [log10_chance(value, freedoms) for value in chi2] == pytest.approx(expected, rel=1e-6)
    # Below the smallest number it continues by the leading term.
    steps = [log10_chance(chi2 + 2, freedoms) - log10_chance(chi2, freedoms) for chi2 in (1050.0, 1200.0)]
    assert steps[1] == pytest.approx(steps[0], abs=0.05)
