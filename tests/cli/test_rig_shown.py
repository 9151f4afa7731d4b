"""Results of several sensors on the screen."""

import numpy as np

from lce_rig.cli.calibrate import show_result
from lce_rig.core.rig_poses import find_rig_poses
from lce_rig.judge.findings import LIDARS_DIFFER
from tests.calibrate.four_sensors import between, make_rig
from tests.saved_results import made_calibration

RIG = make_rig()
DIFFERS = LIDARS_DIFFER("left, front, rear", camera="left", rotation_deg=1.0, translation_m=0.03)


def pair(first, second, **fields):
    fields = {"channels": () if first in RIG.lidars else ("frames",), **fields}
    return made_calibration(between(first, second), np.eye(6) * 1e-8, camera=first, lidar=second, **fields)


def shown(capsys, *pairs, is_explained=False):
    show_result(pairs, find_rig_poses(pairs, RIG.lidars), RIG, "session", is_explained=is_explained)
    return capsys.readouterr().out


def test_two_sensors_have_a_matrix_and_no_rig(capsys):
    out = shown(capsys, pair("left", "front"))
    assert "T_cam_lidar" in out and "about " in out and "rig on" not in out


def test_three_sensors_have_one_line_each_on_the_base(capsys):
    pairs = pair("left", "front"), pair("left", "rear"), pair("front", "rear")
    out = shown(capsys, *pairs)
    assert "T_cam_lidar" not in out and "rig on front" in out
    (rear,) = (line.split() for line in out.splitlines() if line.startswith("rear"))
    assert rear[1] == "PASS"
    np.testing.assert_allclose(
        [float(value) for value in rear[2:5]], between("front", "rear")[:3, 3], atol=1e-4
    )
    assert "T_cam_lidar" in shown(capsys, *pairs, is_explained=True)


def test_a_reason_of_several_pairs_is_printed_once(capsys):
    fields = {"verdict": "fail", "findings": (DIFFERS,)}
    out = shown(capsys, *(pair(*each, **fields) for each in (("left", "front"), ("left", "rear"))))
    assert out.count(DIFFERS.text) == 1 and out.count(DIFFERS.advice) == 1
    assert "  same reason as left.frames and front" in out.splitlines()


def test_a_sensor_without_a_usable_pose_is_named(capsys):
    out = shown(capsys, pair("left", "front"), pair("right", "front", verdict="fail"))
    assert "right  FAIL, no usable pose" in out.splitlines()
