"""`lce-rig captures` as a user types it."""

import json
import shutil

import pytest


def listed(lce_rig, session):
    return {each["name"]: each for each in json.loads(lce_rig("captures", session, "--json").out)["captures"]}


@pytest.mark.long
def test_captures_rejected_until_restored(lce_rig, calibrated):
    before = json.loads((calibrated / "calibration" / "result.json").read_text())["pairs"][0]
    name = before["captures_used"][0]
    assert listed(lce_rig, calibrated)[name]["used_by"] == [before["camera"]]
    # Leading zeros may be omitted.
    assert lce_rig("captures", calibrated, "--reject", str(int(name)), "--reason", "a mirror").code == 0
    assert listed(lce_rig, calibrated)[name]["state"] == "rejected"
    assert name not in json.loads(lce_rig("check", calibrated, "--json").out)["pairs"][0]["captures"]
    assert lce_rig("calibrate", calibrated).code == 0
    pair = json.loads((calibrated / "calibration" / "result.json").read_text())["pairs"][0]
    assert name not in pair["captures_used"] and pair["n_captures"] == before["n_captures"] - 1
    assert lce_rig("captures", calibrated, "--restore", name).code == 0
    assert lce_rig("calibrate", calibrated).code == 0
    after = json.loads((calibrated / "calibration" / "result.json").read_text())["pairs"][0]
    assert after["T_cam_lidar"] == before["T_cam_lidar"]


@pytest.mark.parametrize(
    "options",
    [
        ("--reject", "99"),
        ("--restore", "0"),
        ("--reject", "0", "--restore", "0"),
        ("--reject", "0", "--reject", "../captures/000001"),
        ("--reject", "0,99"),
    ],
)
def test_captures_wrong_name_moves_nothing(lce_rig, session, options):
    outcome = lce_rig("captures", session, *options)
    assert outcome.code == 2
    assert {each["state"] for each in listed(lce_rig, session).values()} == {"kept"}


def test_captures_accepts_several_names(lce_rig, session):
    assert lce_rig("captures", session, "--reject", "1, 2", "--reject", "4").code == 0
    rejected = {name for name, each in listed(lce_rig, session).items() if each["state"] == "rejected"}
    assert rejected == {"000001", "000002", "000004"}
    assert lce_rig("captures", session, "--restore", "1,2,4").code == 0
    assert {each["state"] for each in listed(lce_rig, session).values()} == {"kept"}


def test_captures_lists_damaged_ones_too(lce_rig, session):
    (session / "captures" / "000003" / "meta.json").write_text("{")
    outcome = lce_rig("captures", session)
    assert outcome.code == 0
    assert all(row in outcome.out for row in ("000000 to 000002", "000003", "000004 to 000015"))
    assert "000003" in listed(lce_rig, session)["000003"]["damage"]


def test_captures_of_another_session_are_added_once(lce_rig, session, tmp_path):
    shutil.copytree(session, tmp_path / "friday")
    shutil.rmtree(session / "captures" / "000003")
    for n_added in (1, 0):
        added = json.loads(lce_rig("captures", session, "--add", tmp_path / "friday", "--json").out)
        assert len(added["captures"]) == n_added
    assert lce_rig("calibrate", session, tmp_path / "friday").code == 2
