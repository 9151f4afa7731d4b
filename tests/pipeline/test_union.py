"""One estimate from several sessions: better than each alone, and only of sensors that were not moved."""

from dataclasses import replace

import numpy as np
import pytest

import lce_rig as lce
from lce_rig.calibrate.observations import group_placements
from lce_rig.core.calibration import ResultFile
from lce_rig.core.errors import NotEnoughDataError, ResultRefusedError, SessionError, UsageError
from lce_rig.core.geometry import difference, perturb
from lce_rig.core.results import Observation
from lce_rig.detect.detection import Detections
from lce_rig.judge.reach import covariance_alone
from lce_rig.pipeline.calibrate_sessions import join_detections
from lce_rig.pipeline.result_files import as_named_in, inputs_sha256
from lce_rig.rig import find_profile, parse_rig, set_value
from tests.calibrate.boards import CAMERA, T_FORWARD, simulate

# The profile of the simulated boards: their lens is in it.
TEXT = find_profile("rlfs").read_text(encoding="utf-8")
for _key in ("fx_px", "fy_px", "cx_px", "cy_px"):
    TEXT = set_value(TEXT, f"cameras.cam.intrinsics.{_key}", str(getattr(CAMERA, _key)))
FAST = lce.CalibrateOptions(n_draws=0)
MOVED = perturb(T_FORWARD, np.array([0.03, 0, 0, 0, 0.01, 0]))


def profile(laser_m=0.0, offset_m=0.0):
    lines = f"    laser_bias_sigma_m: {laser_m}\n    range_offset_sigma_m: {offset_m}\n"
    return TEXT.replace("    rate_hz: 10\n", lines, 1)


@pytest.fixture
def make(tmp_path):
    """Make a session without captures, whose boards are given as detections."""

    def made(name, text=TEXT):
        return lce.Session.create(tmp_path / name, parse_rig(text))

    return made


def seen(n, seed, T_cam_lidar=T_FORWARD):
    captures = simulate(n, seed, T_cam_lidar=T_cam_lidar)
    images = {item.capture: item.image for item in captures}
    return Detections({("cam", "frames"): images}, {"lidar": {i.capture: list(i.places) for i in captures}})


@pytest.mark.long
def test_one_estimate_of_two_sessions_is_nearer_to_the_truth_than_each_and_says_so(make):
    sessions = [make(name, profile()) for name in ("monday", "tuesday")]
    errors, nees, ratios = {1: [], 2: []}, [], []
    for seed in range(3):
        found = [seen(12, 2 * seed), seen(12, 2 * seed + 1)]
        alone = [lce.calibrate(*each, options=FAST).pairs[0] for each in zip(sessions, found, strict=True)]
        (both,) = lce.calibrate(sessions, found, options=FAST).pairs
        errors[1] += [difference(c.T_cam_lidar, T_FORWARD) for c in alone]
        errors[2].append(error := difference(both.T_cam_lidar, T_FORWARD))
        nees.append(error @ np.linalg.solve(covariance_alone(both), error))
        scatter_m = [c.diagnostics.sigma_scatter_translation_m for c in (both, *alone)]
        ratios.append(scatter_m[0] / np.mean(scatter_m[1:]))
        assert len(both.captures_used) == 24
    rms = {n: np.sqrt(np.mean(np.square(own), axis=0)) for n, own in errors.items()}
    assert np.linalg.norm(rms[2][:3]) < 0.9 * np.linalg.norm(rms[1][:3])
    # The lens, which the profile has exactly here, decides the rotation; fewer images leave it there.
    assert np.linalg.norm(rms[2][3:]) < 1.3 * np.linalg.norm(rms[1][3:])
    assert np.mean(nees) < 12
    assert 0.4 < np.mean(ratios) < 0.85


@pytest.mark.long
def test_what_all_sessions_share_is_not_averaged_out(make):
    sessions = [make(name, profile(0.008, 0.005)) for name in ("monday", "tuesday")]
    found = [seen(12, 0), seen(12, 1)]
    plain = lce.CalibrateOptions("paper", n_draws=0)
    (alone,) = lce.calibrate(str(sessions[0].path), found[0], options=plain).pairs
    (both,) = lce.calibrate(sessions, found, options=plain).pairs
    parts = [c.diagnostics.sigma_systematic_translation_m for c in (alone, both)]
    assert parts[1] > 0.9 * parts[0]
    scatter = [c.diagnostics.sigma_scatter_translation_m for c in (alone, both)]
    assert scatter[1] < 0.85 * scatter[0]


