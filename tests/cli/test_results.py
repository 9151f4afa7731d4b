"""Results with names: kept beside the current one, listed, drawn and compared."""

import json
import shutil

import numpy as np
import pytest

from lce_rig.cli.main import run
from tests.shared import contents, make_once


def listed(lce_rig, session):
    return {each["name"]: each for each in json.loads(lce_rig("results", session, "--json").out)["results"]}


@pytest.fixture
def two_results(calibrated_once, tmp_path):
    """The current result by maximum likelihood, and one by Algorithm 1, named paper."""

    def make(session):
        shutil.copytree(calibrated_once, session)
        assert run(["calibrate", str(session), "--method", "paper", "--name", "paper"]) == 0

    return shutil.copytree(make_once("two_results", make), tmp_path / "session")


@pytest.mark.long
def test_named_result_keeps_current_result(lce_rig, calibrated):
    assert lce_rig("repeat", calibrated).code == 2
    assert lce_rig("repeat", calibrated, "--name", "paper", "--name", "current").code == 4
    before = contents(calibrated / "calibration")
    assert lce_rig("calibrate", calibrated, "--method", "paper", "--name", "paper").code == 0
    assert contents(calibrated / "calibration") == before
    assert (calibrated / "results" / "paper" / "extrinsics.yaml").exists()
    found = listed(lce_rig, calibrated)
    assert list(found) == ["current", "paper"]
    assert (found["current"]["pairs"][0]["method"], found["paper"]["pairs"][0]["method"]) == ("ml", "paper")
    saved = json.loads((calibrated / "results" / "paper" / "result.json").read_text())["pairs"][0]
    assert found["paper"]["pairs"][0]["sigma_rotation_deg"] == saved["sigma_rotation_deg"]


def test_repeat_of_one_session_agrees(lce_rig, two_results):
    """The bound holds for any correlation of the two results."""
    outcome = lce_rig("repeat", two_results, "--json")
    assert outcome.code == 0, outcome.err
    (pair,) = json.loads(outcome.out)["pairs"]
    assert pair["sessions"] == ["current", "paper"] and not pair["are_independent"] and pair["agrees"]
    assert pair["finding"]["code"] == "repeat.agree"
    T = [
        np.array(json.loads((two_results / folder / "result.json").read_text())["pairs"][0]["T_cam_lidar"])
        for folder in ("calibration", "results/paper")
    ]
    turn = T[0][:3, :3] @ T[1][:3, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    assert pair["differences"][0]["rotation_deg"] == pytest.approx(angle, rel=1e-3)


def test_results_that_contradict_each_other_exit_with_7(lce_rig, two_results):
    path = two_results / "results" / "paper" / "result.json"
    document = json.loads(path.read_text())
    document["pairs"][0]["T_cam_lidar"][0][3] += 0.3
    path.write_text(json.dumps(document))
    outcome = lce_rig("repeat", two_results, "--json")
    assert outcome.code == 7
    assert json.loads(outcome.out)["pairs"][0]["finding"]["code"] == "repeat.disagree"


def test_results_outdated_broken_are_listed(lce_rig, two_results):
    used = json.loads((two_results / "results/paper/result.json").read_text())["pairs"][0]["captures_used"]
    assert not listed(lce_rig, two_results)["paper"]["is_outdated"]
    assert lce_rig("captures", two_results, "--reject", used[0]).code == 0
    assert listed(lce_rig, two_results)["paper"]["is_outdated"]
    codes = [each["code"] for each in json.loads(lce_rig("repeat", two_results, "--json").out)["findings"]]
    assert "results.outdated" in codes
    (two_results / "results" / "paper" / "result.json").write_text("{")
    outcome = lce_rig("results", two_results)
    assert outcome.code == 0 and "paper" in outcome.out
    assert listed(lce_rig, two_results)["paper"]["problem"]


@pytest.mark.parametrize("name", ["../x", "current", "previous", "", "a/b", "x" * 65])
def test_calibrate_bad_name_is_refused(lce_rig, session, name):
    before = sorted(path.name for path in session.rglob("*"))
    assert lce_rig("calibrate", session, "--name", name).code == 2
    assert sorted(path.name for path in session.rglob("*")) == before


@pytest.mark.long
def test_named_result_has_its_own_overlays(lce_rig, two_results):
    folder = two_results / "results" / "paper"
    assert lce_rig("verify", two_results, "--name", "paper").code == 0
    used = json.loads((folder / "result.json").read_text())["pairs"][0]["captures_used"]
    assert lce_rig("captures", two_results, "--reject", used[0]).code == 0
    assert lce_rig("calibrate", two_results, "--method", "paper", "--name", "paper").code == 0
    assert not (folder / "overlays").exists()
    assert (folder / "previous" / "overlays" / f"{used[0]}.png").exists()
    assert not (two_results / "overlays").exists()
    found = listed(lce_rig, two_results)
    assert found["paper/previous"]["is_outdated"] and not found["paper"]["is_outdated"]
    assert lce_rig("verify", two_results, "--name", "nope").code == 4
    assert lce_rig("calibrate", two_results, "--name", "paper/previous").code == 2
