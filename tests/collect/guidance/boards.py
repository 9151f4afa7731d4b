"""Sensors and placements that the tests of guidance share."""

import numpy as np

from lce_rig.collect.guidance.evidence import combine, weigh_placements
from lce_rig.collect.guidance.sensor_model import ErrorModel, SensorModel, SensorPlace
from lce_rig.core.geometry import invert
from lce_rig.rig import QualitySettings
from tests.calibrate.boards import BOARD, CAMERA, T_FORWARD, Scenario, random_pose, scan_board

# What the simulator of boards has: white noise, no side of a board that is drawn by what stands behind it.
SURROGATE = ErrorModel(
    corner_px=0.1,
    range_m=0.01,
    ring_end_m=0.0,
    side_m=0.0,
    tilt_rad=0.0,
    depth_m=0.0,
    laser_bias_m=0.0,
    range_offset_m=0.0,
)


def model(errors=None):
    """Describe a VLP-16 and a camera before the board of the calibration's tests."""
    return SensorModel(
        board=BOARD,
        lens=CAMERA,
        elevations_rad=np.radians(np.arange(-15.0, 16.0, 2.0)),
        azimuth_step_rad=float(np.radians(0.2)),
        limits=QualitySettings(),
        target_sigma_rad=float(np.radians(0.2)),
        target_sigma_m=0.01,
        errors=errors or ErrorModel(),
    )


def view(errors=None):
    """Look along the LiDAR's x axis."""
    return SensorPlace(model(errors), T_FORWARD)


def placements(n, seed):
    """Draw T_cam_board (n, 4, 4) that the LiDAR sees well."""
    rng = np.random.default_rng(seed)
    exact = Scenario(range_sigma_m=0.0)
    found = []
    while len(found) < n:
        T_cam_board = random_pose(rng, exact, BOARD)
        if scan_board(invert(T_FORWARD) @ T_cam_board, rng, exact, BOARD) is not None:
            found.append(T_cam_board)
    return np.array(found)


def predict_covariance(model, T_cam_board, T_cam_lidar):
    """Predict the covariance (6, 6) of T_cam_lidar from boards at T_cam_board (N, 4, 4)."""
    return combine(weigh_placements(model, T_cam_board, T_cam_lidar), model.errors).cov
