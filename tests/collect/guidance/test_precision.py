"""Predicted rings and covariance against scans, the calibration's own matrices and its errors over seeds."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings
from lce_rig.calibrate.estimate import estimate_observations
from lce_rig.calibrate.likelihood.levels import Levels
from lce_rig.collect.guidance.evidence import cross_board, sigmas
from lce_rig.core.geometry import difference, invert, transform
from lce_rig.core.results import Observation
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, photograph, scan_board
from tests.collect.guidance.boards import model, placements, predict_covariance


def observe(poses, seed, scenario):
    rng = np.random.default_rng(seed)
    captures = []
    for k, T_cam_board in enumerate(poses):
        lidar = scan_board(invert(T_FORWARD) @ T_cam_board, rng, scenario, BOARD)
        captures.append(Observation(f"{k:06d}", photograph(T_cam_board, rng, scenario, BOARD), lidar))
    return captures


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    every = placements(40, seed=5)
    seen = [photograph(T, rng, Scenario(), BOARD) is not None for T in every]
    return every[seen][:14]


@pytest.mark.parametrize("laser_m", [1e-6, 0.008])
def test_prediction_matches_calibration_covariance(poses, laser_m):
    scenario = Scenario(range_sigma_m=0.008, corner_sigma_px=0.05, laser_bias_sigma_m=laser_m)
    options = EstimateSettings(laser_bias_sigma_m=laser_m, range_offset_sigma_m=0.005)
    estimate = estimate_observations(observe(poses, 3, scenario), BOARD, options)
    (joint, _), inflation = estimate.joint, estimate.diagnostics.covariance_inflation
    predicted = predict_covariance(model(joint.priors, joint.levels), poses, T_FORWARD)
    ratios = np.sqrt(np.diag(predicted) / np.diag(estimate.cov / inflation))
    assert np.all((ratios > 1 / 1.3) & (ratios < 1.3))
    for actual, expected in zip(sigmas(estimate.cov / inflation), sigmas(predicted), strict=True):
        assert 1 / 1.15 < expected / actual < 1.15


def test_precision_improves_with_more_lasers(poses):
    # 64 lasers are grouped by four, whose errors average out.
    elevations = [np.radians(np.linspace(-15.0, 15.0, n)) for n in (16, 64)]
    models = [replace(model(), elevations_rad=each) for each in elevations]
    few, many = (sigmas(predict_covariance(each, poses, T_FORWARD)) for each in models)
    assert 0.5 * few[0] < many[0] < few[0]
    assert 0.5 * few[1] < many[1] < few[1]


@pytest.mark.long
def test_predicted_scatter_matches_many_sessions(poses):
    scenario = Scenario(range_sigma_m=0.008, corner_sigma_px=0.05)
    estimates = [
        estimate_observations(observe(poses, seed, scenario), BOARD, EstimateSettings())
        for seed in range(100, 125)
    ]
    errors = np.array([difference(each.T_cam_lidar, T_FORWARD) for each in estimates])
    joint, _ = estimates[0].joint
    predicted = predict_covariance(model(joint.priors, joint.levels), poses, T_FORWARD)
    # Priors and noise levels allow for errors that this simulator lacks.
    for actual, expected in zip(sigmas(np.cov(errors.T)), sigmas(predicted), strict=True):
        assert 0.9 < expected / actual < 4.0


def test_precision_repetition_helps_less(poses):
    before = np.array(sigmas(predict_covariance(model(), poses[:6], T_FORWARD)))
    after = np.array(sigmas(predict_covariance(model(), poses[:7], T_FORWARD)))
    again = np.array(sigmas(predict_covariance(model(), poses[[*range(7), 6]], T_FORWARD)))
    assert np.all(after < before)
    assert np.all(before - after > after - again)


def test_noisier_captures_raise_the_prediction(poses):
    usual, noisy = model(), replace(model(), levels=replace(Levels(), tilt_rad=0.01, range_m=0.03))
    calm, rough = (sigmas(predict_covariance(each, poses, T_FORWARD)) for each in (usual, noisy))
    assert rough[0] > 1.1 * calm[0] and rough[1] > calm[1]
    widened = sigmas(predict_covariance(replace(usual, inflation=4.0), poses, T_FORWARD))
    assert widened == pytest.approx(2 * np.array(calm))


def test_cross_board_matches_a_scan():
    poses = invert(T_FORWARD) @ placements(20, seed=1)
    rings = cross_board(model(), poses)
    rng = np.random.default_rng(2)
    for k, T_lidar_board in enumerate(poses):
        scan = scan_board(T_lidar_board, rng, Scenario(range_sigma_m=0.0), BOARD)
        counts = np.bincount(scan.ring, minlength=16)
        is_long = counts > 10
        # One more or less at either end, and what lies between two samples of the prediction.
        assert np.all(np.abs(rings.n_points[k] - counts)[is_long] <= 2 + 0.05 * counts[is_long])
        ends = transform(invert(T_lidar_board), scan.edge_points)[:, :2]
        miss = np.linalg.norm(rings.ends[k, scan.edge_ring] - ends[:, None], axis=-1).min(axis=1)
        length_m = np.linalg.norm(rings.ends[k, :, 1] - rings.ends[k, :, 0], axis=-1)
        spacing_m = length_m / np.maximum(rings.n_points[k], 1)
        assert np.all(miss <= 1.5 * spacing_m[scan.edge_ring] + 0.02)
