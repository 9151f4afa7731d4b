"""The joint estimate compared with simulated truth: errors, constants, several cameras, outliers."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, error_to_reference, fit_extrinsic
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.likelihood.fit import maximise_likelihood
from lce_rig.calibrate.likelihood.layout import SHIFTS
from lce_rig.calibrate.likelihood.levels import Levels, Priors
from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.plane_and_ends import turn_about_z
from lce_rig.calibrate.quadratics import jackknife_scatter
from lce_rig.calibrate.uncertainty import widen
from lce_rig.core.geometry import difference, exp_so3, fit_plane, invert, perturb, pose, transform
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, photograph, simulate

ML = EstimateSettings(method="ml", laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005)
REAL = Scenario(laser_bias_sigma_m=0.008, footprint_m=0.008, end_sigma_m=0.001)


def observations(n, seed, scenario, T_cam_lidar=T_FORWARD):
    found = find_consensus(simulate(n, seed, scenario, T_cam_lidar), BOARD)
    return found.observations


@pytest.fixture(scope="module")
def sessions():
    """Five sessions of 20 captures: lasers off by 8 mm, a beam that reaches 8 mm over edges."""
    return [fit_extrinsic(simulate(20, seed, REAL), BOARD, ML) for seed in range(5)]


def test_refine_laser_errors_fit_covariance(sessions):
    errors = np.array([difference(estimate.T_cam_lidar, T_FORWARD) for estimate in sessions])
    squares = np.mean(errors**2, axis=0)
    assert np.degrees(np.sqrt(squares[3:].sum())) < 0.03
    assert 1e3 * np.sqrt(squares[:3].sum()) < 1.2
    nees = [e @ np.linalg.solve(s.cov, e) for e, s in zip(errors, sessions, strict=True)]
    # 6 expected; 5 samples of chi square with 6 degrees average within 3 standard errors of 1.55.
    assert 1.3 < np.mean(nees) < 10.7


def test_refine_recovers_simulated_noise_and_errors(sessions):
    for estimate in sessions:
        figures = estimate.diagnostics
        assert abs(figures.edge_shift_m - 0.008) < 4 * figures.edge_shift_sigma_m + 3e-4
        assert abs(figures.noise_range_m - 0.010) < 3e-4
        assert figures.noise_tilt_deg < 0.1
        assert 0.004 < figures.laser_spread_m < 0.014
        # Mean size of the ranges' noise alone, less by the obliqueness of the boards.
        assert 0.7 < figures.mpe_corrected_m / (0.010 * np.sqrt(2 / np.pi)) < 1
        assert figures.mpe_corrected_m < 0.95 * estimate.metrics.mpe_m
        assert abs(figures.camera_scale - 1) < 0.001
        assert estimate.certificate.is_optimal
        assert estimate.method == "ml"


def test_refine_covariance_parts_add_up(sessions):
    for estimate in sessions:
        figures = estimate.diagnostics
        parts = [getattr(figures, f"sigma_{name}_translation_m") ** 2 for name in ("scatter", "systematic")]
        claimed = np.trace(estimate.cov[:3, :3]) / figures.covariance_inflation
        assert sum(parts) == pytest.approx(claimed, rel=1e-6)
        assert min(parts) > 0.01 * claimed


def test_refine_large_range_offset_is_found():
    """The offset is four times the standard deviation in the profile."""
    scenario = replace(REAL, range_offset_m=0.02, footprint_m=0.003)
    estimate = fit_extrinsic(simulate(30, 3, scenario), BOARD, ML)
    angle_deg, distance_m = error_to_reference(estimate.T_cam_lidar, T_FORWARD)
    assert angle_deg < 0.05
    assert distance_m < 0.002
    assert abs(estimate.diagnostics.range_offset_m - 0.02) < 0.003


def raised(capture, metres_per_rad):
    """Displace a LiDAR's points like a driver that ignores the lasers' heights."""
    lidar = capture.lidar

    def move(points):
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        return points - metres_per_rad * elevation[:, None] * [0, 0, 1]

    return replace(
        capture, surface=replace(lidar, points=move(lidar.points), edge_points=move(lidar.edge_points))
    )


def test_refine_lost_laser_height_is_found():
    captures = [raised(capture, -0.043) for capture in simulate(30, 2, REAL)]
    estimate = fit_extrinsic(captures, BOARD, ML)
    assert abs(estimate.diagnostics.lens_vertical_m_per_rad + 0.043) < 0.006
    error = difference(estimate.T_cam_lidar, T_FORWARD)
    assert error @ np.linalg.solve(estimate.cov, error) < 25  # 0.9997 of chi square with 6 degrees
    assert np.degrees(np.linalg.norm(error[3:])) < 0.08


def test_refine_image_tilt_noise_is_found():
    rng = np.random.default_rng(0)
    tilted = [
        replace(o, pose=replace(o.image, T_cam_board=o.image.T_cam_board @ pose(exp_so3(phi), np.zeros(3))))
        for o, phi in zip(
            observations(30, 1, REAL), np.radians([0.4, 0.4, 0]) * rng.standard_normal((30, 3)), strict=True
        )
    ]
    joint = maximise_likelihood([tilted], BOARD, [T_FORWARD], usual=Levels(laser_m=0.008))
    assert 0.3 < np.degrees(joint.levels.tilt_rad) < 0.55
    error = difference(joint.T_cam_lidar[0], T_FORWARD)
    assert error @ np.linalg.solve(joint.cov[0], error) < 25


def bent(item, height_m):
    """Bend a capture's plate along its width: points move along their rays, and the plane is fitted again."""
    lidar = item.lidar

    def raised(points):
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        across = transform(invert(lidar.T_lidar_board), points)[:, 0] / (BOARD.width_m / 2)
        return points + (height_m * (1 - across**2) / (rays @ lidar.plane[:3]))[:, None] * rays

    points = raised(lidar.points)
    moved = replace(lidar, points=points, edge_points=raised(lidar.edge_points), plane=fit_plane(points)[0])
    return replace(item, surface=moved)


