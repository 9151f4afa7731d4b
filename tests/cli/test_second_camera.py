"""A rig with a second camera of which the session holds nothing: it is said, and can be left out."""

import json
import shutil

import pytest
import yaml


@pytest.fixture
def with_second(session):
    """The simulated session, with a second camera in its profile."""
    path = session / "rig.yaml"
    document = yaml.safe_load(path.read_text())
    frames = {"frame": "right_link", "optical_frame": "right_optical"}
    right = document["cameras"]["davis"] | frames
    right["channels"] = {"frames": right["channels"]["frames"] | {"topic": "/right/image_raw"}}
    document["cameras"]["right"] = {k: v for k, v in right.items() if k != "driver"}
    path.write_text(yaml.safe_dump(document))
    return session


def cameras(session):
    document = json.loads((session / "calibration" / "result.json").read_text())
    return [pair["camera"] for pair in document["pairs"]]


def test_a_camera_without_result_exits_with_6_and_the_others_results_stand(lce_rig, with_second):
    outcome = lce_rig("calibrate", with_second)
    assert outcome.code == 6
    assert "no extrinsic of camera right" in outcome.err
    assert "No capture holds a picture of right and a scan." in outcome.err
    assert "--camera davis" in outcome.err
    assert cameras(with_second) == ["davis"]
    urdf = (with_second / "calibration" / "rles.urdf").read_text()
    assert "not in this file, for want of a result to use: right" in urdf


def test_the_camera_that_was_asked_for_is_calibrated_alone(lce_rig, with_second, calibrated_once):
    assert lce_rig("calibrate", with_second, "--camera", "davis").code == 0
    own, alone = (
        json.loads((path / "calibration" / "result.json").read_text())["pairs"]
        for path in (with_second, calibrated_once)
    )
    assert own == alone
    assert lce_rig("calibrate", with_second, "--camera", "right").code == 6
    outcome = lce_rig("calibrate", with_second, "--camera", "thermal")
    assert outcome.code == 2
    assert "there is no camera 'thermal'; there is davis, right" in outcome.err


def test_a_reference_that_names_no_sensors_is_that_of_one_camera_only(lce_rig, with_second):
    truth = json.loads((with_second / "truth.json").read_text())
    (with_second / "bare.json").write_text(json.dumps({"T_cam_lidar": truth["T_cam_lidar"]}))
    outcome = lce_rig("calibrate", with_second, "--reference", with_second / "bare.json")
    assert outcome.code == 2
    assert "names no sensors, and there are several: davis, right" in outcome.err
    outcome = lce_rig("calibrate", with_second, "--camera", "davis", "--reference", with_second / "bare.json")
    assert outcome.code == 0
    assert "reference    off by 0." in outcome.out


def test_a_result_of_two_cameras_is_checked_on_captures_of_one(lce_rig, with_second, calibrated_once):
    for path in sorted((with_second / "captures").iterdir())[3:]:
        shutil.rmtree(path)
    document = json.loads((calibrated_once / "calibration" / "result.json").read_text())
    document["pairs"].append(document["pairs"][0] | {"camera": "right"})
    (with_second / "deployed.json").write_text(json.dumps(document))
    outcome = lce_rig("verify", with_second, "--result", with_second / "deployed.json")
    assert outcome.code == 0, outcome.err
    assert "holds no captures of right.frames and lidar: not checked" in outcome.err
    assert "these captures: agree" in outcome.out
