"""Range errors that all captures share: what they do to the solution, and whether the covariance says so."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.calibrate.algorithm_1.algorithm import solve
from lce_rig.calibrate.algorithm_1.moments import Problem, Weights
from lce_rig.calibrate.plane_and_ends import extract_features
from lce_rig.calibrate.uncertainty import moves_by_scans, systematic_covariances
from lce_rig.core.geometry import difference, fit_plane
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, simulate

NO_DRAWS = EstimateSettings("paper")
LASER_SIGMA_M, OFFSET_SIGMA_M = 0.008, 0.005
RINGS = np.arange(16, dtype=np.int16)


def longer(item, rings, offset_m):
    """Measure a capture's board again with the ranges of some rings lengthened, the plane fitted anew."""
    lidar = item.lidar

    def moved(points, ring):
        reach = np.linalg.norm(points, axis=1)
        return points * (1 + offset_m * np.isin(ring, rings) / reach)[:, None]

    points = moved(lidar.points, lidar.ring)
    ends = moved(lidar.edge_points, lidar.edge_ring)
    plane, _ = fit_plane(points)
    return replace(item, surface=replace(lidar, points=points, edge_points=ends, plane=plane))


def linearised(captures):
    """Solve captures for good, and differentiate the solution by each ring's offset."""
    features = [extract_features(seen, BOARD) for seen in captures]
    problem = Problem(features, Weights(3e4, 2e5))
    solution = problem.solve(np.ones((1, len(features))), T_FORWARD, 5)
    cost = problem.quadratics(solution.x[0], solution.edge_ids[0])
    start = replace(solve(captures, BOARD), fitted=captures, problem=problem, cost=cost)
    return solution.T[0], solution.linear[0, 3], moves_by_scans(start, BOARD)[0].T


@pytest.mark.parametrize("rings", [[5], [11], list(range(16))])
def test_longer_ranges_match_sensitivities(rings):
    captures = simulate(15, 4)
    T, shift_m, columns = linearised(captures)
    seen = np.unique(np.concatenate([item.lidar.ring for item in captures]))
    T_moved, shift_moved_m, _ = linearised([longer(item, rings, 0.005) for item in captures])
    motion = np.append(difference(T_moved, T), shift_moved_m - shift_m)
    expected = 0.005 * columns[:, np.isin(seen, rings)].sum(axis=1)
    # Board at 2 m: metres and radians are comparable. fit_plane weighs points otherwise than ranges do.
    np.testing.assert_allclose(motion, expected, atol=0.1 * np.linalg.norm(expected))


def normalised_errors(options, n_seeds):
    """e^T cov^-1 e (n,) of LiDARs whose lasers err by 8 mm about a mean that is off by 5 mm."""
    nees = []
    for seed in range(n_seeds):
        offset_m = OFFSET_SIGMA_M * np.random.default_rng([seed, 2]).standard_normal()
        scenario = Scenario(laser_bias_sigma_m=LASER_SIGMA_M, range_offset_m=offset_m)
        estimate = fit_extrinsic(simulate(20, seed, scenario), BOARD, options)
        error = difference(estimate.T_cam_lidar, T_FORWARD)
        nees.append(error @ np.linalg.solve(estimate.cov, error))
    return np.array(nees)


@pytest.mark.long
@pytest.mark.parametrize("n_seeds", [12, pytest.param(40, marks=pytest.mark.slow)])
def test_known_range_errors_are_in_covariance(n_seeds):
    nees = normalised_errors(
        replace(NO_DRAWS, laser_bias_sigma_m=LASER_SIGMA_M, range_offset_sigma_m=OFFSET_SIGMA_M), n_seeds
    )
    # 6 expected, less because biases also scatter; the mean of 40 samples is good to 0.55, of 12 to 1.0.
    assert 3.0 < nees.mean() < 7.5


@pytest.mark.long
def test_range_errors_unknown_raise_nees():
    assert normalised_errors(NO_DRAWS, 12).mean() > 12.0


def test_range_offset_is_in_the_covariance():
    options = replace(NO_DRAWS, range_offset_sigma_m=0.02)
    estimate = fit_extrinsic(simulate(20, 3, Scenario(range_offset_m=0.02)), BOARD, options)
    error = difference(estimate.T_cam_lidar, T_FORWARD)
    assert 0.01 < np.linalg.norm(error[:3]) < 0.03
    assert 0.01 < estimate.diagnostics.sigma_systematic_translation_m < 0.03
    assert error @ np.linalg.solve(estimate.cov, error) < 16.8  # 99 % of chi square with 6 degrees


def test_systematic_errors_only_widen():
    captures = simulate(12, 6)
    pure = fit_extrinsic(captures, BOARD, NO_DRAWS)
    wider = fit_extrinsic(
        captures, BOARD, replace(NO_DRAWS, laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005)
    )
    assert pure.T_cam_lidar.tobytes() == wider.T_cam_lidar.tobytes()
    assert np.linalg.eigvalsh(wider.cov - pure.cov).min() > 0
    for kind, trace in (
        ("rotation_deg", lambda cov: np.degrees(np.sqrt(np.trace(cov[3:, 3:])))),
        ("translation_m", lambda cov: np.sqrt(np.trace(cov[:3, :3]))),
    ):
        scatter, added = (
            getattr(wider.diagnostics, f"sigma_{part}_{kind}") for part in ("scatter", "systematic")
        )
        assert getattr(pure.diagnostics, f"sigma_systematic_{kind}") == 0
        assert getattr(pure.diagnostics, f"sigma_scatter_{kind}") == scatter == pytest.approx(trace(pure.cov))
        assert np.hypot(scatter, added) == pytest.approx(trace(wider.cov))


def test_systematic_covariance_fits_samples():
    rng = np.random.default_rng(3)
    sensitivities = rng.normal(size=(3, 5))
    own = 0.2 * rng.normal(size=(100_000, 5))
    sources = own - own.mean(axis=1, keepdims=True) + 0.3 * rng.normal(size=(100_000, 1))
    sampled = np.cov(sources @ sensitivities.T, rowvar=False)
    expected = sum(systematic_covariances(sensitivities, 0.2, 0.3))
    np.testing.assert_allclose(sampled, expected, atol=0.02 * np.trace(expected))
