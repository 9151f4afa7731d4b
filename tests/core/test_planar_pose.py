"""Poses of a planar board from one image, compared with truth, Monte Carlo and symmetry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import difference, exp_so3, pose, rotation_angle, transform
from lce_rig.core.planar_pose import refine_pose, solve_planar_pose

BOARD = Board(cols=9, rows=6, square_m=0.068, width_m=0.8, height_m=0.6)
RADTAN = Intrinsics(
    349.57, 349.18, 172.49, 126.24, 346, 260, "radtan", (-0.36503, 0.18361, 0.00070794, 0.00010983, 0.0)
)
FISHEYE = Intrinsics(
    1176.93, 1177.72, 962.275, 612.725, 1920, 1208, "equidistant", (-0.054, -0.0784, 0.096, -0.0515)
)
CAMERAS = pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=["radtan", "fisheye"])
FACING = np.diag([1.0, -1.0, -1.0])


def looking(tilt_deg, about_deg, roll_deg, centre):
    """Place the board at `centre` in the camera, its print tilted against the camera's axis."""
    about, roll = np.radians([about_deg, roll_deg])
    tilt = exp_so3(np.radians(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))
    return pose(tilt @ FACING @ exp_so3(np.array([0.0, 0.0, roll])), np.array(centre))


def seen(T, camera, sigma_px=0.0, seed=0):
    pixels, is_valid = camera.project(transform(T, BOARD.corners()))
    assert is_valid.all()
    return pixels + sigma_px * np.random.default_rng(seed).standard_normal(pixels.shape)


def solve(corners, camera):
    solved = solve_planar_pose(corners, BOARD.corners(), camera)
    assert solved is not None
    return solved


@CAMERAS
@given(
    tilt_deg=st.floats(0, 65),
    about_deg=st.floats(-180, 180),
    roll_deg=st.floats(-180, 180),
    x=st.floats(-0.3, 0.3),
    y=st.floats(-0.25, 0.25),
    z=st.floats(1.2, 5.0),
)
def test_exact_corners_give_the_exact_pose(camera, tilt_deg, about_deg, roll_deg, x, y, z):
    T = looking(tilt_deg, about_deg, roll_deg, (x, y, z))
    solved = solve(seen(T, camera), camera)
    assert solved.reprojection_px < 1e-4
    assert np.abs(difference(solved.T_cam_board, T)).max() < 1e-4


@pytest.mark.long
@pytest.mark.parametrize(
    ("camera", "tilt_deg", "z_m"),
    [(RADTAN, 40.0, 1.5), (RADTAN, 25.0, 2.5), (FISHEYE, 25.0, 2.5)],
    ids=["near", "far", "fisheye"],
)
def test_planar_pose_covariance_matches_monte_carlo(camera, tilt_deg, z_m):
    T, sigma_px, n = looking(tilt_deg, 30, 40, (0.2, -0.1, z_m)), 0.15, 300
    runs = [solve(seen(T, camera, sigma_px, seed), camera) for seed in range(n)]
    errors = np.array([difference(run.T_cam_board, T) for run in runs])
    predicted = np.sqrt(np.mean([np.diag(run.cov) for run in runs], axis=0))
    ratio = predicted / np.sqrt(np.mean(errors**2, axis=0))
    # A standard deviation of 300 samples is itself known to 4 %.
    assert np.all((ratio > 0.9) & (ratio < 1.1)), ratio
    chi2 = np.array([e @ np.linalg.solve(run.cov, e) for e, run in zip(errors, runs, strict=True)])
    assert 0.91 < np.mean(chi2 < 12.59) < 0.985  # 95 % of chi2 with 6 degrees of freedom
    assert np.median([run.sigma_px for run in runs]) == pytest.approx(sigma_px, rel=0.05)


@CAMERAS
def test_planar_pose_both_minima_are_found(camera):
    T = looking(20, 75, 10, (0.1, 0.05, 4.0 if camera is RADTAN else 9.0))
    solved = solve(seen(T, camera, 0.2, 1), camera)
    other = solved.T_cam_board_alternative
    assert other is not None
    corners, points = seen(T, camera, 0.2, 1), BOARD.corners()
    again, cost_other = refine_pose(other, corners, points, camera)
    assert np.abs(difference(again, other)).max() < 1e-5
    _, cost = refine_pose(solved.T_cam_board, corners, points, camera)
    assert cost <= cost_other
    assert solved.chi2_gap == pytest.approx((cost_other - cost) / solved.sigma_px**2, rel=1e-6)
    assert rotation_angle(other[:3, :3], solved.T_cam_board[:3, :3]) > np.radians(20)


@pytest.mark.parametrize("n_starts", [1, 2])
@pytest.mark.parametrize("swapped", [False, True])
def test_planar_pose_warm_start_finds_same_minima(n_starts, swapped):
    before = solve(seen(looking(15, 40, 30, (0.1, 0.0, 4.5)), RADTAN, 0.1, 1), RADTAN)
    corners = seen(looking(17, 44, 31, (0.12, 0.01, 4.55)), RADTAN, 0.1, 2)
    alone = solve(corners, RADTAN)
    assert before.T_cam_board_alternative is not None and alone.T_cam_board_alternative is not None
    starts = [before.T_cam_board, before.T_cam_board_alternative]
    starts = (starts[::-1] if swapped else starts)[:n_starts]
    led = solve_planar_pose(corners, BOARD.corners(), RADTAN, starts)
    assert led is not None and led.T_cam_board_alternative is not None
    assert np.abs(led.T_cam_board - alone.T_cam_board).max() < 1e-6
    assert np.abs(led.T_cam_board_alternative - alone.T_cam_board_alternative).max() < 1e-5
    assert led.chi2_gap == pytest.approx(alone.chi2_gap, rel=1e-4)


def test_corners_outside_the_lens_model_give_no_pose():
    corners = seen(looking(20, 0, 0, (0, 0, 2)), RADTAN) + [4000.0, 0.0]
    assert solve_planar_pose(corners, BOARD.corners(), RADTAN) is None
