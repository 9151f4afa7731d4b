"""Every export, read by independent programs."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import LceRigError, ResultRefusedError, SessionError
from lce_rig.core.geometry import T_BODY_OPTICAL, exp_so3, invert, pose
from lce_rig.export import EXPORTS, write_exports
from lce_rig.export.other_tools import fit_lens
from lce_rig.export.robot_tree import Joint, RobotTree
from lce_rig.export.urdf import read_robot_urdf
from lce_rig.io.camera_description import read_cameras
from lce_rig.lens.models import grid_rays
from tests.export.conftest import reason
from tests.shared import changed

Make = Callable[..., Calibration]
in_one_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=10)


def body_poses():
    """Poses of a camera's body on the LiDAR, with pitch at and near +-90 deg as well as anywhere."""
    near = st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 1e-5]).flatmap(
        lambda off: st.sampled_from([np.pi / 2 - off, off - np.pi / 2])
    )
    angle = st.floats(-np.pi, np.pi)
    angles = st.tuples(angle, near | st.floats(-1.5, 1.5), angle)
    return st.builds(
        lambda rpy, t: pose(Rotation.from_euler("xyz", rpy).as_matrix(), np.array(t)),
        angles,
        st.tuples(*[st.floats(-2, 2)] * 3),
    )


@in_one_folder
@given(T_lidar_body=body_poses())
def test_every_format_survives_any_pose(rles, make, tmp_path, T_lidar_body):
    T_cam_lidar = invert(T_lidar_body @ T_BODY_OPTICAL)
    usual = {"extrinsics.yaml", "rles.urdf", "camera_info_davis.yaml", "static_transforms.txt"}
    assert {path.name for path in write_exports([make(T_cam_lidar)], rles, tmp_path)} == usual
    write_exports([make(T_cam_lidar)], rles, tmp_path / "others", formats=["kalibr", "autoware"])
    import yourdfpy

    robot = yourdfpy.URDF.load(str(tmp_path / "rles.urdf"), load_meshes=False, build_scene_graph=True)
    read = robot.get_transform("velodyne", "davis_optical_frame")
    np.testing.assert_allclose(read, T_cam_lidar, atol=1e-12)


def test_extrinsics_notations_agree(rles, make, tmp_path):
    calibration = make()
    (path,) = write_exports([calibration], rles, tmp_path, formats=["extrinsics"])
    (pair,) = yaml.safe_load(path.read_text(encoding="utf-8"))["pairs"]
    for name, wanted in (
        ("T_cam_lidar", calibration.T_cam_lidar),
        ("T_lidar_cam", np.linalg.inv(calibration.T_cam_lidar)),
    ):
        block = pair[name]
        np.testing.assert_allclose(block["matrix"], wanted, atol=1e-12)
        R = Rotation.from_quat(block["quaternion_xyzw"]).as_matrix()
        np.testing.assert_allclose(R, wanted[:3, :3], atol=1e-12)
        assert block["quaternion_wxyz"] == [block["quaternion_xyzw"][3], *block["quaternion_xyzw"][:3]]
        assert block["translation_m"] == [row[3] for row in block["matrix"][:3]]
    worked, back = pair["T_cam_lidar"]["worked_point"], pair["T_lidar_cam"]["worked_point"]
    point = calibration.T_cam_lidar @ [*worked["p_lidar_m"], 1]
    np.testing.assert_allclose(point[:3], worked["p_cam_m"], atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.inv(calibration.T_cam_lidar) @ point, [*back["p_lidar_m"], 1], atol=1e-12
    )
    assert '"000002"' in path.read_text(encoding="utf-8")  # YAML 1.2 takes it for a number
    assert "velodyne" in pair["T_cam_lidar"]["meaning"]
    assert "davis_optical_frame" in pair["T_lidar_cam"]["meaning"]
    np.testing.assert_array_equal(pair["covariance"]["matrix"], calibration.cov)


def test_static_tf_ros1_equals_ros2(rles, make, tmp_path):
    (path,) = write_exports([make()], rles, tmp_path, formats=["static_tf"])
    lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
    # What ROS 2 is told is read back elsewhere; ROS 1 takes the same values in the same order, without names.
    ros2 = [words[5::2] for words in lines if words[:3] == ["ros2", "run", "tf2_ros"]]
    ros1 = [words[3:] for words in lines if words[:2] == ["rosrun", "tf2_ros"]]
    assert ros1 == ros2
    assert [words[7:] for words in ros1] == [
        ["velodyne", "davis_link"],
        ["davis_link", "davis_optical_frame"],
    ]


def random_pose(seed):
    rng = np.random.default_rng(seed)
    return pose(exp_so3(rng.normal(size=3)), rng.normal(size=3))


