"""Calibrations in a robot's own tree of frames: its parents, comments and order stay."""

from collections.abc import Callable
from datetime import datetime
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from yourdfpy import URDF

from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import SessionError
from lce_rig.core.geometry import exp_so3, pose
from lce_rig.export import write_exports
from lce_rig.export.robot_tree import fit_tree
from lce_rig.export.urdf import read_robot_urdf, write_into_urdf
from lce_rig.rig.profile import Mount

Make = Callable[..., Calibration]
NOW = datetime(2026, 5, 4, 10, 15)
HEAD = '<?xml version="1.0"?>\n<!-- the robot <joint> of hall 3 -->\n<robot name="cart">\n'
BASE = '  <link name="base_link"/>\n  <link name="velodyne"/> <!-- on the mast -->\n'
MAST = """  <joint name="mast" type="fixed">
    <child link="velodyne"/>
    <!-- <origin xyz="9 9 9" rpy="0 0 0"/> before the crash -->
    <origin rpy="0 0 0.1"
            xyz="0.2 0 0.9"></origin>
    <parent link="base_link"/>
  </joint>
"""
CAMERA = """  <link name="davis_link"><inertial><origin xyz="1 2 3"/></inertial></link>
  <joint name="bracket" type="{kind}"><parent link="base_link"/><child link="davis_link"/></joint>
"""
OPTICAL = """  <link name="davis_optical_frame"/>
  <joint name="eye" type="fixed"><parent link="davis_link"/><child link="davis_optical_frame"/>
    <origin xyz="0.01 0 0" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>
"""


def found(path, rig):
    """Read T_cam_lidar as another program does."""
    robot = URDF.load(str(path), load_meshes=False)
    return np.asarray(robot.get_transform("velodyne", "davis_optical_frame"))


@pytest.mark.parametrize("has_camera", [False, True])
@pytest.mark.parametrize("has_optical", [False, True])
def test_urdf_camera_is_moved_or_added(rles, make, tmp_path, has_camera, has_optical):
    """Moved below its own parent, added below the LiDAR."""
    path, calibration = tmp_path / "cart.urdf", make()
    text = HEAD + BASE + MAST + (CAMERA.format(kind="fixed") if has_camera else "")
    text += (OPTICAL if has_camera and has_optical else "") + "</robot>\n<!-- end -->\n"
    path.write_text(text)
    backup, _ = write_into_urdf(path, [calibration], rles, NOW)
    np.testing.assert_allclose(found(path, rles), calibration.T_cam_lidar, atol=1e-9)
    assert backup == tmp_path / "cart.urdf.2026-05-04T101500.bak"
    assert backup.read_text() == text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cart.urdf", backup.name]
    tree = read_robot_urdf(path)
    assert tree.above["davis_link"].parent == ("base_link" if has_camera else "velodyne")
    if has_optical and has_camera:
        np.testing.assert_allclose(tree.above["davis_optical_frame"].T_parent_child[0, 3], 0.01)
    # All lines but those of the changed joint are as they were, in their order.
    lines = iter(path.read_text().splitlines())
    kept = [line for line in text.splitlines() if "bracket" not in line and line != "</robot>"]
    assert all(line in lines for line in kept)
    assert write_into_urdf(path, [calibration], rles, NOW) == (None, [])


def test_urdf_lidar_below_camera_is_moved(rles, make, tmp_path):
    path, calibration = tmp_path / "cart.urdf", make()
    mast = MAST.replace('"base_link"', '"davis_link"')
    path.write_text(HEAD + BASE + CAMERA.format(kind="fixed") + mast + OPTICAL + "</robot>\n")
    _, (change,) = write_into_urdf(path, [calibration], rles, NOW)
    assert change.joint.child == "velodyne" and change.before is not None and change.moved is not None
    turn = Rotation.from_matrix(change.joint.T_parent_child[:3, :3] @ change.before[:3, :3].T)
    shift = change.joint.T_parent_child[:3, 3] - change.before[:3, 3]
    assert change.moved == pytest.approx((np.degrees(turn.magnitude()), np.linalg.norm(shift)))
    np.testing.assert_allclose(found(path, rles), calibration.T_cam_lidar, atol=1e-9)
    assert "9 9 9" in path.read_text() and 'xyz="0.2 0 0.9"' not in path.read_text()


