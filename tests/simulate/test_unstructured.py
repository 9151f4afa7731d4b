"""LiDARs without rings: simulated from data sheets, and calibrated within the reported covariance."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, error_to_reference, fit_extrinsic
from lce_rig.core.data import NO_RING
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import difference
from lce_rig.core.results import Observation
from lce_rig.detect.finder import BoardFinder
from lce_rig.rig import load_rig
from lce_rig.simulate import SimulationOptions, simulate_captures, truth_extrinsics
from tests.shared import changed


def of_model(model):
    return changed(load_rig("mid360"), lidars__lidar__model=model)


@pytest.mark.long
@pytest.mark.parametrize("model", ["Mid-360", "Avia"])
def test_beams_fill_the_view_and_find_board(model):
    rig = of_model(model)
    sheet = rig.lidars["lidar"].data_sheet()
    assert sheet is not None
    options = SimulationOptions(truth_rotation_deg=0.0)
    (capture,) = simulate_captures(rig, n_captures=1, seed=2, options=options)
    (scan,) = capture.scans
    assert set(scan.ring) == {NO_RING} and len(scan.points) > 0.8 * sheet.points_hz
    x, y, z = scan.points.T.astype(np.float64)
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    assert sheet.fov_deg[1] - 0.5 < elevation.min() < elevation.max() < sheet.fov_deg[2] + 0.5
    assert np.degrees(np.abs(np.arctan2(y, x)).max()) < sheet.fov_deg[0] / 2 + 0.5
    found = BoardFinder(rig).scan(scan)
    assert not isinstance(found, Refusal)
    T = capture.T_lidar_board["lidar"]
    assert np.linalg.norm(found[0].T_lidar_board[:3, 3] - T[:3, 3]) < 0.01
    assert np.degrees(np.arccos(min(1.0, found[0].plane[:3] @ T[:3, 2]))) < 0.4


@pytest.mark.long
def test_extrinsics_lie_within_their_covariance():
    rig, seed = of_model("Mid-360"), 4
    finder, lidar, seen = BoardFinder(rig), rig.lidars["lidar"], []
    fewer = replace(SimulationOptions(), truth_rotation_deg=3.0)
    for capture in simulate_captures(rig, n_captures=8, seed=seed, options=fewer):
        image, places = finder.image(capture.images[0]), finder.scan(capture.scans[0])
        if not isinstance(image, Refusal) and not isinstance(places, Refusal):
            seen.append(Observation.of(str(capture.index), image, places))
    assert len(seen) >= 6
    settings = EstimateSettings(method="ml", range_offset_sigma_m=lidar.range_offset_sigma_m, has_rings=False)
    estimate = fit_extrinsic(seen, rig.board.to_board(), settings)
    truth = truth_extrinsics(rig, seed, fewer)["cam", "lidar"]
    angle_deg, distance_m = error_to_reference(estimate.T_cam_lidar, truth)
    assert angle_deg < 0.25 and distance_m < 0.015
    off = difference(estimate.T_cam_lidar, truth)
    assert off @ np.linalg.solve(estimate.cov, off) < 22.5  # 99.9 % of chi squared with 6 freedoms