def test_refine_bent_plate_bow_is_estimated():
    """Returns and ring ends of a plate whose middle lies 1 mm over its left and right edges."""
    flat = observations(20, 0, REAL)
    curved = [bent(each, 0.001) for each in flat]
    joints = [maximise_likelihood([each], BOARD, [T_FORWARD]) for each in (flat, curved)]
    bow = joints[0].state.layout.z["bow"]
    found = joints[1].state.z[bow] - joints[0].state.z[bow]
    assert found == pytest.approx([0.001, 0.0], abs=4e-4)
    moved = difference(joints[1].T_cam_lidar[0], joints[0].T_cam_lidar[0])
    # The middle of the plate's height lies two thirds of that higher.
    assert np.linalg.norm(moved[:3]) < 1e-3


def test_refine_differing_edge_shift_is_detected():
    """The beam reaches 6 mm over the edges of every second capture, 10 mm over those of the others."""
    near, far = (observations(20, 0, replace(REAL, footprint_m=reach_m)) for reach_m in (0.006, 0.010))
    mixed = [*near[::2], *far[1::2]]
    joint = maximise_likelihood([mixed], BOARD, [T_FORWARD])
    own_m = dict(zip(sorted(o.capture for o in mixed), joint.state.own_shift_m, strict=True))
    apart_m = np.mean([own_m[o.capture] for o in far[1::2]]) - np.mean([own_m[o.capture] for o in near[::2]])
    assert apart_m == pytest.approx(0.004, abs=5e-4)
    assert 0.001 < joint.levels.own_shift_m < 0.003
    alike = maximise_likelihood([near], BOARD, [T_FORWARD])
    assert alike.levels.own_shift_m < 0.0005


def test_refine_second_camera_gains_accuracy():
    """A second camera 30 cm aside, with ten times the first one's corner noise, gains from the first one."""
    T_second = pose(exp_so3(np.array([0, 0.2, 0])), np.array([0.3, 0.0, 0.05])) @ T_FORWARD
    rng = np.random.default_rng(5)
    first = observations(20, 7, REAL)
    noisy = replace(REAL, corner_sigma_px=1.0)
    second = []
    for o in first:
        image = photograph(T_second @ invert(T_FORWARD) @ o.image.T_cam_board, rng, noisy, BOARD)
        if image is not None:
            second.append(replace(o, pose=image))
    assert len(second) > 8
    priors, usual = Priors(), Levels(laser_m=0.008)
    start = perturb(T_second, np.array([0.01, -0.01, 0.01, 0.005, 0.005, -0.005]))
    both = maximise_likelihood([first, second], BOARD, [T_FORWARD, start], priors, usual)
    alone = maximise_likelihood([second], BOARD, [start], priors, usual)
    for T, truth, cov in zip(both.T_cam_lidar, (T_FORWARD, T_second), both.cov, strict=True):
        error = difference(T, truth)
        assert error @ np.linalg.solve(cov, error) < 25
    assert np.trace(both.cov[1, 3:, 3:]) < np.trace(alone.cov[0, 3:, 3:])


