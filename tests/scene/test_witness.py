"""The scene's opinion on results of a simulated room, without the board's edges."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.calibration import AxisDrift, ChannelResult, SceneOpinion, read_result
from lce_rig.core.geometry import invert, perturb, transform
from lce_rig.judge.verdict import with_opinion
from lce_rig.pipeline.detect_session import detect
from lce_rig.pipeline.verification import verify
from lce_rig.pipeline.witness import hear_scene, scene_views
from lce_rig.session import Session
from lce_rig.show.overlays.canvas import reduced
from tests.saved_results import write_result


@pytest.fixture(scope="module")
def heard(room):
    """The session, and the boards detected in it."""
    session = Session.open(room)
    return session, detect(session)


def turned(calibration, degrees):
    T = perturb(calibration.T_cam_lidar, np.radians(degrees) * np.eye(6)[4])
    return replace(calibration, T_cam_lidar=T)


def test_the_truth_agrees_in_the_axes_that_the_scene_tells(heard, seen):
    opinion = hear_scene(*heard, seen.truth)
    assert opinion.state == "agrees" and opinion.n_captures == 4
    assert {axis.axis for axis in opinion.of("unchanged")} >= {"rotation_y", "translation_x"}
    judged = with_opinion(seen.truth, opinion)
    assert judged.verdict == "pass" and judged.scene == opinion and judged.findings == ()


@pytest.mark.parametrize("degrees", [-1.0, 1.0])
def test_a_result_turned_by_1_deg_is_contradicted_by_that(heard, seen, degrees):
    result = turned(seen.truth, degrees)
    opinion = hear_scene(*heard, result)
    assert opinion.state == "contradicts"
    assert opinion.strongest.axis == "rotation_y"
    assert opinion.strongest.change == pytest.approx(-degrees, abs=3 * opinion.strongest.sigma)
    judged = with_opinion(result, opinion)
    (finding,) = judged.findings
    assert finding.code == "verdict.scene" and finding.figures["axis"] == "rotation_y"
    assert judged.verdict == {"warning": "marginal", "error": "fail"}[finding.severity]


@pytest.mark.parametrize(("sigmas", "verdict"), [(-4.0, "marginal"), (6.0, "fail")])
@pytest.mark.parametrize(("axis", "action"), [("rotation_x", ""), ("translation_z", "distances")])
def test_the_size_of_a_contradiction_decides_and_its_axis_names_the_cause(
    seen, sigmas, verdict, axis, action
):
    slight = AxisDrift("rotation_y", "changed", 0.31, 0.1, 0.5)
    strong = AxisDrift(axis, "changed", 0.02 * sigmas, 0.02, 0.1)
    judged = with_opinion(seen.truth, SceneOpinion(6, 500, (strong, slight)))
    # The first one is the scene's; that of a marginal result says how wrong it may be.
    finding = judged.findings[0]
    assert judged.verdict == verdict and finding.action == action
    assert finding.figures["axis"] == axis


def test_of_moving_boards_the_times_may_be_wrong(seen):
    channel = ChannelResult("frames", 9, 0.1, 0.03, 0.004)
    moving = replace(seen.truth, channel_results=(channel,))
    slight = AxisDrift("rotation_y", "changed", 0.31, 0.1, 0.5)
    judged = with_opinion(moving, SceneOpinion(6, 500, (slight,)))
    assert judged.findings[0].action == "times"


def test_the_board_is_left_out(heard, seen):
    session, detections = heard
    views = scene_views(session, detections, seen.truth)
    assert [view.capture for view in views] == [capture.name for capture in session.captures]
    size_m = np.array([seen.rig.board.width_m, seen.rig.board.height_m])
    for view, capture in zip(views, seen.captures, strict=True):
        on_board = transform(invert(capture.T_lidar_board["lidar"]), view.edges.points)
        is_near = np.all(np.abs(on_board) < [*(0.5 * size_m + 0.03), 0.1], axis=1)
        assert len(view.edges) > 20 and not is_near.any()


def test_thumbnails_are_kept_of_every_image_decoded(heard, seen):
    session, detections = heard
    thumbnails = {}
    views = scene_views(session, detections, seen.truth, thumbnails)
    (camera,) = session.rig.cameras
    assert list(thumbnails) == [(view.capture, camera, "frames") for view in views]
    for (name, *_), kept in thumbnails.items():
        expected = reduced(session.capture(name).image(camera, "frames").pixels)
        assert np.array_equal(kept.pixels, expected.pixels) and kept.width_px == expected.width_px


def session_of(seen, path, images_of):
    with Session.create(path, seen.rig) as session:
        for capture in seen.captures:
            session.add_capture(images_of(capture), capture.scans, {})
    return Session.open(path)


def test_a_scene_without_features_cannot_tell_and_changes_no_verdict(seen, tmp_path):
    def even(capture):
        (image,) = capture.images
        return [replace(image, pixels=np.full_like(image.pixels, 90))]

    session = session_of(seen, tmp_path / "even", even)
    opinion = hear_scene(session, detect(session), turned(seen.truth, 1.0))
    assert opinion.state == "unknown" and opinion.n_captures == 4
    assert with_opinion(seen.truth, opinion).verdict == "pass"


def test_without_frames_it_cannot_tell(seen, tmp_path):
    session = session_of(seen, tmp_path / "blind", lambda capture: [])
    assert hear_scene(session, detect(session), seen.truth) == SceneOpinion(0, 0)


def test_a_damaged_capture_costs_itself_only(room, seen, tmp_path):
    copy = tmp_path / "damaged"
    shutil.copytree(room, copy)
    session = Session.open(copy)
    file = session.captures[1].path / "cam.frames.png"
    file.write_bytes(file.read_bytes()[:999])
    opinion = hear_scene(session, detect(session), seen.truth)
    assert opinion.n_captures == 3 and opinion.state != "contradicts"


def test_verify_hears_the_session_s_own_scene(heard, seen, tmp_path):
    session, detections = heard
    write_result(tmp_path / "result.json", seen.rig.name, [turned(seen.truth, 1.0)])
    (check,) = verify(session, read_result(tmp_path / "result.json"), detections).checks
    assert check.scene.state == "contradicts"
    (found,) = [finding for finding in check.findings if finding.code == "verdict.scene"]
    assert found.action == "deployed"
    assert check.document()["scene"]["state"] == "contradicts"


def test_the_verbs_tell_the_opinion(heard, room, seen, tmp_path, capsys):
    copy = tmp_path / "session"
    shutil.copytree(room, copy)
    result = turned(seen.truth, 1.0)
    write_result(tmp_path / "result.json", seen.rig.name, [result])
    assert run(["verify", str(copy), "--result", str(tmp_path / "result.json")]) == 7
    write_result(
        copy / "calibration" / "result.json",
        seen.rig.name,
        [with_opinion(result, hear_scene(*heard, result))],
    )
    capsys.readouterr()
    assert run(["results", str(copy), "--json"]) == 0
    (stored,) = json.loads(capsys.readouterr().out)["results"]
    assert stored["pairs"][0]["scene"] == "contradicts"