@pytest.mark.parametrize("base", [None, "velodyne_back", "left_link"])
def test_export_several_sensors_share_a_tree(three_sensor_rig, make, tmp_path, base):
    rig = three_sensor_rig.model_copy(update={"base_frame": base})
    pairs = [("davis", "front"), ("left", "front"), ("left", "back"), ("fish", "back")]
    calibrations = [make(random_pose(i), camera=c, lidar=lidar) for i, (c, lidar) in enumerate(pairs)]
    paths = write_exports(calibrations, rig, tmp_path)
    assert [path.name for path in paths if path.suffix == ".urdf"] == ["trio.urdf"]
    read = read_robot_urdf(tmp_path / "trio.urdf")
    assert read.chain("fish_optical")[-1] == (base or "velodyne")
    assert len(read.frames) == 8
    for calibration in calibrations:
        camera, lidar = rig.cameras[calibration.camera], rig.lidars[calibration.lidar]
        T_cam_lidar = read.find_pose(camera.optical_frame, lidar.frame)
        np.testing.assert_allclose(T_cam_lidar, calibration.T_cam_lidar, atol=1e-12)


def test_export_unconnected_gives_two_urdfs(three_sensor_rig, make, tmp_path):
    calibrations = [make(camera="davis", lidar="front"), make(camera="left", lidar="back")]
    paths = write_exports(calibrations, three_sensor_rig, tmp_path, formats=["urdf"])
    assert [path.name for path in paths] == ["trio.urdf", "trio-velodyne_back.urdf"]


@pytest.mark.parametrize(
    ("links", "joints"),
    [
        (["a", "b", "a"], ["ab"]),
        (["a", "b"], ["ac"]),
        (["a", "b", "c"], ["ac", "bc"]),
        (["a", "b", "c"], ["ab"]),
        (["a", "b"], ["ab", "ba"]),
        (["a", "b", "c"], ["bc", "cb"]),
        ([], []),
    ],
)
def test_frames_without_tree_are_refused(links, joints):
    with pytest.raises(SessionError):
        RobotTree.of_joints("a.urdf", [Joint(parent, child, np.eye(4)) for parent, child in joints], links)


def test_export_failed_result_is_refused(rles, make, tmp_path):
    """Exports of an earlier run and other files stay."""
    write_exports([make()], rles, tmp_path)
    before = sorted(path.name for path in tmp_path.iterdir())
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    failed = make(verdict="fail", findings=(reason("translation known to 80 mm only"),))
    with pytest.raises(ResultRefusedError) as caught:
        write_exports([failed], rles, tmp_path)
    assert "80 mm" in caught.value.hint
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*before, "notes.txt"])


def test_export_forced_failure_is_marked(rles, make, tmp_path):
    failed = make(verdict="fail", findings=(reason("sigma -- 80 mm\nand more"),))
    paths = write_exports([failed], rles, tmp_path, formats=EXPORTS, is_forced=True)
    for path in paths:
        if path.suffix == ".mcap":
            path = path.with_name("metadata.yaml")
        head = path.read_text(encoding="utf-8")
        assert "davis/frames" in head and "FOR USE" in head
    assert read_robot_urdf(tmp_path / "rles.urdf")
    lens, _ = read_cameras(tmp_path / "camera_info_davis.yaml").intrinsics()
    assert lens == rles.cameras["davis"].to_intrinsics()


@pytest.mark.parametrize(
    "pattern", ["camera_info_davis.yaml", "camchain_*.yaml", "fast_livo2_camera_*.yaml", "opencv_*.yaml"]
)
@pytest.mark.parametrize(
    "block",
    [
        {},
        {"model": "equidistant", "distortion": (-0.05, -0.07, 0.09, -0.05)},
        {"distortion": (-0.3, 0.1, 0.0, 0.0)},
    ],
)
def test_exported_camera_files_are_read_back(rles, make, tmp_path, pattern, block):
    rig = changed(rles, **{f"cameras__davis__intrinsics__{key}": value for key, value in block.items()})
    write_exports([make()], rig, tmp_path, formats=["camera_info", "kalibr", "fast_livo2", "opencv"])
    (path,) = tmp_path.glob(pattern)
    lens, _ = read_cameras(path).intrinsics()
    given = rig.cameras["davis"].to_intrinsics()
    assert (lens.model, lens.width_px, lens.height_px) == (given.model, given.width_px, given.height_px)
    # Kalibr and FAST-LIVO2 have no k3.
    rays = given.unproject(np.array([[60.0, 50.0], [170.0, 130.0], [280.0, 200.0]]))
    assert lens.project(rays)[0] == pytest.approx(given.project(rays)[0], abs=0.1)


