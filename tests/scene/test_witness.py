"""The check of results by the edges of a simulated room, without the board's."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.calibration import MOTIONS, ChannelResult, SceneOpinion, read_result
from lce_rig.core.geometry import invert, perturb, transform
from lce_rig.judge.verdict import with_opinion
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.pipeline.detect_session import detect_boards
from lce_rig.pipeline.verification import verify
from lce_rig.pipeline.witness import hear_scene, scene_views
from lce_rig.session import Session
from lce_rig.show.overlays.canvas import reduced
from tests.saved_results import write_result


@pytest.fixture(scope="module")
def heard(room):
    """The session, and the boards detected in it."""
    session = Session.open(room)
    return session, detect_boards(session)


def turned(calibration, degrees):
    T = perturb(calibration.T_cam_lidar, np.radians(degrees) * np.eye(6)[4])
    return replace(calibration, T_cam_lidar=T)


def test_hear_scene_truth_agrees(heard, seen):
    opinion = hear_scene(*heard, seen.truth)
    assert opinion.state == "agrees" and opinion.n_captures == 4
    judged = with_opinion(seen.truth, opinion)
    assert judged.verdict == "pass" and judged.scene == opinion and judged.findings == ()


@pytest.mark.parametrize("degrees", [-1.5, 1.5])
def test_hear_scene_turned_result_is_contradicted(heard, seen, degrees):
    result = turned(seen.truth, degrees)
    opinion = hear_scene(*heard, result)
    assert opinion.state == "contradicts"
    assert np.degrees(opinion.change[4]) == pytest.approx(-degrees, abs=0.5)
    judged = with_opinion(result, opinion)
    (finding,) = judged.findings
    assert finding.code == "verdict.scene" and "rotation_y" in finding.figures["axes"]
    assert judged.verdict == {"warning": "marginal", "error": "fail"}[finding.severity]


def contradiction(axis, sigmas, sigma=0.01):
    change = sigma * sigmas * np.eye(6)[MOTIONS.index(axis)]
    return SceneOpinion(6, 500, "contradicts", change, np.eye(6) * sigma**2)


@pytest.mark.parametrize(("sigmas", "verdict"), [(-5.5, "marginal"), (6.5, "fail")])
@pytest.mark.parametrize(("axis", "action"), [("rotation_x", ""), ("translation_z", "distances")])
def test_scene_contradiction_size_decides_axis_names_cause(seen, sigmas, verdict, axis, action):
    judged = with_opinion(seen.truth, contradiction(axis, sigmas))
    # The first finding is the scene's; that of a marginal result states the error bound.
    finding = judged.findings[0]
    assert judged.verdict == verdict and finding.action == action
    assert finding.figures["axes"] == (axis,)


def test_scene_witness_ignores_times_of_moving_boards(seen):
    channel = ChannelResult("frames", 9, 0.1, 0.03, 0.004)
    moving = replace(seen.truth, channel_results=(channel,))
    judged = with_opinion(moving, contradiction("rotation_y", 6))
    assert judged.findings[0].action == "times"


def test_the_board_is_left_out(heard, seen):
    session, detections = heard
    views = scene_views(session, detections, seen.truth)
    assert [view.capture for view in views] == [capture.name for capture in session.captures]
    size_m = np.array([seen.rig.board.width_m, seen.rig.board.height_m])
    for view, capture in zip(views, seen.captures, strict=True):
        on_board = transform(invert(capture.T_lidar_board["lidar"]), view.outlines.points)
        is_near = np.all(np.abs(on_board) < [*(0.5 * size_m + 0.03), 0.1], axis=1)
        assert len(view.outlines) > 20 and not is_near.any()


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


@pytest.mark.long
def test_scene_of_poles_contradicts_no_sound_extrinsics(recordings, tmp_path):
    words = ["collect", "--rig", "rlfs", "--channel", "frames", "--from", str(recordings / "rlfs03")]
    assert run([*words, str(tmp_path / "session")]) == 0
    session = Session.open(tmp_path / "session")
    detections = detect_boards(session)
    (sound, *_), _ = calibrate_detections(session.rig, detections)
    rng, spread = np.random.default_rng(1), np.linalg.cholesky(sound.cov)
    for _ in range(4):
        drawn = replace(sound, T_cam_lidar=perturb(sound.T_cam_lidar, spread @ rng.normal(size=6)))
        assert hear_scene(session, detections, drawn).state != "contradicts"


def test_scene_without_features_changes_no_verdict(seen, tmp_path):
    def even(capture):
        (image,) = capture.images
        return [replace(image, pixels=np.full_like(image.pixels, 90))]

    session = session_of(seen, tmp_path / "even", even)
    opinion = hear_scene(session, detect_boards(session), turned(seen.truth, 1.5))
    assert opinion.state == "unknown" and opinion.n_captures == 4
    assert with_opinion(seen.truth, opinion).verdict == "pass"


def test_without_frames_it_cannot_tell(seen, tmp_path):
    session = session_of(seen, tmp_path / "blind", lambda capture: [])
    opinion = hear_scene(session, detect_boards(session), seen.truth)
    assert (opinion.n_captures, opinion.n_edges, opinion.state) == (0, 0, "unknown")


def test_scene_witness_skips_damaged_capture(room, seen, tmp_path):
    copy = tmp_path / "damaged"
    shutil.copytree(room, copy)
    session = Session.open(copy)
    file = session.captures[1].path / "cam.frames.png"
    file.write_bytes(file.read_bytes()[:999])
    opinion = hear_scene(session, detect_boards(session), seen.truth)
    assert opinion.n_captures == 3 and opinion.state != "contradicts"


def test_verify_checks_the_sessions_scene(heard, seen, tmp_path):
    session, detections = heard
    write_result(tmp_path / "result.json", seen.rig.name, [turned(seen.truth, 1.5)])
    (check,) = verify(session, read_result(tmp_path / "result.json"), detections).checks
    assert check.scene.state == "contradicts"
    (found,) = [finding for finding in check.findings if finding.code == "verdict.scene"]
    assert found.action == "deployed"
    assert check.document()["scene"]["state"] == "contradicts"


def test_commands_report_scene_check(heard, room, seen, tmp_path, capsys):
    copy = tmp_path / "session"
    shutil.copytree(room, copy)
    result = turned(seen.truth, 1.5)
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
