"""lce-rig repeat, as a user types it."""

import json
import shutil

import numpy as np
import pytest

from lce_rig.core.data import Image
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import perturb
from lce_rig.rig import find_profile, load_rig, parse_rig, set_value
from lce_rig.session import Session
from tests.saved_results import made_calibration, write_result

RLES = find_profile("rles").read_text(encoding="utf-8")
BENT = Finding("verdict.few_used", figures={"n_used": 3, "n_captures": 20})
COV = np.diag([4e-6] * 3 + [1e-6] * 3)


@pytest.fixture
def made(tmp_path):
    """Make a session with one capture and a result whose tangent from the nominal is given."""

    def make(name, tangent, text=RLES, seed=None, verdict="pass", lidar="lidar"):
        rig = parse_rig(text)
        seed = sum(name.encode()) if seed is None else seed
        noise = np.random.default_rng(seed).integers(0, 255, (260, 346), dtype=np.uint8)
        with Session.create(tmp_path / name, rig) as session:
            session.add_capture([Image("davis", "frames", None, noise)], [], {})
        T = load_rig("rles").nominal_extrinsics[0].to_matrix()
        calibration = made_calibration(
            perturb(T, np.array(tangent, dtype=float)),
            COV,
            camera="davis",
            lidar=lidar,
            verdict=verdict,
            findings=() if verdict == "pass" else (BENT,),
        )
        write_result(tmp_path / name / "calibration" / "result.json", rig.name, [calibration])
        return tmp_path / name

    return make


def compared(lce_rig, *sessions, code=0):
    """Give what --json prints."""
    outcome = lce_rig("repeat", *sessions, "--json")
    assert outcome.code == code, outcome.err
    return json.loads(outcome.out)


def test_repeat_agreeing_sessions_start_with_summary(lce_rig, made):
    a = made("monday", [0.001, 0, 0, 0, 0.001, 0])
    b = made("tuesday", [0, 0.002, 0, 0.001, 0, 0])
    c = made("wednesday", [0, 0, -0.002, 0, 0, 0.001])
    outcome = lce_rig("repeat", a, b, c)
    assert outcome.code == 0, outcome.err
    assert len(outcome.out.splitlines()) <= 8
    assert "odd_one:" in lce_rig("repeat", a, b, c, "--explain").out
    (pair,) = compared(lce_rig, a, b, c)["pairs"]
    assert (pair["dof"], pair["finding"]["code"]) == (12, "repeat.agree")
    assert pair["finding"]["text"][1:] in outcome.out.splitlines()[0]


def test_repeat_disagreement_exits_with_7(lce_rig, made):
    sessions = [
        made("monday", [0] * 6),
        made("tuesday", [0.001] * 6),
        made("moved", [0.02, 0, 0, 0, 0.01, 0]),
    ]
    document = compared(lce_rig, *sessions, code=7)["pairs"][0]
    assert not document["agrees"]
    assert document["odd_one"] == "moved"
    found = document["finding"]
    assert (found["code"], found["severity"], found["action_code"]) == ("repeat.disagree", "error", "odd_one")
    assert found["figures"]["odd_one"] == "moved"
    assert len(document["differences"]) == 3


def test_repeat_single_or_same_session_is_usage_error(lce_rig, made):
    a = made("monday", [0] * 6)
    assert lce_rig("repeat", a).code == 2
    assert lce_rig("repeat").code == 2
    outcome = lce_rig("repeat", a, a.parent / "." / "monday")
    assert outcome.code == 2


def test_repeat_shared_data_makes_sessions_dependent(lce_rig, made, tmp_path):
    paths = {name: made(name, [0] * 6) for name in ("monday", "wednesday")}
    assert lce_rig("repeat", paths["monday"], paths["wednesday"]).code == 0
    pixels = np.full((260, 346), 80, np.uint8)
    for name, stamp_ns in (("monday", 1), ("wednesday", None)):
        with Session.open(paths[name], writable=True) as session:
            session.add_capture([Image("davis", "frames", stamp_ns, pixels)], [], {})
    paths["copy"] = shutil.copytree(paths["monday"], tmp_path / "copy")
    for other in ("wednesday", "copy"):
        outcome = lce_rig("repeat", paths["monday"], paths[other])
        assert outcome.code == 4
        assert "monday" in outcome.err and other in outcome.err


