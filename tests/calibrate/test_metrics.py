"""Distances from planes and edges, and errors against a reference."""

from dataclasses import replace

import numpy as np

from lce_rig.calibrate.result import capture_residual, error_to_reference, summarise
from lce_rig.core.geometry import exp_so3, pose
from lce_rig.core.results import Observation
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, simulate


def test_the_error_to_a_reference_is_the_angle_and_the_distance():
    T = pose(exp_so3(np.radians([0.0, 0.3, 0.0])) @ T_FORWARD[:3, :3], T_FORWARD[:3, 3] + [0.003, 0, 0.004])
    np.testing.assert_allclose(error_to_reference(T, T_FORWARD), (0.3, 0.005), rtol=1e-9)


def test_noise_of_the_range_is_what_the_plane_residual_shows():
    captures = simulate(6, 0, Scenario(range_sigma_m=0.02, corner_sigma_px=0.0))
    residuals = [capture_residual(T_FORWARD, item, BOARD) for item in captures]
    rms_m = np.sqrt(np.mean([r.plane_rms_m**2 for r in residuals]))
    # Tilted boards see the noise of the range shortened by the cosine of incidence.
    assert 0.014 < rms_m < 0.0205


def test_a_capture_without_ring_ends_does_not_spoil_the_mean():
    item = simulate(1, 0)[0]
    whole = Observation("a", item.image, item.lidar)
    bare = replace(
        whole,
        lidar=replace(
            item.lidar,
            edge_points=np.zeros((0, 3)),
            edge_ring=np.zeros(0, dtype=np.int16),
            edge_side=np.zeros(0, dtype=np.int8),
            edge_behind_m=np.zeros(0),
            edge_echo=np.zeros(0),
        ),
    )
    residuals = [capture_residual(T_FORWARD, observation, BOARD) for observation in (whole, bare)]
    assert np.isnan(residuals[1].edge_mean_m)
    assert summarise(residuals).mee_m == residuals[0].edge_mean_m
