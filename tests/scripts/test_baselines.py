"""Methods to compare with, on simulated boards: exact on exact data, errors as the noise makes them."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.baselines import (
    align_corners,
    align_points,
    fit_line,
    pair_lines,
    settings_of,
    solve_closed_form,
)

from lce_rig.calibrate import error_to_reference, fit_extrinsic
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import difference, exp_so3, pose, transform
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, simulate

METHODS = ("zhou", "corners")
EXACT = Scenario(
    range_sigma_m=0.0, corner_sigma_px=0.0, step_deg=0.01, template_sigma_rad=0.0, template_sigma_m=0.0
)


def observations(n, seed, scenario):
    found = find_consensus(simulate(n, seed, scenario), BOARD)
    assert found is not None
    return found.observations


@pytest.mark.parametrize("method", METHODS)
def test_exact_data_give_the_exact_extrinsic(method):
    estimate = fit_extrinsic(simulate(8, 0, EXACT), BOARD, settings_of(method))
    angle_deg, distance_m = error_to_reference(estimate.T_cam_lidar, T_FORWARD)
    # Ring ends lie up to one step, 0.5 mm, inside the border.
    assert angle_deg < 0.02
    assert distance_m < 5e-4
    assert len(estimate.used) == 8


@pytest.fixture(scope="module")
def noisy():
    """Eight sets of 30 captures."""
    return [simulate(30, seed, Scenario(range_sigma_m=0.02)) for seed in range(8)]


# Corners come from the registered outline: simulated with 10 mm and 30 mrad of noise a board, 18 mm a corner.
@pytest.mark.parametrize(("method", "rms_deg", "rms_mm"), [("zhou", 0.2, 5.5), ("corners", 0.33, 13.0)])
def test_errors_are_as_small_as_the_noise_lets_them_be_and_the_claim_fits(noisy, method, rms_deg, rms_mm):
    errors, nees = [], []
    for captures in noisy:
        estimate = fit_extrinsic(captures, BOARD, settings_of(method))
        error = difference(estimate.T_cam_lidar, T_FORWARD)
        errors.append(error)
        nees.append(error @ np.linalg.solve(estimate.cov, error))
    squares = np.mean(np.square(errors), axis=0)
    assert np.degrees(np.sqrt(squares[3:].sum())) < rms_deg
    assert 1e3 * np.sqrt(squares[:3].sum()) < rms_mm
    # 6 expected; 8 samples of chi square with 6 degrees average within 3 standard errors of 1.2.
    assert 2.4 < np.mean(nees) < 9.7


@pytest.mark.parametrize("method", METHODS)
def test_a_baseline_claims_no_certificate(method):
    estimate = fit_extrinsic(simulate(8, 1), BOARD, settings_of(method))
    assert not estimate.certificate.is_optimal
    assert np.isinf(estimate.certificate.gap)


@pytest.mark.parametrize("method", METHODS)
def test_nearly_parallel_boards_are_refused_by_every_method(method):
    captures = simulate(10, 1, Scenario(facing_deg=1.0, distance_m=(2.0, 2.2)))
    facing = [item for item in captures if abs(item.image.T_cam_board[2, 2]) > 0.9]
    with pytest.raises(NotEnoughDataError, match="nearly parallel"):
        fit_extrinsic(facing, BOARD, settings_of(method))


def test_the_closed_form_is_exact_on_exact_lines_and_planes():
    seen = observations(3, 2, EXACT)
    # Lines and planes as the camera has them, moved into the LiDAR's frame.
    T_lidar_cam = np.linalg.inv(T_FORWARD)
    lines = [
        [
            replace(
                line,
                points=transform(T_lidar_cam, line.anchor + np.array([[-0.1], [0.2]]) * line.direction),
                direction_lidar=T_lidar_cam[:3, :3] @ line.direction,
            )
            for line in pair_lines(observation, BOARD, T_FORWARD)
        ]
        for observation in seen
    ]
    T = solve_closed_form(seen, lines)
    angle_deg, distance_m = error_to_reference(T, T_FORWARD)
    assert angle_deg < 1e-4
    assert distance_m < 1e-5


def test_lines_are_paired_right_whichever_way_up_the_outline_was_registered():
    half_turn = pose(exp_so3(np.array([0, 0, np.pi])), np.zeros(3))
    for observation in observations(6, 3, EXACT):
        turned = replace(
            observation,
            lidar=replace(observation.lidar, T_lidar_board=observation.lidar.T_lidar_board @ half_turn),
        )
        for seen in (observation, turned):
            pairs = pair_lines(seen, BOARD, T_FORWARD)
            assert len(pairs) >= 2
            for pair in pairs:
                assert T_FORWARD[:3, :3] @ pair.direction_lidar @ pair.direction > np.cos(np.radians(1))
                across = np.cross(transform(T_FORWARD, pair.points) - pair.anchor, pair.direction)
                assert np.linalg.norm(across, axis=1).max() < 2e-3


def test_a_line_ignores_a_point_far_off_it():
    rng = np.random.default_rng(0)
    along = np.array([1.0, 2.0, -1.0]) / np.sqrt(6)
    points = np.linspace(0, 0.5, 6)[:, None] * along + 1e-3 * rng.standard_normal((6, 3))
    found = fit_line(np.concatenate([points, [[0.2, 0.5, 0.3]]]))
    assert found is not None
    assert len(found[0]) == 6
    assert abs(found[1] @ along) > np.cos(0.01)
    assert fit_line(points[:1]) is None


def test_corners_find_their_partners_from_a_rough_start():
    rng = np.random.default_rng(1)
    T = pose(exp_so3(np.array([0.2, -0.4, 1.0])), np.array([0.1, -0.2, 0.3]))
    corners_lidar = BOARD.outline() + rng.uniform(-1, 1, (5, 1, 3))
    corners_cam = transform(T, corners_lidar.reshape(-1, 3)).reshape(5, 4, 3)[:, [2, 3, 0, 1]]
    rough = pose(exp_so3(np.array([0.0, 0.08, 0.05])), np.array([0.03, 0.02, -0.05])) @ T
    found, paired = align_corners(corners_lidar, corners_cam, rough)
    assert np.allclose(found, T, atol=1e-12)
    assert np.array_equal(paired, corners_cam[:, [2, 3, 0, 1]])


def test_points_are_aligned_in_the_mean_square():
    rng = np.random.default_rng(2)
    sources = rng.uniform(-1, 1, (50, 3))
    T = pose(exp_so3(rng.uniform(-1, 1, 3)), rng.uniform(-1, 1, 3))
    targets = transform(T, sources) + 0.01 * rng.standard_normal((50, 3))
    best = align_points(targets, sources)

    def cost(candidate):
        return np.sum((targets - transform(candidate, sources)) ** 2)

    assert np.abs(difference(best, T)).max() < 0.01
    for k in range(3):
        for step in (-1e-4, 1e-4):
            turned = pose(exp_so3(step * np.eye(3)[k]), step * np.eye(3)[k]) @ best
            assert cost(turned) > cost(best)
