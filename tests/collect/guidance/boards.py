"""Sensors and placements that the tests of guidance share."""

import numpy as np

from lce_rig.calibrate.likelihood.levels import Levels, Priors
from lce_rig.collect.guidance.evidence import Predictor
from lce_rig.collect.guidance.sensor_model import SensorModel, SensorPlace
from lce_rig.core.geometry import invert
from lce_rig.rig import QualitySettings
from tests.calibrate.boards import BOARD, CAMERA, T_FORWARD, Scenario, random_pose, scan_board


def model(priors=None, levels=None):
    """Build the model of a VLP-16 and a camera that face the board of the calibration's tests."""
    return SensorModel(
        board=BOARD,
        lens=CAMERA,
        elevations_rad=np.radians(np.arange(-15.0, 16.0, 2.0)),
        azimuth_step_rad=float(np.radians(0.2)),
        limits=QualitySettings(),
        target_sigma_rad=float(np.radians(0.2)),
        target_sigma_m=0.01,
        priors=priors or Priors(),
        levels=levels or Levels(),
    )


def view():
    """Look along the LiDAR's x axis."""
    return SensorPlace(model(), T_FORWARD)


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
    predictor = Predictor(model, T_cam_lidar)
    return predictor.combine(predictor.weigh(T_cam_board)).cov
