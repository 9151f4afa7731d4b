"""Which sessions tell a LiDAR's constant errors."""

from dataclasses import replace

import numpy as np
import pytest

import lce_rig as lce
from lce_rig.core.errors import ResultRefusedError
from lce_rig.core.geometry import perturb
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.measure_lidar import measure_lidar
from tests.calibrate.boards import Scenario, simulate


def seen(moved_m):
    """Detect boards that move along their normals between scan and image."""
    captures = simulate(16, 1, Scenario(laser_bias_sigma_m=0.008))
    rng = np.random.default_rng(3)
    images = {}
    for item in captures:
        T = item.image.T_cam_board
        move = np.r_[moved_m * rng.standard_normal() * T[:3, 2], np.zeros(3)]
        images[item.capture] = replace(item.image, T_cam_board=perturb(T, move))
    return Detections({("cam", "frames"): images}, {"lidar": {i.capture: list(i.places) for i in captures}})


def test_boards_that_moved_between_image_and_scan_are_refused_with_an_action(tmp_path):
    session = lce.Session.create(tmp_path / "session", lce.load_rig("rlfs"))
    errors = measure_lidar([session], found=[seen(0.0)])
    assert errors.n_captures == (16,)
    with pytest.raises(ResultRefusedError) as refused:
        measure_lidar([session], found=[seen(0.03)])
    assert str(session.path) in refused.value.what
    assert refused.value.hint
