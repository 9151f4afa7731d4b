"""A rig with a second camera without captures: it is reported, and can be omitted."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from lce_rig.cli.main import run
from lce_rig.core.geometry import difference
from lce_rig.rig import dump_rig, load_rig
from tests.shared import half_size


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


@pytest.mark.long
def test_camera_without_result_exits_with_6(lce_rig, with_second):
    outcome = lce_rig("calibrate", with_second)
    assert outcome.code == 6
    assert "camera right" in outcome.err and "--camera davis" in outcome.err
    assert cameras(with_second) == ["davis"]
    urdf = (with_second / "calibration" / "rles.urdf").read_text()
    (comment,) = (line for line in urdf.splitlines() if "not in" in line)
    assert "right" in comment and "davis" not in comment


@pytest.mark.long
def test_requested_camera_is_calibrated_alone(lce_rig, with_second, calibrated_once):
    assert lce_rig("calibrate", with_second, "--camera", "davis").code == 0
    own, alone = (
        json.loads((path / "calibration" / "result.json").read_text())["pairs"]
        for path in (with_second, calibrated_once)
    )
    assert own == alone
    assert lce_rig("calibrate", with_second, "--camera", "right").code == 6
    outcome = lce_rig("calibrate", with_second, "--camera", "thermal")
    assert outcome.code == 2
    assert "'thermal'" in outcome.err and "davis, right" in outcome.err


@pytest.mark.long
def test_reference_without_names_needs_single_camera(lce_rig, with_second):
    truth = json.loads((with_second / "truth.json").read_text())
    (with_second / "bare.json").write_text(json.dumps({"T_cam_lidar": truth["T_cam_lidar"]}))
    outcome = lce_rig("calibrate", with_second, "--reference", with_second / "bare.json")
    assert outcome.code == 2
    assert "bare.json" in outcome.err and "davis, right" in outcome.err
    outcome = lce_rig("calibrate", with_second, "--camera", "davis", "--reference", with_second / "bare.json")
    assert outcome.code == 0
    (line,) = (line for line in outcome.out.splitlines() if line.split()[:1] == ["reference"])
    assert " 0." in line and "deg" in line


def test_a_result_of_two_cameras_is_checked_on_captures_of_one(lce_rig, with_second, calibrated_once):
    for path in sorted((with_second / "captures").iterdir())[3:]:
        shutil.rmtree(path)
    document = json.loads((calibrated_once / "calibration" / "result.json").read_text())
    document["pairs"].append(document["pairs"][0] | {"camera": "right"})
    (with_second / "deployed.json").write_text(json.dumps(document))
    outcome = lce_rig("verify", with_second, "--result", with_second / "deployed.json")
    assert outcome.code == 0, outcome.err
    (warning,) = (line for line in outcome.err.splitlines() if "not checked" in line)
    assert "right.frames" in warning
    assert "captures agree" in outcome.out


@pytest.fixture(scope="module")
def of_two(tmp_path_factory):
    """A simulated session of two cameras."""
    folder = tmp_path_factory.mktemp("two")
    profile, session = folder / "rig.yaml", folder / "session"
    given = load_rig(str(Path(__file__).parents[1] / "rigs" / "two_cameras.yaml"))
    profile.write_text(dump_rig(half_size(given)))
    assert run(["simulate", "--rig", str(profile), str(session), "--captures", "10", "--seed", "2"]) == 0
    return session


@pytest.mark.long
@pytest.mark.parametrize("method", ["paper", "ml"])
def test_two_cameras_are_near_truth_and_each_other(lce_rig, of_two, tmp_path, method):
    session = tmp_path / "session"
    shutil.copytree(of_two, session)
    outcome = lce_rig("calibrate", session, "--method", method)
    assert outcome.code == 0, outcome.out + outcome.err
    pairs, truth = (
        {pair["camera"]: pair for pair in json.loads((session / name).read_text())["pairs"]}
        for name in ("calibration/result.json", "truth.json")
    )
    T = {camera: np.array(pair["T_cam_lidar"]) for camera, pair in pairs.items()}
    exact = {camera: np.array(pair["T_cam_lidar"]) for camera, pair in truth.items()}
    for camera, other in (("left", "right"), ("right", "left")):
        error, cov = difference(T[camera], exact[camera]), np.array(pairs[camera]["cov"])
        # Of six chi squares one in three thousand is larger.
        assert error @ np.linalg.solve(cov, error) < 25
        assert np.degrees(np.linalg.norm(error[3:])) < 0.3 and np.linalg.norm(error[:3]) < 0.015
        (seen,) = pairs[camera]["other_cameras"]
        assert seen["camera"] == other and seen["n_captures"] >= 8
        assert pairs[camera]["estimated_with"] == ([other] if method == "ml" else [])
    assert lce_rig("verify", session).code == 0