@pytest.mark.parametrize("version", ["%YAML:1.0", "%YAML 1.2"])
@pytest.mark.parametrize("extra, model", [("", "radtan"), ("fisheye_model: 1\n", "equidistant")])
def test_opencv_lens_is_read_back(version, extra, model, tmp_path):
    matrix = "!!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [ {} ]\n"
    text = version + "\n---\nimage_width: 640\nimage_height: 480\n" + extra
    text += "camera_matrix: " + matrix.format(3, 3, "500., 0., 320., 0., 501., 240., 0., 0., 1.")
    text += "distortion_coefficients: " + matrix.format(4, 1, "0.1, 0.01, 0.001, 0.002")
    (tmp_path / "lens.yaml").write_text(text, encoding="utf-8")
    lens = read_cameras(tmp_path / "lens.yaml").intrinsics()[0]
    assert (lens.model, lens.fx_px, lens.fy_px, lens.width_px) == (model, 500.0, 501.0, 640)
    assert lens.distortion == (0.1, 0.01, 0.001, 0.002)


@pytest.mark.parametrize("name", sorted(EXPORTS))
def test_export_infinite_pose_is_refused(name, rles, make, tmp_path):
    with pytest.raises(ResultRefusedError):
        write_exports([make(np.full((4, 4), np.nan))], rles, tmp_path, formats=[name])
    assert not list(tmp_path.iterdir())


def test_a_result_of_another_rig_is_refused(rles, make, tmp_path):
    for change in ({"camera": "cam"}, {"lidar": "other"}, {"channels": ("depth",)}):
        with pytest.raises(LceRigError):
            write_exports([make(**change)], rles, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_kalibr_chain_links_successive_cameras(three_sensor_rig, make, tmp_path):
    names = ("davis", "left", "fish")
    calibrations = [make(random_pose(i), camera=name, lidar="front") for i, name in enumerate(names)]
    findings = []
    files = write_exports(calibrations, three_sensor_rig, tmp_path, formats=["kalibr"], findings=findings)
    chain = yaml.safe_load(files[0].read_text(encoding="utf-8"))
    assert [block["distortion_model"] for block in chain.values()] == ["radtan", "radtan", "equidistant"]
    for index in (1, 2):
        T_cn_cnm1 = calibrations[index].T_cam_lidar @ np.linalg.inv(calibrations[index - 1].T_cam_lidar)
        np.testing.assert_allclose(chain[f"cam{index}"]["T_cn_cnm1"], T_cn_cnm1, atol=1e-12)
    # Kalibr's radtan ends at p2: the camera with eight coefficients gets four others, which is reported.
    (finding,) = findings
    assert (finding.code, finding.subject) == ("export.lens_fitted", "left")
    assert f"{finding.figure('max_px'):.3g} px" in files[0].read_text(encoding="utf-8")


@pytest.mark.parametrize(("focal_px", "limit_px"), [(900, 0.2), (450, 0.1), (300, 0.1)])
def test_fit_lens_fewer_terms_cover_image(focal_px, limit_px):
    """At 900 px the five coefficients that fit best fold back before the image's corner."""
    coefficients = (-0.4, 0.2, 0.001, 0.0, -0.05, 0.1, -0.02, 0.01)
    true = Intrinsics(focal_px, focal_px, 640, 360, 1280, 720, "radtan", coefficients)
    lens, rms_px, max_px = fit_lens(true, "radtan5")
    rays = grid_rays(true)[1]
    assert lens.project(rays)[1].all()
    assert rms_px < limit_px
    assert max_px < 1.0


@pytest.mark.parametrize("n_coefficients", [4, 5])
def test_fit_lens_reported_error_is_true(three_sensor_rig, n_coefficients):
    true = three_sensor_rig.cameras["left"].to_intrinsics()
    lens, rms_px, max_px = fit_lens(true, f"radtan{n_coefficients}")
    assert len(lens.distortion) == n_coefficients
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, [true.width_px - 1, true.height_px - 1], (2000, 2))
    drawn, is_seen = lens.project(true.unproject(pixels))
    off_px = np.linalg.norm(drawn - pixels, axis=1)
    assert is_seen.all() and off_px.max() < 1.05 * max_px < 1.0
    assert 0.5 * rms_px < np.sqrt(np.mean(off_px**2)) < 1.2 * rms_px
    # No other start finds a better one: the true camera matrix alone is worse.
    kept = replace(true, distortion=true.distortion[:n_coefficients])
    assert np.sqrt(np.mean(np.sum((kept.project(true.unproject(pixels))[0] - pixels) ** 2, axis=1))) > rms_px
