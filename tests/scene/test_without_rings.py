"""`drift` and the scene's opinion with a LiDAR that scans in no rings, against a simulated room's truth."""

import json

import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.geometry import perturb
from lce_rig.pipeline.detect_session import detect
from lce_rig.pipeline.witness import hear_scene
from lce_rig.scene.alignment import AXES
from lce_rig.scene.drift import watch
from lce_rig.scene.views import build_view
from lce_rig.session import Session
from lce_rig.simulate import simulate_captures, truth_extrinsics
from tests.saved_results import write_result
from tests.scene.conftest import Seen, deployed, small_rig

SEED = 3


@pytest.fixture(scope="module")
def seen() -> Seen:
    """Three captures of a Mid-360 in a room."""
    rig = small_rig("mid360")
    captures = list(simulate_captures(rig, n_captures=3, seed=SEED))
    truth = deployed(truth_extrinsics(rig, SEED)["cam", "lidar"])
    views = [build_view(rig, truth, str(c.index), c.images[0], c.scans[0]) for c in captures]
    return Seen(rig, captures, truth, views)


def judge(seen, tangent=(0.0,) * 6):
    c = seen.truth
    return watch(
        seen.views, seen.rig.lens_of(c), perturb(c.T_cam_lidar, np.array(tangent)), c.cov, is_joint=False
    )


def test_the_truth_has_no_change(seen) -> None:
    drift = judge(seen)
    assert {axis.state for axis in drift.axes} <= {"unchanged", "unknown"}
    assert {axis.axis for axis in drift.axes if axis.state == "unchanged"} >= {"translation_x", "rotation_y"}


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("axis", AXES)
def test_1_deg_or_10_cm_is_never_called_unchanged(seen, axis, sign) -> None:
    size = sign * (np.radians(1.0) if axis.startswith("rotation") else 0.1)
    drift = judge(seen, size * np.eye(6)[AXES.index(axis)])
    assert drift.state != "unchanged"
    if axis in ("rotation_y", "translation_x"):
        (change,) = [each for each in drift.axes if each.state == "changed"]
        assert axis in (change.axis, *change.instead)


def test_drift_and_calibrate_hear_the_scene_beside_the_boards(seen, tmp_path, capsys) -> None:
    with Session.create(tmp_path / "room", seen.rig) as session:
        for capture in seen.captures:
            session.add_capture(capture.images, capture.scans, {})
    write_result(tmp_path / "room" / "calibration" / "result.json", seen.rig.name, [seen.truth])
    assert run(["drift", str(tmp_path / "room"), "--json"]) in (0, 6)
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert pair["n_edges"] > 300 and pair["scene_state"] != "changed"
    session = Session.open(tmp_path / "room")
    assert hear_scene(session, detect(session), seen.truth).state in ("agrees", "unknown")