def test_placements_of_different_sessions_are_independent_wherever_the_board_stood():
    (item,) = simulate(1, 0)
    board = Observation("a", item.image, item.lidar)
    same = [replace(board, capture=name) for name in ("a", "b")]
    other = [replace(each, session="tuesday") for each in same]
    assert group_placements([*same, *other]).tolist() == [0, 0, 1, 1]
    joined = join_detections({"monday": seen(2, 0), "tuesday": seen(2, 0)})
    assert joined.session_of["tuesday/000001"] == "tuesday"
    assert len(joined.images["cam", "frames"]) == 4


@pytest.mark.long
def test_sessions_between_which_a_sensor_moved_are_refused_with_figures(make):
    monday, tuesday, moved = (make(name) for name in ("monday", "tuesday", "moved"))
    found = [seen(12, 0), seen(12, 2, MOVED), seen(12, 1)]
    with pytest.raises(ResultRefusedError) as two:
        lce.calibrate([monday, moved], found[:2], options=FAST)
    assert two.value.exit_code == 7
    assert "monday" in two.value.what and "moved" in two.value.what
    with pytest.raises(ResultRefusedError) as three:
        lce.calibrate([monday, moved, tuesday], found, options=FAST)
    assert "moved" in three.value.hint


def test_a_session_too_small_to_be_compared_is_named(make):
    with pytest.raises(NotEnoughDataError, match="tuesday alone"):
        lce.calibrate([make("monday"), make("tuesday")], [seen(12, 0), seen(2, 1)], options=FAST)


@pytest.mark.parametrize(
    ("key", "value"),
    [("board.width_m", "0.81"), ("cameras.cam.intrinsics.fx_px", "905.0"), ("lidars.lidar.rate_hz", "20")],
)
def test_sessions_of_another_board_lens_or_lidar_are_refused_with_the_key(make, key, value):
    sessions = [make("monday"), make("tuesday", set_value(TEXT, key, value))]
    with pytest.raises(SessionError, match=key.split(".")[-1]):
        lce.calibrate(sessions, [seen(12, 0), seen(12, 1)], options=FAST)


def test_a_session_twice_none_and_detections_of_one_are_usage_errors(make):
    monday, tuesday = make("monday"), make("tuesday")
    for sessions, found in (([monday, monday], None), ([], None), ([monday, tuesday], [seen(12, 0)])):
        with pytest.raises(UsageError):
            lce.calibrate(sessions, found, options=FAST)


def test_targets_and_texts_of_the_profiles_may_differ(make):
    other = make("tuesday", set_value(TEXT, "calibration.target_sigma_deg", "0.5"))
    result = lce.calibrate([make("monday"), other], [seen(12, 0), seen(12, 1)], options=FAST)
    assert list(result.sessions) == ["monday", "tuesday"]
    assert "repeat.agree" in {finding.code for finding in result.pairs[0].findings}
    saved = ResultFile(rig="rlfs", pairs=result.pairs, sessions=dict.fromkeys(result.sessions, "."))
    assert as_named_in(other, saved)[0].captures_used == ()
    with pytest.raises(SessionError, match="000000"):
        inputs_sha256(result.session, result.pairs, result.sessions)


@pytest.mark.long
def test_sessions_without_a_scene_keep_the_result_of_the_boards(make):
    sessions, found = [make("monday"), make("tuesday")], [seen(12, 0), seen(12, 1)]
    (by_boards,) = lce.calibrate(sessions, found, options=FAST).pairs
    (both,) = lce.calibrate(sessions, found, options=FAST, use_scene=True).pairs
    assert (both.scene_share.state, both.scene_share.n_captures) == ("unknown", 0)
    np.testing.assert_array_equal(both.cov, by_boards.cov)


def test_channels_of_one_camera_give_one_result_of_one_session_and_of_several(make):
    text = set_value(TEXT, "cameras.cam.channels.events", "{kind: events}")
    sessions, both = [make("monday", text), make("tuesday", text)], []
    for seed in (0, 1):
        detections = seen(12, seed)
        images = detections.images["cam", "frames"]
        both.append(Detections({("cam", name): images for name in ("frames", "events")}, detections.lidars))
    (alone,) = lce.calibrate(sessions[0], both[0], options=FAST).pairs
    (together,) = lce.calibrate(sessions, both, options=FAST).pairs
    assert set(alone.channels) == set(together.channels) == {"frames", "events"}
