"""`lce-rig board` as a user runs it."""

import hashlib
import json

import cv2
import numpy as np
import pytest
import yaml

from lce_rig.core.geometry import difference, transform
from lce_rig.rig import BoardSettings, load_rig
from lce_rig.rig.board_settings import board_block


@pytest.mark.parametrize(
    ("words", "board"),
    [
        (["--type", "charuco", "--squares", "9x7", "--size", "0.07"], "charuco:9x7,0.07,0.0525,5X5_50"),
        (["--type", "aprilgrid", "--squares", "4x3", "--size", "0.13"], "aprilgrid:4x3,0.13,0.3"),
        (["--squares", "9x7", "--size", "0.07"], "8x6,0.07"),
    ],
)
def test_board_block_equals_that_of_new_profile(lce_rig, tmp_path, words, board):
    outcome = lce_rig("board", *words, "--plate", "0.8x0.7", "-o", tmp_path / "board.pdf")
    assert outcome.code == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    settings = BoardSettings.model_validate(yaml.safe_load(outcome.out)["board"])
    profile = tmp_path / "mine.yaml"
    new = lce_rig("rigs", "new", "mine", "--from", "rlfs", "--board", f"{board},0.8x0.7", "-o", profile)
    assert new.code == 0
    assert load_rig(profile).board.to_board() == settings.to_board()
    assert BoardSettings.model_validate(board_block(settings.to_board())).to_board() == settings.to_board()
    # And back to a checkerboard.
    again = tmp_path / "again.yaml"
    words = ("rigs", "new", "again", "--from", profile, "--board", "9x6,0.068,0.8x0.6", "-o", again)
    assert lce_rig(*words).code == 0
    assert load_rig(again).board.to_board().cols == 9


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--squares", "9", "--size", "0.07"], 2),
        (["--squares", "9x7", "--size", "0.07", "-o", "board.doc"], 2),
        (["--squares", "9x7", "--size", "0.07", "--plate", "1.2.3x0.5"], 2),
        (["--squares", "9x7", "--size", "70"], 3),
        (["--type", "charuco", "--squares", "3x3", "--size", "0.07"], 3),
        (["--squares", "9x7", "--size", "0.07", "--plate", "0.5x0.4"], 3),
        (["--type", "aprilgrid", "--squares", "30x30", "--size", "0.05"], 3),
        (["--squares", "9x7", "--size", "0.07", "-o", "/nowhere/board.pdf"], 8),
    ],
)
def test_board_impossible_pattern_is_refused(lce_rig, words, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert lce_rig("board", *words).code == code
    assert not list(tmp_path.iterdir())


@pytest.mark.long
@pytest.mark.parametrize("board", ["charuco:9x7,0.07,0.0525,5X5_50", "aprilgrid:4x3,0.13,0.3"])
def test_board_covered_markers_match_truth(lce_rig, tmp_path, board):
    """Each image's board is covered otherwise, by about 30 %; another dictionary is named once."""
    profile, session = tmp_path / "marked.yaml", tmp_path / "session"
    words = ("rigs", "new", "marked", "--from", "rlfs", "--board", f"{board},0.767x0.626", "-o", profile)
    assert lce_rig(*words).code == 0
    assert lce_rig("simulate", session, "--rig", profile, "--captures", "7", "--seed", "2").code == 0
    rig, rng = load_rig(profile), np.random.default_rng(0)
    lens, pattern = rig.cameras["cam"].to_intrinsics(), rig.board.to_board()
    truth = json.loads((session / "truth.json").read_text())
    size = np.array(pattern.pattern_size_m)
    for name, capture in truth["captures"].items():
        path = session / "captures" / name / "cam.frames.png"
        paper = size * [0.55, 0.55]
        low = -size / 2 + rng.uniform(0, 1, 2) * (size - paper)
        outline = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * paper + low
        T_cam_board = np.array(capture["boards"]["cam"]["T_sensor_board"])
        pixels, _ = lens.project(transform(T_cam_board, np.column_stack([outline, np.zeros(4)])))
        image = cv2.imread(str(path))
        cv2.fillConvexPoly(image, np.rint(pixels).astype(np.int32), (90, 90, 90))
        cv2.imwrite(str(path), image)
        manifest = json.loads((path.parent / "meta.json").read_text())
        (entry,) = (each for each in manifest["files"] if each["file"] == path.name)
        data = path.read_bytes()
        entry |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        (path.parent / "meta.json").write_text(json.dumps(manifest))
    assert lce_rig("check", session, "--debug-images").code == 0
    assert lce_rig("calibrate", session).code in (0, 7)
    (pair,) = json.loads((session / "calibration" / "result.json").read_text())["pairs"]
    assert len(pair["captures_used"]) == 7
    off = difference(np.array(truth["T_cam_lidar"]), np.array(pair["T_cam_lidar"]))
    assert off @ np.linalg.solve(np.array(pair["cov"]), off) < 22
    assert lce_rig("intrinsics", session).code == 0

    stored = session / "rig.yaml"
    text = stored.read_text()
    stored.write_text(text.replace("5X5_50", "6X6_50").replace("tag_spacing: 0.3", "tag_spacing: 0.2"))
    outcome = lce_rig("check", session, "--json")
    assert outcome.code == 6
    (pair,) = json.loads(outcome.out)["pairs"]
    codes = {each["refusal"]["code"] for each in pair["captures"].values()}
    assert codes == {"image.other_spacing" if "tag_spacing" in text else "image.other_dictionary"}
