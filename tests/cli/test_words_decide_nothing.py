"""With every rendered text replaced by its code, the verbs find, judge and exit as they do with words."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from lce_rig.session import Session

WORDS = {"text", "action", "cause", "reasons"}


def facts(document):
    """Leave out of a document what is said in words."""
    if isinstance(document, dict):
        return {key: facts(value) for key, value in document.items() if key not in WORDS}
    return [facts(value) for value in document] if isinstance(document, list) else document


def findings(document):
    """Find every finding and refusal in a document."""
    values = (
        document.values() if isinstance(document, dict) else document if isinstance(document, list) else ()
    )
    if isinstance(document, dict) and "code" in document:
        yield document
    for value in values:
        yield from findings(value)


@pytest.fixture
def spoilt(session):
    """A session not searched yet: of sixteen captures ten are sound, the rest refused for various causes."""
    captures = Session.open(session).captures[10:]
    spoilt = [(capture.image("davis", "frames"), capture.scan("lidar")) for capture in captures]
    for capture in captures:
        shutil.rmtree(capture.path)
    with Session.open(session, writable=True) as opened:
        for k, (image, scan) in enumerate(spoilt):
            black, cut = np.zeros_like(image.pixels), image.pixels.copy()
            cut[:, cut.shape[1] // 2 :] = 90
            few = np.arange(len(scan.points)) % 40 == 0
            kept = few if k == 3 else np.zeros(len(few), bool) if k == 4 else np.ones(len(few), bool)
            pixels = (black, cut, image.pixels[:, ::-1].copy())[k] if k < 3 else image.pixels
            opened.add_capture([replace(image, pixels=pixels)], [scan.select(kept)], {})
    shutil.rmtree(session / "detections")
    return session


@pytest.fixture
def run_twice(lce_rig, tmp_path, request):
    """Run a verb with and without words on copies of sessions; gives its exit code and what it prints."""

    def call(verb, *sessions):
        done = []
        for is_mute in (False, True):
            if is_mute:
                request.getfixturevalue("mute")
            copies = [tmp_path / ("mute" if is_mute else "told") / path.name for path in sessions]
            for path, copy in zip(sessions, copies, strict=True):
                shutil.copytree(path, copy)
            done.append(lce_rig(verb, *copies, "--json"))
        told, mute = (
            json.loads(each.out.replace(str(tmp_path / "mute"), str(tmp_path / "told"))) for each in done
        )
        assert done[0].code == done[1].code
        assert facts(told) == facts(mute)
        assert all(each.get("text", each.get("cause")) == each["code"] for each in findings(mute))
        assert all(each.get("text", each.get("cause")) != each["code"] for each in findings(told))
        return done[0].code, told

    return call


def moved(session):
    """Put the LiDAR of a session's result 5 cm elsewhere."""
    path = session / "calibration" / "result.json"
    document = json.loads(path.read_text())
    document["pairs"][0]["T_cam_lidar"][2][3] += 0.05
    path.write_text(json.dumps(document))
    return session


def codes(document):
    return {each["code"] for each in findings(document)}


def test_check_refuses_the_same_captures_for_the_same_codes(run_twice, spoilt):
    code, document = run_twice("check", spoilt)
    records = document["pairs"][0]["captures"].values()
    assert code == 0 and sum(record["is_usable"] for record in records) >= 10
    assert len(codes(document)) >= 4


@pytest.mark.long
def test_calibrate_gives_the_same_extrinsics_verdict_and_reasons(run_twice, spoilt):
    code, document = run_twice("calibrate", spoilt)
    assert code == 0
    assert len(codes(document["pairs"][0]["captures_refused"])) >= 4
    assert document["pairs"][0]["findings"]


def test_verify_is_contradicted_by_the_same_captures(run_twice, calibrated_few):
    code, document = run_twice("verify", moved(calibrated_few))
    assert code == 7
    assert codes(document["pairs"][0]["doubts"]) == {"verdict.plane_residual"}


@pytest.fixture
def halves(simulated, tmp_path):
    """Two sessions without a result."""
    halves = [tmp_path / f"half{half}" for half in range(2)]
    for half, folder in enumerate(halves):
        shutil.copytree(simulated, folder)
        for k in range(half, 16, 2):
            shutil.rmtree(folder / "captures" / f"{k:06d}")
    return halves


@pytest.mark.long
def test_repeat_finds_the_same_disagreement(run_twice, halves, lce_rig):
    assert lce_rig("calibrate", halves[1]).code == 0
    path = moved(halves[1]) / "calibration" / "result.json"
    path.write_text(re.sub('"verdict": "(pass|marginal)"', '"verdict": "fail"', path.read_text()))
    profile = halves[1] / "rig.yaml"
    profile.write_text(profile.read_text().replace("width_m: 0.8", "width_m: 0.81"))
    code, document = run_twice("repeat", *halves)
    assert code == 7
    assert codes(document) == {"repeat.disagree", "repeat.failed", "repeat.other_board"}
