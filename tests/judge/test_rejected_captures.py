"""Rejected captures that agree on another mounting are not outliers."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Calibration
from lce_rig.core.geometry import Array, exp_so3, perturb, pose, transform
from lce_rig.core.results import LidarBoard, Observation
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import load_rig
from lce_rig.rig.sensors import IntrinsicsSettings
from tests.calibrate.boards import CAMERA, simulate

_SHIPPED = load_rig("rlfs")
_LENS = IntrinsicsSettings(
    fx_px=CAMERA.fx_px,
    fy_px=CAMERA.fy_px,
    cx_px=CAMERA.cx_px,
    cy_px=CAMERA.cy_px,
    distortion=CAMERA.distortion,
    focal_sigma_px=1.3,
    principal_point_sigma_px=0.9,
    distortion_sigma_px=0.45,
)
_CAMERA = _SHIPPED.cameras["cam"].model_copy(update={"intrinsics": _LENS})
RIG = _SHIPPED.model_copy(update={"cameras": {"cam": _CAMERA}})
PAPER = CalibrateOptions("paper")


def taken_by_moved_lidar(lidar: LidarBoard, T: Array) -> LidarBoard:
    normal = T[:3, :3] @ lidar.plane[:3]
    return replace(
        lidar,
        points=transform(T, lidar.points),
        edge_points=transform(T, lidar.edge_points),
        plane=np.r_[normal, lidar.plane[3] - normal @ T[:3, 3]],
        T_lidar_board=T @ lidar.T_lidar_board,
    )


def moved(boards: list[Observation], captures: range, T: Array) -> list[Observation]:
    return [
        replace(board, surface=taken_by_moved_lidar(board.lidar, T)) if k in captures else board
        for k, board in enumerate(boards)
    ]


def turned(angle_deg: float, axis: int = 2) -> Array:
    return pose(exp_so3(np.radians(angle_deg) * np.eye(3)[axis]), np.zeros(3))


def calibrated(boards: list[Observation]) -> Calibration:
    images = {("cam", "frames"): {board.capture: board.image for board in boards}}
    detections = Detections(images, {"lidar": {board.capture: [board.lidar] for board in boards}})
    (calibration,), _ = calibrate_detections(RIG, detections, PAPER)
    return calibration


@pytest.mark.long
@pytest.mark.parametrize("angle_deg", [1.5, 3.0, 5.0])
@pytest.mark.parametrize("n_moved", [2, 3])
def test_a_sensor_that_moved_before_the_last_captures_fails(n_moved: int, angle_deg: float) -> None:
    calibration = calibrated(moved(simulate(15, 2), range(15 - n_moved, 15), turned(angle_deg)))
    first = calibration.findings[0]
    assert calibration.verdict == "fail"
    assert first.code == "verdict.moved"
    assert first.figures["rotation_deg"] == pytest.approx(angle_deg, rel=0.3)
    assert first.figures["place"] == "last"
    assert first.figures["captures"] == tuple(f"{k:06d}" for k in range(15 - n_moved, 15))
    assert first.figures["neighbour"] == f"{14 - n_moved:06d}"


@pytest.mark.long
def test_early_moved_sensor_does_not_pass() -> None:
    calibration = calibrated(moved(simulate(15, 3), range(2), turned(3.0, 0)))
    first = calibration.findings[0]
    assert (calibration.verdict, first.code) == ("marginal", "verdict.moved")
    assert (first.figures["place"], first.figures["neighbour"]) == ("first", "000002")


@pytest.mark.long
def test_agreeing_captures_are_one_mounting_in_any_order() -> None:
    boards = simulate(18, 4)
    away = (3, 8, 12)
    boards = [moved([board], range(1 if k in away else 0), turned(4.0))[0] for k, board in enumerate(boards)]
    (finding,) = (f for f in calibrated(boards).findings if f.code == "verdict.moved")
    assert finding.figures["captures"] == tuple(f"{k:06d}" for k in away)
    assert finding.figures["place"] == ""


def test_the_last_capture_alone_is_named() -> None:
    calibration = calibrated(moved(simulate(15, 2), range(14, 15), turned(4.0)))
    assert calibration.verdict == "pass"
    (finding,) = (f for f in calibration.findings if f.code == "verdict.last_rejected")
    assert finding.figures["capture"] == "000014"


@pytest.mark.long
def test_lone_outliers_are_no_moved_sensor() -> None:
    rng = np.random.default_rng(5)
    for seed in range(4):
        boards = simulate(15, seed)
        for k in (13, 14):
            step = rng.standard_normal(6) * np.repeat([0.06, 0.03], 3)
            boards = moved(boards, range(k, k + 1), perturb(np.eye(4), step))
        calibration = calibrated(boards)
        assert not [f for f in calibration.findings if f.code == "verdict.moved"]
