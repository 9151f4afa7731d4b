"""`lce-rig deploy`: exit codes, what is printed for machines, and options that exclude each other."""

import json

import pytest


@pytest.fixture
def targets(calibrated_once, tmp_path):
    """Targets of this computer, in a file."""
    path = tmp_path / "deploy.yaml"
    path.write_text(
        "targets:\n"
        "  here: {to: robot}\n"
        "  failing: {to: robot, run: 'echo out of order; exit 5'}\n"
        "  theirs: {to: /proc/nowhere}\n"
    )
    return path


def words(session, targets, *more, target="here"):
    return ("deploy", session, "--target", target, "--targets", targets, *more)


def test_deploy_dry_run_status_and_rollback(lce_rig, calibrated_once, targets, tmp_path):
    dry = json.loads(lce_rig(*words(calibrated_once, targets, "--dry-run", "--json")).out)
    assert dry["current"] is None and not (tmp_path / "robot").exists()
    done = json.loads(lce_rig(*words(calibrated_once, targets, "--json")).out)
    assert done["current"]["files"] == dry["new"]["files"]
    shown = json.loads(lce_rig(*words(calibrated_once, targets, "--status", "--json")).out)
    assert shown["current"] == done["current"] and shown["changed_there"] == {}
    text = lce_rig(*words(calibrated_once, targets, "--status"))
    assert text.code == 0 and done["current"]["name"] in text.out
    dry = lce_rig(*words(calibrated_once, targets, "--dry-run"))
    assert dry.code == 0 and len(dry.out.splitlines()) <= 3
    targets.write_text(targets.read_text().replace("{to: robot}", "{to: robot, formats: [urdf]}"))
    diff = lce_rig(*words(calibrated_once, targets, "--dry-run", "--diff")).out.splitlines()
    assert any("0.000 deg, 0.0 mm" in line for line in diff)
    assert {line[:4] for line in diff if line.endswith("/extrinsics.yaml")} == {"--- ", "+++ "}
    assert lce_rig(*words(calibrated_once, targets, "--diff")).code == 2
    assert lce_rig(*words(calibrated_once, targets, "--rollback")).code == 8


def test_exit_codes(lce_rig, calibrated_once, targets, tmp_path):
    failed = lce_rig(*words(calibrated_once, targets, target="failing"))
    assert failed.code == 9
    assert (tmp_path / "robot" / "current" / "result.json").exists()
    assert lce_rig(*words(calibrated_once, targets, target="theirs")).code == 8
    assert lce_rig(*words(calibrated_once, targets, "--force")).code == 2
    assert lce_rig(*words(calibrated_once, targets, "--reason", "x")).code == 2
    assert lce_rig(*words(calibrated_once, targets, "--status", "--rollback")).code == 2
    assert lce_rig(*words(calibrated_once, targets, "--release", "x")).code == 2
    assert lce_rig(*words(calibrated_once, targets, target="unknown")).code == 2
    assert lce_rig(*words(calibrated_once, targets, "--name", "nothing")).code == 4
