"""The scene's opinion on results of a simulated room, without the board's edges."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.geometry import perturb
from lce_rig.core.scene_opinion import SceneOpinion
from lce_rig.export.result import read_result, write_result
from lce_rig.pipeline.detect_session import detect
from lce_rig.pipeline.verification import verify
from lce_rig.pipeline.witness import hear_scene
from lce_rig.session import Session
from lce_rig.validation.verdict import with_opinion


@pytest.fixture(scope="module")
def heard(room):
    """The session, and the boards detected in it."""
    session = Session.open(room)
    return session, detect(session)


def turned(calibration, degrees):
    T = perturb(calibration.T_cam_lidar, np.radians(degrees) * np.eye(6)[4])
    return replace(calibration, T_cam_lidar=T)


def test_the_truth_agrees_in_the_axes_that_the_scene_tells(heard, seen) -> None:
    opinion = hear_scene(*heard, seen.truth)
    assert opinion.state == "agrees" and opinion.n_captures == 4
    assert {axis.axis for axis in opinion.of("agrees")} >= {"rotation_y", "translation_x"}
    judged = with_opinion(seen.truth, opinion)
    assert judged.verdict == "pass" and judged.scene == opinion and judged.findings == ()


@pytest.mark.parametrize("degrees", [-1.0, 1.0])
def test_a_result_turned_by_1_deg_is_contradicted_by_that(heard, seen, degrees) -> None:
    result = turned(seen.truth, degrees)
    opinion = hear_scene(*heard, result)
    assert opinion.state == "contradicts"
    assert opinion.strongest.axis == "rotation_y"
    assert opinion.strongest.change == pytest.approx(-degrees, abs=3 * opinion.strongest.sigma)
    judged = with_opinion(result, opinion)
    (finding,) = judged.findings
    assert finding.code == "verdict.scene" and finding.figures["axis"] == "rotation_y"
    assert judged.verdict == {"warning": "marginal", "error": "fail"}[finding.severity]


def session_of(seen, path, images_of):
    with Session.create(path, seen.rig) as session:
        for capture in seen.captures:
            session.add_capture(images_of(capture), capture.scans, {})
    return Session.open(path)


def test_a_scene_without_features_cannot_tell_and_changes_no_verdict(seen, tmp_path) -> None:
    def even(capture):
        (image,) = capture.images
        return [replace(image, pixels=np.full_like(image.pixels, 90))]

    session = session_of(seen, tmp_path / "even", even)
    opinion = hear_scene(session, detect(session), turned(seen.truth, 1.0))
    assert opinion.state == "unknown" and opinion.n_captures == 4
    assert with_opinion(seen.truth, opinion).verdict == "pass"


def test_without_frames_it_cannot_tell(seen, tmp_path) -> None:
    session = session_of(seen, tmp_path / "blind", lambda capture: [])
    assert hear_scene(session, detect(session), seen.truth) == SceneOpinion(0, 0)


def test_a_damaged_capture_costs_itself_only(room, seen, tmp_path) -> None:
    copy = tmp_path / "damaged"
    shutil.copytree(room, copy)
    session = Session.open(copy)
    file = session.captures[1].path / "cam.frames.png"
    file.write_bytes(file.read_bytes()[:999])
    opinion = hear_scene(session, detect(session), seen.truth)
    assert opinion.n_captures == 3 and opinion.state != "contradicts"


def test_opinions_are_written_and_read_back_unchanged(heard, seen, tmp_path) -> None:
    results = [with_opinion(r, hear_scene(*heard, r)) for r in (seen.truth, turned(seen.truth, 1.0))]
    results.append(replace(seen.truth, scene=SceneOpinion(2, 7)))
    for k, result in enumerate(results):
        write_result(tmp_path / f"{k}.json", seen.rig.name, [result])
        (back,) = read_result(tmp_path / f"{k}.json").pairs
        assert back.scene == result.scene
        assert back.findings == result.findings and back.verdict == result.verdict


def test_a_result_without_an_opinion_is_read_as_such(room) -> None:
    assert read_result(room / "calibration" / "result.json").pairs[0].scene is None


def test_verify_hears_the_session_s_own_scene(heard, seen, tmp_path) -> None:
    session, detections = heard
    write_result(tmp_path / "result.json", seen.rig.name, [turned(seen.truth, 1.0)])
    (check,) = verify(session, read_result(tmp_path / "result.json"), detections).checks
    assert check.scene.state == "contradicts"
    (found,) = [finding for finding in check.findings if finding.code == "verdict.scene"]
    assert found.action == "deployed"
    assert check.document()["scene"]["state"] == "contradicts"
