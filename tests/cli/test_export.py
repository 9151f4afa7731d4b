"""`lce-rig export`: into a folder, and into a robot's own URDF."""

import json

import numpy as np
import pytest
from yourdfpy import URDF

from tests.shared import contents

ROBOT = """<robot name="cart">
  <!-- base and mast -->
  <link name="base_link"/><link name="velodyne"/>
  <joint name="mast" type="fixed"><parent link="base_link"/><child link="velodyne"/>
    <origin xyz="0 0 1"/></joint>
</robot>
"""


def extrinsics(session):
    return np.array(json.loads((session / "calibration/result.json").read_text())["pairs"][0]["T_cam_lidar"])


def test_export_inserts_result_into_robot_urdf(lce_rig, calibrated, tmp_path):
    robot = tmp_path / "robot.urdf"
    robot.write_text(ROBOT)
    before = contents(calibrated)
    outcome = lce_rig("export", calibrated, "--into", robot)
    assert outcome.code == 0, outcome.err
    T = URDF.load(str(robot), load_meshes=False).get_transform("velodyne", "davis_optical_frame")
    np.testing.assert_allclose(T, extrinsics(calibrated), atol=1e-9)
    assert "<!--" in robot.read_text()
    (backup,) = tmp_path.glob("*.bak")
    assert backup.read_text() == ROBOT and str(backup) in outcome.out.replace("\n", "")
    assert contents(calibrated) == before


def test_formats_are_chosen_and_the_target_is_named(lce_rig, calibrated, tmp_path):
    assert lce_rig("export", calibrated, "-o", tmp_path / "out", "--formats", "urdf").code == 0
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["rles.urdf"]
    assert lce_rig("export", calibrated, "-o", tmp_path / "out", "--formats", "usd").code == 2
    assert lce_rig("export", calibrated).code == 2
    assert lce_rig("export", "kalibr", "-o", tmp_path / "format").code == 2
    both = ("--into", tmp_path / "none.urdf", "-o", tmp_path / "both")
    assert lce_rig("export", calibrated, *both).code == 2 and not (tmp_path / "both").exists()
    assert lce_rig("export", calibrated, "--into", tmp_path / "none.urdf").code == 4


def test_failed_result_is_not_exported(lce_rig, calibrated, tmp_path):
    path, robot = calibrated / "calibration/result.json", tmp_path / "robot.urdf"
    robot.write_text(ROBOT)
    document = json.loads(path.read_text())
    document["pairs"][0]["verdict"] = "fail"
    path.write_text(json.dumps(document))
    assert lce_rig("export", calibrated, "--into", robot).code == 7
    assert robot.read_text() == ROBOT
    assert lce_rig("export", calibrated, "--into", robot, "--force").code == 0
    assert robot.read_text() != ROBOT


def test_export_fits_the_robot_tree(lce_rig, calibrated, tmp_path, mute):
    robot, out = tmp_path / "robot.urdf", tmp_path / "out"
    robot.write_text(ROBOT)
    told = lce_rig("export", calibrated, "-o", out, "--formats", "autoware")
    assert told.code == 0 and told.err.count("export.no_frame") == 2  # each with its action
    outcome = lce_rig("export", calibrated, "-o", out, "--formats", "urdf,ros2_launch,mcap", "--tree", robot)
    assert outcome.code == 0 and "export." not in outcome.err
    assert {path.name for path in out.iterdir()} == {*("rles.urdf", "rles.launch.py", "rles_session")}
    read = URDF.load(str(out / "rles.urdf"), load_meshes=False)
    T = read.get_transform("velodyne", "davis_optical_frame")
    np.testing.assert_allclose(T, extrinsics(calibrated), atol=1e-9)
    # The session's own recording of transforms is a tree as well.
    args = ("--formats", "urdf", "--tree", out / "rles_session")
    assert lce_rig("export", calibrated, "-o", tmp_path / "again", *args).code == 0
    assert lce_rig("export", calibrated, "--into", robot, "--tree", robot).code == 2


def test_every_format_is_listed_with_its_files(lce_rig):
    from lce_rig.export import EXPORTS

    lines = lce_rig("export", "--list").out.splitlines()
    assert [line.split()[0] for line in lines] == list(EXPORTS)


@pytest.mark.long
def test_calibrate_writes_the_formats_of_the_profile(lce_rig, simulated, tmp_path):
    import shutil

    session = tmp_path / "session"
    shutil.copytree(simulated, session)
    profile = session / "rig.yaml"
    profile.write_text(profile.read_text().replace("exports: []", "exports: [opencv, tf_static_bag]"))
    assert lce_rig("calibrate", session).code == 0
    names = {path.name for path in (session / "calibration").iterdir()} - {"report.html"}
    assert names == {"result.json", "opencv_davis.yaml", "tf_static"}
    assert lce_rig("calibrate", session, "--method", "paper").code == 0
    assert names <= {path.name for path in (session / "calibration/previous").iterdir()}