@pytest.mark.parametrize(
    "scenario",
    [
        Scenario(tilt_deg=(60.0, 75.0), distance_m=(1.2, 2.0)),
        Scenario(distance_m=(3.5, 4.5), range_sigma_m=0.03),
        Scenario(lost_share=0.3),
    ],
    ids=["grazing", "few rings", "ring ends lost"],
)
def test_hard_captures_errors_fit_covariance(scenario):
    estimate = fit_extrinsic(simulate(20, 4, scenario), BOARD, ML)
    error = difference(estimate.T_cam_lidar, T_FORWARD)
    assert error @ np.linalg.solve(estimate.cov, error) < 30
    assert np.degrees(np.linalg.norm(error[3:])) < 0.15


def test_widen_small_covariance_is_scaled():
    seen = observations(20, 6, REAL)
    good = maximise_likelihood([seen], BOARD, [T_FORWARD])
    placement = group_placements(seen)
    assert np.array_equal(good.placement, placement)
    spread = jackknife_scatter(good.cost.moves() @ good.to_extrinsics[0].T)
    assert widen(good.cov[0], spread, placement.max() + 1)[1] < 2
    too_sure = good.cov[0] / 20
    cov, factor = widen(too_sure, spread, placement.max() + 1)
    assert factor > 5
    assert np.allclose(cov, factor * too_sure)


def test_refine_near_background_has_a_shift():
    """In two of three captures a person stands behind the board's left half: it ends 6 mm sooner there."""
    plain = observations(20, 8, REAL)
    held = [hold_from_behind(o, 0.006) if k % 3 else o for k, o in enumerate(plain)]
    joint = maximise_likelihood([held], BOARD, [T_FORWARD], Priors(), Levels(laser_m=0.008))
    assert abs(joint.state.shifts[SHIFTS.index("d_2")] + 0.006) < 0.0015
    error = difference(joint.T_cam_lidar[0], T_FORWARD)
    assert error @ np.linalg.solve(joint.cov[0], error) < 25
    assert np.linalg.norm(error[:3]) < 0.003


def test_refine_bright_wall_is_modelled():
    """Two of three boards have a bright wall behind their left half, whose echo wins sooner, by 8 mm."""
    plain = observations(20, 9, REAL)
    lit = [lighten(o, share=0.5, sooner_m=0.008) if k % 3 else o for k, o in enumerate(plain)]
    joint = maximise_likelihood([lit], BOARD, [T_FORWARD], Priors(), Levels(laser_m=0.008))
    assert abs(joint.state.shifts[SHIFTS.index("d_1")] + 0.016) < 0.003
    error = difference(joint.T_cam_lidar[0], T_FORWARD)
    assert error @ np.linalg.solve(joint.cov[0], error) < 25
    blind = [replace(o, surface=replace(o.lidar, edge_echo=np.zeros(len(o.lidar.edge_side)))) for o in lit]
    unaware = maximise_likelihood([blind], BOARD, [T_FORWARD], Priors(), Levels(laser_m=0.008))
    # Shifts of single captures replace it, with less information.
    assert unaware.levels.own_shift_m > 2 * joint.levels.own_shift_m
    assert np.trace(unaware.cov[0]) > 1.1 * np.trace(joint.cov[0])


def lighten(observation, share, sooner_m):
    """Turn the ring ends of growing azimuth inwards, and tell how bright it is behind them."""
    held = hold_from_behind(observation, sooner_m).lidar
    echo = np.where(held.edge_side > 0, share, 0.0)
    behind = np.where(held.edge_side > 0, 2.0, np.inf)
    return replace(observation, surface=replace(held, edge_behind_m=behind, edge_echo=echo))


def hold_from_behind(observation, sooner_m):
    """Turn the ring ends of growing azimuth inwards, and tell that something stands behind them.

    Edges are held at about 45 deg to the rings.
    """
    lidar = observation.lidar
    is_left = lidar.edge_side > 0
    turn = is_left * np.sqrt(2) * sooner_m / np.linalg.norm(lidar.edge_points, axis=1)
    ends = turn_about_z(lidar.edge_points, -turn)
    behind = np.where(is_left, 0.2, np.inf)
    return replace(observation, surface=replace(lidar, edge_points=ends, edge_behind_m=behind))
