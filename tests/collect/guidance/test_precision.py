"""Predicted rings and covariance against scans, the calibration's own matrices and its errors over seeds."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings
from lce_rig.calibrate.estimate import estimate_observations
from lce_rig.collect.guidance.evidence import combine, cross_board, sigmas, weigh_placements
from lce_rig.collect.guidance.sensor_model import ErrorModel
from lce_rig.core.geometry import difference, invert, transform
from lce_rig.core.results import Observation
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, photograph, scan_board
from tests.collect.guidance.boards import SURROGATE, model, placements, predict_covariance


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


@pytest.mark.long
def test_predicted_scatter_is_that_of_many_sessions(poses):
    scenario = Scenario(range_sigma_m=0.01, corner_sigma_px=0.1)
    # The prediction has the weights of Algorithm 1; the joint likelihood is better than predicted.
    options = EstimateSettings("paper")
    runs = [estimate_observations(observe(poses, seed, scenario), BOARD, options) for seed in range(100, 125)]
    errors = np.array([difference(run.T_cam_lidar, T_FORWARD) for run in runs])
    figures = [run.diagnostics for run in runs]
    learned = SURROGATE
    for key, name in (("plane_m", "fit_plane_rms_m"), ("edge_m", "fit_edge_rms_m")):
        learned = replace(learned, **{key: float(np.mean([getattr(each, name) for each in figures]))})
    predicted = combine(weigh_placements(model(learned), poses, T_FORWARD), learned)
    for actual, expected in zip(sigmas(np.cov(errors.T)), sigmas(predicted.cov), strict=True):
        assert 0.75 < expected / actual < 1.33


def test_a_placement_more_makes_it_better_and_a_second_of_the_same_kind_less_so(poses):
    before = np.array(sigmas(predict_covariance(model(), poses[:6], T_FORWARD)))
    after = np.array(sigmas(predict_covariance(model(), poses[:7], T_FORWARD)))
    again = np.array(sigmas(predict_covariance(model(), poses[[*range(7), 6]], T_FORWARD)))
    assert np.all(after < before)
    assert np.all(before - after > after - again)


def test_worse_residuals_than_expected_are_learned():
    prior = ErrorModel()
    learned = prior.learned(plane_rms_m=0.03, edge_rms_m=0.01, n_captures=15)
    assert 0.02 < learned.plane_m < 0.03
    assert learned.tilt_rad > 5 * prior.tilt_rad
    assert learned.side_m > 1.5 * prior.side_m
    same = prior.learned(prior.plane_m, prior.edge_m, 15)
    assert same.side_m == pytest.approx(prior.side_m)
    assert same.tilt_rad == pytest.approx(prior.tilt_rad)


def test_rings_their_points_and_their_ends_are_those_of_a_scan():
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
        assert np.all(miss <= 1.5 * rings.spacing_m[k, scan.edge_ring] + 0.02)
