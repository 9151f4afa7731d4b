"""Two cameras that saw the same boards, alone, or with a LiDAR that shares boards with one of them."""

import numpy as np
import pytest

from lce_rig.core.calibration import ResultFile, read_result
from lce_rig.core.geometry import difference, invert, perturb
from lce_rig.core.rig_poses import find_rig_poses
from lce_rig.detect.detection import Detections
from lce_rig.export import write_exports
from lce_rig.pipeline.calibration import calibrate_detections
from tests.calibrate.four_sensors import ON_FRONT, error, make_rig, measure_errors, simulate

N = 20
BOTH = ("left", "right")


def stereo(seed, **kwargs):
    """Profile with errors as it states them, and N placements that both cameras see."""
    return make_rig(BOTH, seed=seed), simulate(N, seed, sensors=BOTH, n_seeing=(2,), **kwargs)


@pytest.fixture(scope="module")
def alone():
    return calibrate_detections(*stereo(0))


def test_two_cameras_errors_fit_covariance(alone):
    (c,), shortages = alone
    assert not shortages and (c.camera, c.lidar, c.lidar_channel) == ("left", "right", "frames")
    assert c.verdict == "pass" and len(c.captures_used) == N
    x = error(c)
    assert x @ np.linalg.solve(c.cov, x) < 20
    assert np.degrees(np.linalg.norm(x[3:])) < 0.1 and np.linalg.norm(x[:3]) < 0.02


def test_two_cameras_result_reads_back_and_exports(alone, tmp_path):
    (c,), _ = alone
    (tmp_path / "result.json").write_text(ResultFile(rig="four", pairs=(c,)).text())
    (back,) = read_result(tmp_path / "result.json").pairs
    assert back.is_of_cameras and back.lidar_intrinsics == c.lidar_intrinsics
    assert np.array_equal(back.T_cam_lidar, c.T_cam_lidar)
    write_exports([back], make_rig(BOTH), tmp_path, formats=["extrinsics", "urdf", "kalibr", "static_tf"])
    chain = (tmp_path / "camchain.yaml").read_text()
    assert "T_cn_cnm1" in chain and chain.count("camera_model") == 2
    assert '<child link="right_link"/>' in (tmp_path / "four.urdf").read_text()


def test_camera_that_moved_fails_and_is_dated():
    after = perturb(ON_FRONT["right"], np.r_[0.01, 0.0, 0.01, np.radians([0.6, 0.0, 0.8])])
    moves = {"right": lambda k: ON_FRONT["right"] if k < N // 2 else after}
    (c,), _ = calibrate_detections(*stereo(1, moves=moves))
    assert c.verdict == "fail"
    first = next(f for f in c.findings if f.severity != "note")
    assert first.code == "verdict.moved" and 8 <= first.figures["n_captures"] <= 12


@pytest.mark.long
def test_camera_without_lidar_hangs_on_the_rig():
    sensors = ("left", "right", "front")
    found = simulate(40, 0, sensors=sensors, n_seeing=(2,))
    right = {
        name: image
        for name, image in found.images["right", "frames"].items()
        if name not in found.lidars["front"]
    }
    detections = Detections({**found.images, ("right", "frames"): right}, found.lidars)
    rig = make_rig(sensors)
    results, shortages = calibrate_detections(rig, detections)
    assert not shortages
    assert [(c.camera, c.lidar) for c in results] == [("left", "front"), ("left", "right")]
    assert results[0].estimated_with == ("right",)
    poses = {each.sensor: each for each in find_rig_poses(results, rig.lidars).sensors}
    off = difference(invert(poses["right"].T_base_sensor), ON_FRONT["right"])
    assert np.degrees(np.linalg.norm(off[3:])) < 0.3 and np.linalg.norm(off[:3]) < 0.03


@pytest.mark.long
def test_rig_in_two_parts_asks_for_placement():
    found = simulate(40, 0)
    front = {n: b for n, b in found.lidars["front"].items() if n in found.images["left", "frames"]}
    rear = {
        n: b
        for n, b in found.lidars["rear"].items()
        if n in found.images["right", "frames"] and n not in front
    }
    left = {n: found.images["left", "frames"][n] for n in front}
    right = {n: found.images["right", "frames"][n] for n in rear if n not in left}
    detections = Detections(
        {("left", "frames"): left, ("right", "frames"): right}, {"front": front, "rear": rear}
    )
    results, shortages = calibrate_detections(make_rig(), detections)
    assert {(c.camera, c.lidar) for c in results} == {("left", "front"), ("right", "rear")}
    (shortage,) = shortages
    assert shortage.code == "shortage.unconnected" and shortage.subject == "rear and right"
    assert "where both front and rear see it" in shortage.sentence


def test_lidar_in_no_capture_is_named():
    found = simulate(30, 0, sensors=("left", "front"), n_seeing=(2,))
    _, shortages = calibrate_detections(make_rig(), found)
    assert "no capture holds a scan of rear" in [each.text for each in shortages]


@pytest.mark.slow
def test_two_cameras_covariances_fit_many_sessions():
    """60 sessions of 20 placements, with profiles that err as they state."""
    results = [c for seed in range(60) for c in calibrate_detections(*stereo(seed))[0]]
    rms_deg, rms_mm, covered = measure_errors(results)
    assert rms_deg < 0.03 and rms_mm < 6.0 and covered > 0.92
