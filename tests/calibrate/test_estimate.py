"""Algorithm 1 on simulated boards: accuracy, honesty of the covariance, switches, refusals, repeatability."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, capture_residual, error_to_reference, fit_extrinsic
from lce_rig.calibrate.result import summarise
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import difference, exp_so3, pose
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, claim, simulate

FAST = EstimateSettings("paper")


def errors_over_seeds(scenario, n_captures, n_seeds, options=FAST):
    """Errors (n, 6) and normalised squared errors (n,)."""
    errors, nees = [], []
    for seed in range(n_seeds):
        estimate = fit_extrinsic(simulate(n_captures, seed, scenario), BOARD, options)
        error = difference(estimate.T_cam_lidar, T_FORWARD)
        errors.append(error)
        nees.append(error @ np.linalg.solve(claim(estimate), error))
    return np.array(errors), np.array(nees)


def rms_deg_mm(errors):
    squares = np.mean(errors**2, axis=0)
    return np.degrees(np.sqrt(squares[3:].sum())), 1e3 * np.sqrt(squares[:3].sum())


@pytest.mark.long
def test_estimate_30_captures_is_accurate():
    errors, nees = errors_over_seeds(Scenario(range_sigma_m=0.02, corner_sigma_px=0.3), 30, 8)
    rotation_deg, translation_mm = rms_deg_mm(errors)
    assert rotation_deg < 0.06
    assert translation_mm < 3.0
    # 6 expected; 8 samples of chi square with 6 degrees average within 3 standard errors of 1.2.
    assert 2.4 < nees.mean() < 9.7


@pytest.mark.long
def test_ten_captures_covariance_is_not_too_small():
    _, nees = errors_over_seeds(Scenario(), 10, 20)
    assert np.median(nees) < 5.35  # the median of chi square with 6 degrees


def test_exact_data_give_exact_extrinsics():
    scenario = Scenario(range_sigma_m=0.0, corner_sigma_px=0.0, step_deg=0.01)
    estimate = fit_extrinsic(simulate(8, 0, scenario), BOARD, FAST)
    angle_deg, distance_m = error_to_reference(estimate.T_cam_lidar, T_FORWARD)
    assert angle_deg < 0.005
    assert distance_m < 2e-4
    assert estimate.certificate.is_optimal


def test_estimate_footprint_is_edge_shift():
    figures = fit_extrinsic(simulate(20, 0, Scenario(footprint_m=0.008)), BOARD, FAST).diagnostics
    assert abs(figures.edge_shift_m - 0.008) < 4 * figures.edge_shift_sigma_m + 3e-4


def test_estimate_ignores_capture_order():
    captures = simulate(9, 5)
    first, second = fit_extrinsic(captures, BOARD, FAST), fit_extrinsic(captures[::-1], BOARD, FAST)
    assert first.T_cam_lidar.tobytes() == second.T_cam_lidar.tobytes()
    assert first.cov.tobytes() == second.cov.tobytes()
    assert first.diagnostics == second.diagnostics
    assert first.residuals == second.residuals


@pytest.mark.parametrize("turn_deg", [(0, 0, 180), (180, 0, 0), (0, 15, 95)])
def test_estimate_rotated_lidar_is_as_accurate(turn_deg):
    R_turn = exp_so3(np.radians(np.array(turn_deg, dtype=float)))
    T = pose(T_FORWARD[:3, :3] @ R_turn.T, np.array([0.3, -0.2, 0.15]))
    estimate = fit_extrinsic(simulate(12, 3, T_cam_lidar=T), BOARD, FAST)
    angle_deg, distance_m = error_to_reference(estimate.T_cam_lidar, T)
    assert angle_deg < 0.15
    assert distance_m < 0.006
    assert estimate.certificate.is_optimal


def spoil(captures, numbers):
    """Move the board by 6 cm between the sensors in the captures of these numbers."""
    spoilt = list(captures)
    for k in numbers:
        seen = captures[k].lidar
        shift = np.array([0.06, 0.0, 0.0])
        plane = seen.plane - np.append(np.zeros(3), seen.plane[:3] @ shift)
        lidar = replace(seen, points=seen.points + shift, edge_points=seen.edge_points + shift, plane=plane)
        spoilt[k] = replace(captures[k], surface=lidar)
    return spoilt


@pytest.mark.long
def test_estimate_moved_of_100_are_refused():
    numbers = (2, 3, 50, 62, 90)
    estimate = fit_extrinsic(spoil(simulate(100, 9), numbers), BOARD, FAST)
    assert set(estimate.refused) == {f"{k:06d}" for k in numbers}
    assert error_to_reference(estimate.T_cam_lidar, T_FORWARD)[0] < 0.1


def test_estimate_moved_board_is_refused():
    spoilt = spoil(simulate(15, 9), [4])
    estimate = fit_extrinsic(spoilt, BOARD, FAST)
    assert set(estimate.refused) == {"000004"}
    refusal = estimate.refused["000004"]
    assert refusal.code == "calibrate.outlier"
    assert refusal.figure("edges_m") > 0.02 > refusal.figure("edges_median_m")
    assert "000004" not in estimate.used
    assert error_to_reference(estimate.T_cam_lidar, T_FORWARD)[0] < 0.15


def test_too_few_captures_error_states_number():
    with pytest.raises(NotEnoughDataError) as caught:
        fit_extrinsic(simulate(2, 0), BOARD, FAST)
    assert caught.value.finding.code == "shortage.few_captures"
    assert caught.value.finding.figures["n_captures"] == 2


def test_estimate_parallel_boards_is_refused():
    captures = simulate(10, 1, Scenario(facing_deg=1.0, distance_m=(2.0, 2.2)))
    facing = [item for item in captures if abs(item.image.T_cam_board[2, 2]) > 0.9]
    with pytest.raises(NotEnoughDataError) as caught:
        fit_extrinsic(facing, BOARD, FAST)
    found = caught.value.finding
    assert found.code == "shortage.undetermined"
    assert "rotation_z" in found.figures["motions"]
    assert found.figure("spread_deg") < 5


def test_three_well_tilted_boards_are_enough():
    captures = simulate(3, 12, Scenario(tilt_deg=(30.0, 45.0)))
    estimate = fit_extrinsic(captures, BOARD, FAST)
    assert len(estimate.used) == 3
    assert error_to_reference(estimate.T_cam_lidar, T_FORWARD)[0] < 1.0


def test_estimate_residuals_match_extrinsics():
    estimate = fit_extrinsic(simulate(8, 2, Scenario(range_sigma_m=0.01)), BOARD, FAST)
    assert 0.004 < estimate.metrics.mpe_m < 0.012
    assert estimate.metrics.mge_m == estimate.metrics.mpe_m + estimate.metrics.mee_m
    off = estimate.T_cam_lidar.copy()
    off[2, 3] += 0.05
    for residual in estimate.residuals:
        worse = capture_residual(off, estimate.observations[residual.capture], BOARD)
        assert worse.plane_mean_m > 2 * residual.plane_mean_m
        assert residual.plane_mean_m <= residual.plane_rms_m


@pytest.mark.parametrize("method", ["ml", "paper"])
def test_estimate_repeats_keep_sigma(method):
    once = simulate(14, seed=4)
    again = [replace(item, capture=f"1{item.capture[1:]}") for item in once]
    options = EstimateSettings(method)
    single, double = (fit_extrinsic(once, BOARD, options), fit_extrinsic([*once, *again], BOARD, options))
    assert double.diagnostics.n_placements == single.diagnostics.n_placements == 14
    ratio = np.sqrt(np.diag(double.cov) / np.diag(single.cov))
    assert np.all(ratio > 0.85)


def test_error_to_reference_angle_distance():
    T = pose(exp_so3(np.radians([0.0, 0.3, 0.0])) @ T_FORWARD[:3, :3], T_FORWARD[:3, 3] + [0.003, 0, 0.004])
    np.testing.assert_allclose(error_to_reference(T, T_FORWARD), (0.3, 0.005), rtol=1e-9)


def test_plane_residual_shows_range_noise():
    captures = simulate(6, 0, Scenario(range_sigma_m=0.02, corner_sigma_px=0.0))
    residuals = [capture_residual(T_FORWARD, item, BOARD) for item in captures]
    rms_m = np.sqrt(np.mean([r.plane_rms_m**2 for r in residuals]))
    # Tilted boards see the noise of the range shortened by the cosine of incidence.
    assert 0.014 < rms_m < 0.0205


def test_residuals_without_ring_ends_are_nan():
    """The mean is that of the captures with ring ends."""
    item = simulate(1, 0)[0]
    bare = replace(
        item,
        surface=replace(
            item.lidar,
            edge_points=np.zeros((0, 3)),
            edge_ring=np.zeros(0, dtype=np.int16),
            edge_side=np.zeros(0, dtype=np.int8),
            edge_behind_m=np.zeros(0),
            edge_echo=np.zeros(0),
        ),
    )
    residuals = [capture_residual(T_FORWARD, observation, BOARD) for observation in (item, bare)]
    assert np.isnan(residuals[1].edge_mean_m)
    assert summarise(residuals).mee_m == residuals[0].edge_mean_m
