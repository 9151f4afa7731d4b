"""Errors of the profile's lens and board: their effect on a solution and its covariance."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.calibrate.options import Tolerances
from lce_rig.core.geometry import difference
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.detect.image.search import board_from_pose
from lce_rig.judge.contributions import summed_covariance
from lce_rig.lens.models import LensPrior
from tests.calibrate.boards import BOARD, CAMERA, T_FORWARD, Scenario, in_use, simulate

KNOWN = Tolerances(
    lens=LensPrior(CAMERA, focal_length=0.0015, principal_point_px=0.9, distortion_px=0.45),
    square_size=0.001,
    pattern_offset_m=0.003,
    plate_m=0.002,
    bow_m=0.0,
)
PRIOR = KNOWN.lens
REAL = Scenario(laser_bias_sigma_m=0.008, footprint_m=0.008, end_sigma_m=0.001)
METHODS = ("paper", "ml")
SETTINGS = EstimateSettings(laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005, tolerances=KNOWN)


def as_profiled(captures, lens=CAMERA, board=BOARD):
    """Compute the poses of boards in images with the lens and board of a profile."""
    found = []
    for item in captures:
        solved = solve_planar_pose(item.image.corners_px, board.corners(), lens)
        found.append(replace(item, pose=board_from_pose(item.image.corners_px, solved)))
    return found


def with_errors(lens, errors):
    """Change a lens by relative focal length, principal point and displacement of the image's corner, px."""
    focal, cx_px, cy_px, corner_px = errors
    radius = np.hypot(lens.width_px, lens.height_px) / 2 / lens.fx_px
    k1, *others = lens.distortion
    return replace(
        lens,
        fx_px=lens.fx_px * (1 + focal),
        fy_px=lens.fy_px * (1 + focal),
        cx_px=lens.cx_px + cx_px,
        cy_px=lens.cy_px + cy_px,
        distortion=(k1 + corner_px / (lens.fx_px * radius**3), *others),
    )


SIGMAS = {
    "square_size": KNOWN.square_size,
    "pattern_offset": KNOWN.pattern_offset_m,
    "plate_size": KNOWN.plate_m,
}


def moves_of(estimate, source):
    """Moves (n, 6) of a result by an error of the profile, per unit."""
    found = next(each for each in estimate.sensitivities if each.source == source)
    return found.sigma * found.moves / SIGMAS[source]


@cache
def estimate_with_exact_lens():
    exact = replace(KNOWN, lens=LensPrior(CAMERA, 0.0, 0.0, 0.0, is_board_exact=True))
    return fit_extrinsic(simulate(20, 1, REAL), BOARD, replace(SETTINGS, tolerances=exact))


@pytest.mark.parametrize(
    ("source", "board", "errors"),
    [
        ("square_size", replace(BOARD, square_m=0.995 * BOARD.square_m), [-0.005]),
        ("pattern_offset", replace(BOARD, pattern_offset_m=(-0.005, 0.0)), [-0.005, 0.0]),
        ("plate_size", replace(BOARD, width_m=BOARD.width_m + 0.005), [0.005, 0.0]),
    ],
)
def test_wrong_board_matches_sensitivities(source, board, errors):
    sound = estimate_with_exact_lens()
    plain = replace(SETTINGS, tolerances=None)
    wrong = fit_extrinsic(as_profiled(simulate(20, 1, REAL), board=board), board, plain)
    expected = np.array(errors) @ moves_of(sound, source)
    # Board at 2 m: metres and radians are comparable. Noise levels and associations change a little too.
    motion = difference(wrong.T_cam_lidar, sound.T_cam_lidar)
    np.testing.assert_allclose(motion, expected, atol=0.1 * np.linalg.norm(expected) + 4e-4)


def draw_session(seed, n_captures):
    """Simulate a session whose lens, board and ranges differ from the profile as its deviations say."""
    rng = np.random.default_rng([seed, 7])
    lens_errors = rng.standard_normal(4) * [
        PRIOR.focal_length,
        PRIOR.principal_point_px,
        PRIOR.principal_point_px,
        PRIOR.distortion_px,
    ]
    width_m, height_m = (BOARD.width_m, BOARD.height_m) + KNOWN.plate_m * rng.standard_normal(2)
    true_board = replace(
        BOARD,
        square_m=BOARD.square_m * (1 + KNOWN.square_size * rng.standard_normal()),
        width_m=float(width_m),
        height_m=float(height_m),
        pattern_offset_m=tuple((KNOWN.pattern_offset_m * rng.standard_normal(2)).tolist()),
    )
    scenario = replace(REAL, range_offset_m=float(0.005 * rng.standard_normal()))
    captures = simulate(n_captures, seed, scenario, board=true_board)
    # The profile is off by as much from the true lens as the true lens from the profile's.
    profile_lens = with_errors(CAMERA, -lens_errors)
    return as_profiled(captures, profile_lens), replace(KNOWN, lens=replace(PRIOR, lens=profile_lens))


def normalised_errors(method, seeds, n_captures=20):
    found = []
    for seed in seeds:
        captures, known = draw_session(seed, n_captures)
        estimate = fit_extrinsic(captures, BOARD, replace(SETTINGS, method=method, tolerances=known))
        error = difference(in_use(estimate.T_cam_lidar, estimate.lens.intrinsics), T_FORWARD)
        with_profile = estimate.cov + summed_covariance(estimate.sensitivities)
        found.append([error @ np.linalg.solve(cov, error) for cov in (estimate.cov, with_profile)])
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_tolerances_95_regions_cover_truth(method):
    """Without the tolerances of lens and board, fewer than 90 % do."""
    from scipy.stats import chi2

    without, whole = normalised_errors(method, range(100)).T
    limit = chi2.ppf(0.95, 6)
    shares = [100 * np.mean(nees < limit) for nees in (whole, without)]
    print(f"\n{method}: NEES {whole.mean():.1f}, 95 % regions hold {shares[0]:.0f} %; without lens and board")
    print(f"NEES {without.mean():.1f}, {shares[1]:.0f} %")
    assert 0.90 <= np.mean(whole < limit) <= 1.0
    assert np.mean(without < limit) < 0.9
