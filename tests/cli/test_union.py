"""lce-rig calibrate with several sessions, as a user types it."""

import json
import shutil

import pytest


@pytest.fixture
def halves(simulated, tmp_path):
    """The simulated session as two, each with every second capture."""
    paths = [tmp_path / "monday", tmp_path / "tuesday"]
    for k, path in enumerate(paths):
        shutil.copytree(simulated, path)
        for capture in sorted((path / "captures").iterdir())[1 - k :: 2]:
            shutil.rmtree(capture)
    return paths


@pytest.mark.long
def test_several_sessions_give_one_result_in_the_first_and_change_nothing_else(lce_rig, halves):
    monday, tuesday = halves
    outcome = lce_rig("calibrate", monday, tuesday)
    assert outcome.code == 0, outcome.err
    assert not (monday / "calibration").exists()
    assert not (tuesday / "calibration").exists()
    union = monday / "results" / "union"
    document = json.loads((union / "result.json").read_text())
    assert document["sessions"] == {"monday": ".", "tuesday": "../tuesday"}
    used = document["pairs"][0]["captures_used"]
    assert {name.split("/")[0] for name in used} == {"monday", "tuesday"}
    assert (union / "extrinsics.yaml").exists()
    (listed,) = json.loads(lce_rig("results", monday, "--json").out)["results"]
    assert (listed["name"], listed["is_outdated"]) == ("union", False)
    for words in ((monday, "--name", "union"), (tuesday, "--result", union / "result.json")):
        checked = lce_rig("verify", *words, "--explain", "--output", monday.parent / "drawn")
        assert checked.code == 0, checked.err
        assert "not used" not in checked.out
    again = lce_rig("calibrate", tuesday, monday, "--name", "both")
    assert again.code == 0, again.err
    assert (tuesday / "results" / "both" / "result.json").exists()
    shutil.rmtree(next(iter(sorted((tuesday / "captures").iterdir()))))
    (listed,) = json.loads(lce_rig("results", monday, "--json").out)["results"]
    assert listed["is_outdated"]


def test_copies_of_a_session_are_refused(lce_rig, simulated, tmp_path):
    shutil.copytree(simulated, tmp_path / "copy")
    outcome = lce_rig("calibrate", simulated, tmp_path / "copy")
    assert outcome.code == 4
    assert "are not independent" in outcome.err
