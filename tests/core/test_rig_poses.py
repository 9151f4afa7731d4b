"""Poses of all sensors on the base sensor."""

import json

import numpy as np
import pytest

from lce_rig.core.calibration import ResultFile, read_result
from lce_rig.core.geometry import difference, invert, perturb, tangent_sizes
from lce_rig.core.rig_poses import find_rig_poses
from tests.calibrate.four_sensors import ON_FRONT, between
from tests.saved_results import made_calibration

LIDARS = ("front", "rear")
TANGENT = np.array([3.0, -2.0, 1.0, 0.5, -0.4, 0.9]) * 1e-6
EXACT = np.zeros((6, 6))


def pair(first, second, cov=EXACT, **fields):
    fields = {"channels": () if first in LIDARS else ("frames",), **fields}
    return made_calibration(between(first, second), cov, camera=first, lidar=second, **fields)


def sizes(sensor):
    return sensor.sigma_rotation_deg, sensor.sigma_translation_m


def test_find_rig_poses_two_sensors_returns_none():
    assert find_rig_poses([pair("left", "front")], LIDARS) is None


def test_find_rig_poses_stand_on_the_first_lidar():
    poses = find_rig_poses([pair("left", "rear"), pair("right", "front"), pair("left", "front")], LIDARS)
    assert poses.base == "front"
    assert [each.sensor for each in poses.sensors] == ["rear", "left", "right"]
    for each in poses.sensors:
        np.testing.assert_allclose(each.T_base_sensor, invert(ON_FRONT[each.sensor]), atol=1e-12)


@pytest.mark.parametrize("uncertain", [("left", "front"), ("left", "rear"), ("right", "rear")])
def test_find_rig_poses_propagates_each_covariance(uncertain):
    names = [("left", "front"), ("left", "rear"), ("right", "rear")]  # right is three pairs from front
    given = [pair(*each, np.outer(TANGENT, TANGENT) if each == uncertain else EXACT) for each in names]
    T = {each: between(*each) for each in names}
    T[uncertain] = perturb(T[uncertain], TANGENT)
    right = find_rig_poses(given, LIDARS).sensors[-1]
    T_moved = invert(T["left", "front"]) @ T["left", "rear"] @ invert(T["right", "rear"])
    expected = tangent_sizes(difference(T_moved, invert(ON_FRONT["right"])))
    assert right.sensor == "right"
    np.testing.assert_allclose(sizes(right), expected, rtol=1e-3)


def test_find_rig_poses_skips_failed_pairs():
    given = [pair("left", "front"), pair("right", "front", verdict="fail")]
    assert [each.sensor for each in find_rig_poses(given, LIDARS).sensors] == ["left"]
    # Its pose follows from another pair that has not failed.
    given += [pair("front", "rear"), pair("right", "rear", verdict="marginal")]
    verdicts = {each.sensor: each.verdict for each in find_rig_poses(given, LIDARS).sensors}
    assert verdicts == {"rear": "pass", "left": "pass", "right": "marginal"}


def test_find_rig_poses_are_read_back_from_the_file(tmp_path):
    pairs = (pair("left", "front", np.eye(6) * 1e-6), pair("right", "front", np.eye(6) * 1e-6))
    file = ResultFile(rig="four", on_base=find_rig_poses(pairs, LIDARS), pairs=pairs)
    (tmp_path / "result.json").write_text(file.text())
    assert read_result(tmp_path / "result.json").text() == file.text()
    assert json.loads(file.text())["on_base"]["base"] == "front"
    assert "on_base" not in ResultFile(rig="four", pairs=pairs[:1]).document()
