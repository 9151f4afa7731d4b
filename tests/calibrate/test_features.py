"""Features: where points and ring ends come to lie, and what the camera's uncertainty does to the normal."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate.features import extract_features
from lce_rig.core.geometry import exp_so3, transform
from lce_rig.core.results import Observation
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, simulate


def observe(seed=0, **scenario):
    return simulate(1, seed, Scenario(**scenario))[0]


def test_points_are_projected_along_their_rays_by_default():
    observation = observe()
    points = extract_features(observation, BOARD).plane_points
    plane = observation.lidar.plane
    np.testing.assert_allclose(points @ plane[:3] + plane[3], 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(points, observation.lidar.points), 0, atol=1e-12)


@pytest.mark.parametrize(("half_step", "bias_m"), [(True, 0.0), (False, 0.0035)])
def test_half_a_step_removes_the_bias_of_ring_ends(half_step, bias_m):
    beyond = []
    for seed in range(20):
        observation = observe(seed, range_sigma_m=0.0, corner_sigma_px=0.0)
        features = extract_features(observation, BOARD, half_step=half_step)
        ends = transform(features.T_board_cam @ T_FORWARD, features.edge_points)
        is_inside = np.all(np.abs(ends[:, :2]) < [BOARD.width_m / 2, BOARD.height_m / 2], axis=1)
        beyond.append(np.where(is_inside, 1, -1) * BOARD.outline_distance(ends))
    mean_m = np.concatenate(beyond).mean()
    assert abs(mean_m - bias_m) < 0.001


def test_a_grazing_ray_is_not_thrown_far_away():
    observation = observe()
    lidar = observation.lidar
    along = lidar.points[0] / np.linalg.norm(lidar.points[0])
    grazing = np.cross(along, np.cross(lidar.plane[:3], along))
    plane = np.append(grazing / np.linalg.norm(grazing), lidar.plane[3])
    features = extract_features(Observation("a", observation.image, replace(lidar, plane=plane)), BOARD)
    assert np.abs(features.plane_points).max() < 50


def test_the_covariance_of_the_normal_agrees_with_sampling():
    rng = np.random.default_rng(0)
    root = np.diag([1e-3, 1e-3, 1e-3, 0.01, 0.02, 0.005]) @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6)))
    observation = observe()
    image = replace(observation.image, cov=root @ root.T)
    features = extract_features(replace(observation, image=image), BOARD)
    samples = exp_so3((rng.normal(size=(20_000, 6)) @ root.T)[:, 3:]) @ features.normal
    np.testing.assert_allclose(np.cov(samples.T), features.cov_normal, atol=3e-5)
