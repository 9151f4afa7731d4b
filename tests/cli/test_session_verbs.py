"""check, calibrate and verify on a simulated session, as a user types them."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.shared import contents


def read(path):
    return json.loads(path.read_text())


def test_check_explain_has_a_row_per_capture(lce_rig, simulated):
    outcome = lce_rig("check", simulated)
    assert outcome.code == 0 and len((outcome.out + outcome.err).splitlines()) <= 3
    assert "16 of 16 captures" in outcome.out
    explained = lce_rig("check", simulated, "--explain").out
    assert sum(line.startswith("0000") for line in explained.splitlines()) == 16
    first = json.loads(lce_rig("check", simulated, "--json").out)["pairs"][0]["captures"]["000000"]
    assert first["is_usable"] and first["lidar"]["n_rings"] >= 4 and first["image"]["distance_m"] > 1


def test_calibrate_simulated_matches_truth(lce_rig, session):
    outcome = lce_rig("calibrate", session, "--reference", session / "truth.json", "--json")
    assert outcome.code == 0, outcome.err
    pair = json.loads(outcome.out)["pairs"][0]
    assert pair["egt_rotation_deg"] < min(4 * pair["sigma_rotation_deg"], 0.5)
    assert pair["egt_translation_m"] < min(4 * pair["sigma_translation_m"], 0.02)
    assert pair["certificate"]["is_optimal"]
    T, truth = np.array(pair["T_cam_lidar"]), np.array(read(session / "truth.json")["T_cam_lidar"])
    assert np.abs(T - truth).max() < 0.02
    names = {path.name for path in (session / "calibration").iterdir()}
    assert {"result.json", "report.html", "extrinsics.yaml", "rles.urdf", "static_transforms.txt"} <= names


@pytest.mark.long
def test_calibrate_output_fits_twelve_lines(lce_rig, calibrated):
    first = (calibrated / "calibration" / "result.json").read_bytes()
    brief = lce_rig("calibrate", calibrated)
    assert (calibrated / "calibration" / "result.json").read_bytes() == first
    has_passed = read(calibrated / "calibration" / "result.json")["pairs"][0]["verdict"] == "pass"
    lines = (brief.out + brief.err).splitlines()
    assert brief.code == 0 and len(lines) <= (12 if has_passed else 16)
    assert max(map(len, brief.out.splitlines()[-8:])) <= 80
    assert len(lce_rig("calibrate", calibrated, "--explain").out.splitlines()) > 12


@pytest.mark.long
def test_without_rejects_captures_before_it_calibrates(lce_rig, calibrated):
    assert lce_rig("calibrate", calibrated, "--without", "4,99").code == 2
    assert not (calibrated / "rejected").exists()
    for _ in range(2):
        assert lce_rig("calibrate", calibrated, "--without", "4,000007", "--no-report").code == 0
    used = read(calibrated / "calibration" / "result.json")["pairs"][0]["captures_used"]
    assert len(used) == 14 and not {"000004", "000007"} & set(used)
    assert lce_rig("calibrate", calibrated, calibrated, "--without", "1").code == 2


@pytest.mark.long
def test_the_result_names_its_robot_sensors_and_date(lce_rig, session):
    words = ("calibrate", session, "--robot", "kestrel", "--name", "named")
    assert lce_rig(*words).code == 0
    path = session / "results" / "named" / "result.json"
    origin = read(path)["provenance"]
    # The simulation's first capture is of 14 November 2023, 22:13:20, with 4 s to the next.
    assert (origin["robot"], origin["serials"], origin["date"][:16]) == ("kestrel", {}, "2023-11-14T22:14")
    first = path.read_bytes()
    assert lce_rig(*words).code == 0 and path.read_bytes() == first
    assert lce_rig("calibrate", session, "--robot", "../kestrel").code == 2


@pytest.mark.long
def test_result_hashes_match_sha256sum(lce_rig, session):
    printed = json.loads(lce_rig("calibrate", session, "--json").out)
    document = read(session / "calibration" / "result.json")
    assert printed["inputs_sha256"] == document["inputs_sha256"]
    used = {f"captures/{name}/meta.json" for name in document["pairs"][0]["captures_used"]}
    assert set(document["inputs_sha256"]) == {"rig.yaml", *used}
    lines = "".join(f"{digest}  {path}\n" for path, digest in document["inputs_sha256"].items())
    check = ["sha256sum", "--check", "--quiet"]
    assert subprocess.run(check, input=lines, text=True, cwd=session, check=False).returncode == 0
    (session / sorted(used)[0]).write_text("{}")
    done = subprocess.run(check, input=lines, text=True, cwd=session, check=False, capture_output=True)
    assert done.returncode == 1


@pytest.mark.long
def test_reference_does_not_affect_estimate(lce_rig, session):
    plain = json.loads(lce_rig("calibrate", session, "--json").out)["pairs"][0]
    wrong = np.array(read(session / "truth.json")["T_cam_lidar"])
    wrong[:3, 3] += 1.0
    (session / "wrong.json").write_text(json.dumps({"T_cam_lidar": wrong.tolist()}))
    against = json.loads(lce_rig("calibrate", session, "--reference", session / "wrong.json", "--json").out)
    against = against["pairs"][0]
    assert against.pop("egt_translation_m") > 1.7
    assert against.pop("egt_rotation_deg") < 1
    assert plain.pop("egt_translation_m") is None
    assert plain.pop("egt_rotation_deg") is None
    assert plain == against


@pytest.mark.long
def test_verify_draws_every_capture_and_one_page(lce_rig, calibrated):
    outcome = lce_rig("verify", calibrated)
    assert outcome.code == 0 and len((outcome.out + outcome.err).splitlines()) <= 6
    assert len(lce_rig("verify", calibrated, "--explain").out.splitlines()) > 16
    pictures = sorted(path.name for path in (calibrated / "calibration" / "overlays").iterdir())
    assert pictures == [*(f"{k:06d}.png" for k in range(16)), "index.html"]


def test_verify_contradicted_result_fails(lce_rig, calibrated_few):
    path = calibrated_few / "calibration" / "result.json"
    result = read(path)
    result["pairs"][0]["T_cam_lidar"][2][3] += 0.12
    path.write_text(json.dumps(result))
    outcome = lce_rig("verify", calibrated_few, "--json")
    assert outcome.code == 7
    doubts = json.loads(outcome.out)["pairs"][0]["doubts"]
    assert {"code": "verdict.plane_residual", "limit_m": 0.03} in [
        {"code": doubt["code"], "limit_m": doubt["figures"].get("limit_m")} for doubt in doubts
    ]
    path.write_text(json.dumps(result | {"rig": "other"}))
    assert lce_rig("verify", calibrated_few).code == 4


def test_captures_of_another_session_never_count_as_used(lce_rig, calibrated_few, tmp_path):
    foreign = tmp_path / "deployed.json"
    foreign.write_bytes((calibrated_few / "calibration" / "result.json").read_bytes())
    pair = json.loads(lce_rig("verify", calibrated_few, "--result", foreign, "--json").out)["pairs"][0]
    assert not any(figures["was_used"] for figures in pair["captures"].values())


@pytest.mark.long
def test_calibrate_failed_keeps_old_result(lce_rig, calibrated_few):
    lce_rig("verify", calibrated_few)
    folder = calibrated_few / "calibration"
    before = contents(folder)
    outcome = lce_rig("calibrate", calibrated_few)
    assert outcome.code == 6
    assert lce_rig("calibrate", calibrated_few, "--channels", "freams").code != 0
    assert contents(folder) == before


def test_verify_again_keeps_user_files(lce_rig, calibrated_few):
    folder = calibrated_few / "calibration" / "overlays"
    for path in ("notes.txt", "for-the-paper.png", "report/text.md", "cam.frames.lidar/notes.txt"):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text("mine")
    (folder / "999999.png").write_text("of a capture that is gone")
    lce_rig("verify", calibrated_few)
    mine = {str(path.relative_to(folder)) for path, data in contents(folder).items() if data == b"mine"}
    assert mine == {"notes.txt", "for-the-paper.png", "report/text.md", "cam.frames.lidar/notes.txt"}
    assert (folder / "000000.png").exists() and not (folder / "999999.png").exists()


@pytest.mark.long
def test_verify_other_result_keeps_overlays(lce_rig, calibrated_few, tmp_path):
    lce_rig("verify", calibrated_few)
    own = calibrated_few / "calibration" / "overlays" / "000000.png"
    before = own.read_bytes()
    foreign = tmp_path / "deployed.json"
    result = read(calibrated_few / "calibration" / "result.json")
    result["pairs"][0]["T_cam_lidar"][0][3] += 0.02
    foreign.write_text(json.dumps(result))
    lce_rig("verify", calibrated_few, "--result", foreign)
    assert own.read_bytes() == before
    assert (calibrated_few / "overlays" / "000000.png").read_bytes() != before


@pytest.mark.long
def test_calibrate_far_from_nominal_fails(lce_rig, session):
    """Extrinsics are exported with --force only."""
    profile = session / "rig.yaml"
    document = yaml.safe_load(profile.read_text())
    nominal = document["nominal_extrinsics"][0]
    del nominal["quaternion_wxyz"]
    nominal["rpy_deg"] = [0.0, 0.0, 0.0]
    profile.write_text(yaml.safe_dump(document))
    # Typical values do not test this rig; its own CAD model does.
    assert lce_rig("calibrate", session).code == 0
    nominal["source"] = "cad"
    profile.write_text(yaml.safe_dump(document))
    outcome = lce_rig("calibrate", session)
    assert outcome.code == 7
    (pair,) = read(session / "calibration" / "result.json")["pairs"]
    assert pair["verdict"] == "fail"
    assert "verdict.far_from_nominal" in {finding["code"] for finding in pair["findings"]}
    assert not (session / "calibration" / "extrinsics.yaml").exists()
    assert lce_rig("verify", session).code == 7
    assert lce_rig("calibrate", session, "--force").code == 7
    assert "NOT FOR" in (session / "calibration" / "extrinsics.yaml").read_text()


def test_too_few_captures_name_the_minimum(lce_rig, session):
    for k in range(4, 16):
        shutil.rmtree(session / "captures" / f"{k:06d}")
    for verb in ("calibrate", "check"):
        outcome = lce_rig(verb, session)
        assert outcome.code == (6 if verb == "calibrate" else 0)
        assert "4 of 4 captures" in outcome.err + outcome.out
        assert "minimum 6" in outcome.err + outcome.out


def test_implausible_session_paths_exit_with_4(lce_rig, session):
    assert lce_rig("verify", session).code == 4  # before anything was calibrated
    assert lce_rig("simulate", "--rig", "rles", session, "--captures", "1").code == 4
    marker = session / "session.json"
    marker.write_text(marker.read_text().replace("rles", "rlfs"))
    assert lce_rig("check", session).code == 4  # of an exchanged profile


@pytest.mark.long
def test_verify_of_two_lidars_draws_other_results(lce_rig, tmp_path):
    session, other = tmp_path / "session", tmp_path / "other.json"
    profile = Path(__file__).parents[1] / "rigs" / "two_lidars.yaml"
    assert lce_rig("simulate", session, "--rig", profile, "--captures", 6).code == 0
    assert lce_rig("calibrate", session).code in (0, 7)
    other.write_bytes((session / "calibration" / "result.json").read_bytes())
    verified = lce_rig("verify", session, "--result", other)
    assert verified.code == 0 and "front and side" in verified.out
    assert (session / "overlays" / "000000.png").is_file()