def test_repeat_other_rig_or_lens_is_refused(lce_rig, made):
    """Another board only gives a note."""
    a = made("monday", [0] * 6)
    other = made("other", [0] * 6, set_value(RLES, "name", "rles02"))
    refocused = made("refocused", [0] * 6, set_value(RLES, "cameras.davis.intrinsics.fx_px", "355.0"))
    for session, named in ((other, "'rles02'"), (refocused, "cameras.davis.intrinsics.fx_px")):
        outcome = lce_rig("repeat", a, session)
        assert outcome.code == 4 and named in outcome.err
    board = made("board", [0.001] * 6, set_value(RLES, "board.width_m", "0.81"))
    (found,) = compared(lce_rig, a, board)["findings"]
    assert (found["code"], found["subject"]) == ("repeat.other_board", "board")
    assert found["figures"] == {"first": "monday"}


def test_repeat_failed_calibration_is_error(lce_rig, made):
    sessions = made("monday", [0] * 6), made("bad", [0] * 6, verdict="fail")
    (found,) = compared(lce_rig, *sessions, code=7)["findings"]
    assert (found["code"], found["severity"], found["subject"]) == ("repeat.failed", "error", "bad")
    assert found["figures"] == {"camera": "davis", "lidar": "lidar"}
    assert "agree, but the calibration of bad" in lce_rig("repeat", *sessions).err


def test_repeat_no_common_sensor_is_refused(lce_rig, made):
    outcome = lce_rig("repeat", made("monday", [0] * 6), made("rear", [0] * 6, lidar="rear"))
    assert outcome.code == 4
    assert "monday:" in outcome.err and "rear:" in outcome.err


def test_repeat_names_session_without_result(lce_rig, made):
    shutil.rmtree(made("unfinished", [0] * 6) / "calibration")
    a = made("monday", [0] * 6)
    outcome = lce_rig("repeat", a, a.parent / "unfinished")
    assert outcome.code == 4 and "unfinished" in outcome.err and "lce-rig calibrate" in outcome.err


def test_a_damaged_result_names_its_file(lce_rig, made):
    a, b = made("monday", [0] * 6), made("tuesday", [0] * 6)
    path = b / "calibration" / "result.json"
    document = json.loads(path.read_text())
    document["pairs"][0]["cov"] = np.zeros((6, 6)).tolist()
    document["pairs"][0] |= {"sigma_rotation_deg": 0.0, "sigma_translation_m": 0.0}
    path.write_text(json.dumps(document))
    outcome = lce_rig("repeat", a, b)
    assert outcome.code == 4
    assert "covariance" in outcome.err
    path.write_text("{")
    assert lce_rig("repeat", a, b).code == 4


@pytest.mark.long
def test_repeat_simulated_finds_moved_sensor(lce_rig, tmp_path):
    monday, tuesday, other = (tmp_path / name for name in ("monday", "tuesday", "other"))
    for session, seed, mounting in ((monday, 1, ()), (tuesday, 2, ("--mounting", "1")), (other, 3, ())):
        made = lce_rig("simulate", "--rig", "rles", session, "--captures", "8", "--seed", seed, *mounting)
        assert made.code == 0, made.err
        assert lce_rig("calibrate", session, "--no-report").code == 0
    (pair,) = compared(lce_rig, monday, tuesday)["pairs"]
    assert pair["agrees"]
    (pair,) = compared(lce_rig, monday, other, code=7)["pairs"]
    assert not pair["agrees"]
    truths = [json.loads((session / "truth.json").read_text()) for session in (monday, tuesday)]
    assert truths[0]["T_cam_lidar"] == truths[1]["T_cam_lidar"]
    assert truths[0]["captures"] != truths[1]["captures"]
