"""`drift` with a LiDAR without rings, compared with the truth of a simulated room."""

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.calibration import MOTIONS
from lce_rig.core.geometry import exp_so3, perturb, pose
from lce_rig.judge.scene_drift import watch_scene
from lce_rig.pipeline.detect_session import detect_boards
from lce_rig.pipeline.watch_drift import SceneCaptures
from lce_rig.pipeline.witness import hear_scene
from lce_rig.rig import load_rig
from lce_rig.scene.views import build_view
from lce_rig.session import Session
from tests.saved_results import made_calibration, result_file, write_result
from tests.scene.conftest import Seen, simulate_seen, small_rig
from tests.shared import compute_once

SEED = 3


@pytest.fixture(scope="module")
def seen():
    """Three captures of a Mid-360 in a room."""
    return compute_once("scene_without_rings", lambda: simulate_seen(small_rig("mid360"), 3, SEED))


def judge(seen, tangent=(0.0,) * 6):
    c = replace(seen.truth, T_cam_lidar=perturb(seen.truth.T_cam_lidar, np.array(tangent)))
    return watch_scene(seen.views, seen.rig.lens_of(c), c)


@pytest.mark.long
def test_scene_without_rings_truth_holds(seen):
    assert judge(seen).state == "unchanged"


@pytest.mark.long
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("axis", MOTIONS)
def test_scene_without_rings_changes_do_not_hold(seen, axis, sign):
    size = sign * (np.radians(1.0) if axis.startswith("rotation") else 0.1)
    drift = judge(seen, size * np.eye(6)[MOTIONS.index(axis)])
    assert drift.state != "unchanged"
    if axis == "rotation_y":
        assert axis in drift.findings[0].figures["axes"]


@pytest.mark.long
def test_drift_and_calibrate_use_scene_and_boards(seen, tmp_path, capsys):
    with Session.create(tmp_path / "room", seen.rig) as session:
        for capture in seen.captures:
            session.add_capture(capture.images, capture.scans, {})
    write_result(tmp_path / "room" / "calibration" / "result.json", seen.rig.name, [seen.truth])
    assert run(["drift", str(tmp_path / "room"), "--json"]) in (0, 6)
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert pair["scene"]["n_edges"] > 300 and pair["scene"]["state"] != "changed"
    session = Session.open(tmp_path / "room")
    assert hear_scene(session, detect_boards(session), seen.truth).state in ("agrees", "unknown")


KITTI = Path(__file__).parents[1] / "rigs" / "kitti.yaml"


@pytest.fixture(scope="module")
def drives(recordings):
    """KITTI's views, with their trusted extrinsics as a result of 3 mm, 0.03 deg."""
    folder = recordings / "kitti_drives"
    trusted = json.loads((folder / "gt.json").read_text())["extrinsics"]
    w, *v = trusted["rotation"]
    turn = 2 * np.arctan2(np.linalg.norm(v), w) * np.array(v) / np.linalg.norm(v)
    T = pose(exp_so3(turn), np.array(trusted["translation"]))
    rig = load_rig(str(KITTI))
    c = made_calibration(T, np.diag([0.003] * 3 + [0.0005] * 3) ** 2)
    captures = SceneCaptures(rig, result_file(rig.name, [c]), str(folder))
    captures.take_recordings([folder], lambda done, of: None)
    return Seen(rig, [], c, [build_view(rig, c, k.name, k.image, k.scan) for k in captures.kept[0]])


@pytest.mark.long
@pytest.mark.dataset
@pytest.mark.parametrize("axis", [None, *range(6)])
def test_changes_by_1_deg_or_20_cm_are_always_detected(drives, axis):
    for views in list(combinations(drives.views, 3))[::31]:
        three = drives._replace(views=list(views))
        if axis is None:
            assert judge(three).state != "changed"
            continue
        for sign in (-1, 1):
            size = sign * (0.2 if axis < 3 else np.radians(1.0))
            drift = judge(three, size * np.eye(6)[axis])
            assert drift.state != "unchanged"


@pytest.mark.long
@pytest.mark.dataset
def test_drift_reads_a_folder_of_drives(drives, recordings, tmp_path, capsys):
    write_result(tmp_path / "result.json", drives.rig.name, [drives.truth])
    result, folder = str(tmp_path / "result.json"), str(recordings / "kitti_drives")
    words = ["drift", folder, "--rig", str(KITTI), "--result", result]
    assert run([*words, "--json"]) == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert pair["scene"]["n_captures"] == 12 and pair["state"] == "unchanged"