@pytest.mark.parametrize(
    "text",
    [
        *(HEAD + BASE + MAST.replace("0.9", bad) + "</robot>" for bad in ("nan", "1e999", "")),
        (HEAD.replace("?>", ' encoding="utf-16"?>') + BASE + MAST + "</robot>").encode("utf-16"),
        HEAD + BASE + MAST + CAMERA.format(kind="revolute") + "</robot>",
        HEAD + '<link name="base_link"/></robot>',
        HEAD + BASE + MAST + MAST.replace("mast", "other") + "</robot>",
        HEAD + BASE + MAST + OPTICAL.replace("davis_link", "base_link") + "</robot>",
        HEAD + "<xacro:include/>" + BASE + MAST + "</robot>",
        HEAD + BASE,
        "",
    ],
    ids=[
        "nan",
        "infinite",
        "absent",
        "utf-16",
        "moves",
        "no-sensor",
        "two-parents",
        "optical-elsewhere",
        "xacro",
        "torn",
        "empty",
    ],
)
def test_urdf_misfit_is_refused_unchanged(rles, make, tmp_path, text):
    path = tmp_path / "cart.urdf"
    before = text.encode() if isinstance(text, str) else text
    path.write_bytes(before)
    with pytest.raises(SessionError) as error:
        write_into_urdf(path, [make()], rles, NOW)
    assert str(path) in error.value.what
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_a_link_stays_a_link_and_its_target_gets_the_joints(rles, make, tmp_path):
    target, link = tmp_path / "package" / "cart.urdf", tmp_path / "cart.urdf"
    target.parent.mkdir()
    target.write_text(HEAD + BASE + MAST + "</robot>\n")
    link.symlink_to(target)
    backup, _ = write_into_urdf(link, [make()], rles, NOW)
    assert link.is_symlink() and link.resolve() == target and not target.is_symlink()
    np.testing.assert_allclose(found(target, rles), make().T_cam_lidar, atol=1e-9)
    assert backup is not None and backup.parent == target.parent


def test_urdf_sensor_nearest_root_stays(three_sensor_rig, make, tmp_path):
    rng = np.random.default_rng(0)
    poses = [pose(exp_so3(rng.normal(size=3)), rng.normal(size=3)) for _ in range(3)]
    pairs = [("davis", "front"), ("davis", "back"), ("left", "back")]
    calibrations = [make(T, camera=c, lidar=lidar) for T, (c, lidar) in zip(poses, pairs, strict=True)]
    path = tmp_path / "cart.urdf"
    path.write_text(HEAD + BASE + MAST + CAMERA.format(kind="fixed") + "</robot>")
    tree, changes, _ = fit_tree(read_robot_urdf(path), calibrations, three_sensor_rig)
    assert [change.before is None for change in changes].count(False) == 1
    for calibration, T in zip(calibrations, poses, strict=True):
        optical = three_sensor_rig.cameras[calibration.camera].optical_frame
        lidar = three_sensor_rig.lidars[calibration.lidar].frame
        np.testing.assert_allclose(tree.find_pose(optical, lidar), T, atol=1e-12)


def test_mount_is_the_root_of_outputs(rles, make, tmp_path):
    mount = Mount(parent="base_link", of="davis_link", xyz_m=(0.1, 0.2, 0.3), rpy_deg=(10.0, 20.0, 30.0))
    rig = rles.model_copy(update={"mount": mount})
    write_exports([make()], rig, tmp_path)
    read = read_robot_urdf(tmp_path / f"{rig.name}.urdf")
    assert read.chain("velodyne")[-1] == "base_link"
    np.testing.assert_allclose(read.find_pose("base_link", "davis_link"), mount.to_matrix())
    np.testing.assert_allclose(read.find_pose("davis_optical_frame", "velodyne"), make().T_cam_lidar)
    words = (tmp_path / "static_transforms.txt").read_text().split()
    assert ("base_link", "davis_link") in pairwise(words)
