"""`lce-rig export`: into a folder, and into a robot's own URDF."""

import json

import numpy as np
from yourdfpy import URDF

ROBOT = """<robot name="cart">
  <!-- base and mast -->
  <link name="base_link"/><link name="velodyne"/>
  <joint name="mast" type="fixed"><parent link="base_link"/><child link="velodyne"/>
    <origin xyz="0 0 1"/></joint>
</robot>
"""


def extrinsics(session):
    return np.array(json.loads((session / "calibration/result.json").read_text())["pairs"][0]["T_cam_lidar"])


def test_a_result_is_set_into_the_urdf_of_a_robot(lce_rig, calibrated, tmp_path):
    robot = tmp_path / "robot.urdf"
    robot.write_text(ROBOT)
    before = {file: file.read_bytes() for file in calibrated.rglob("*") if file.is_file()}
    outcome = lce_rig("export", calibrated, "--into", robot)
    assert outcome.code == 0, outcome.err
    T = URDF.load(str(robot), load_meshes=False).get_transform("velodyne", "davis_optical_frame")
    np.testing.assert_allclose(T, extrinsics(calibrated), atol=1e-9)
    assert "<!-- base and mast -->" in robot.read_text()
    (backup,) = tmp_path.glob("*.bak")
    assert backup.read_text() == ROBOT and str(backup) in outcome.out.replace("\n", "")
    assert {file: file.read_bytes() for file in calibrated.rglob("*") if file.is_file()} == before


def test_formats_are_chosen_and_the_target_is_named(lce_rig, calibrated, tmp_path):
    assert lce_rig("export", calibrated, "-o", tmp_path / "out", "--formats", "urdf").code == 0
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["rles.urdf"]
    assert lce_rig("export", calibrated, "-o", tmp_path / "out", "--formats", "usd").code == 2
    assert lce_rig("export", calibrated).code == 2
    assert lce_rig("export", calibrated, "--into", tmp_path / "none.urdf").code == 4


def test_a_failed_result_does_not_reach_a_robot(lce_rig, calibrated, tmp_path):
    path, robot = calibrated / "calibration/result.json", tmp_path / "robot.urdf"
    robot.write_text(ROBOT)
    document = json.loads(path.read_text())
    document["pairs"][0]["verdict"] = "fail"
    path.write_text(json.dumps(document))
    assert lce_rig("export", calibrated, "--into", robot).code == 7
    assert robot.read_text() == ROBOT
    assert lce_rig("export", calibrated, "--into", robot, "--force").code == 0
    assert robot.read_text() != ROBOT
