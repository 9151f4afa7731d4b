"""The session's lens: estimated from profile and images, without the LiDAR, with a joint covariance."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.calibrate.session_lens import fit_session_lens
from lce_rig.core.geometry import difference, invert, perturb, transform
from lce_rig.judge.contributions import summed_covariance
from lce_rig.judge.reach import covariance_alone, point_uncertainties, with_lens
from lce_rig.lens.fit import Setup
from lce_rig.lens.models import LensPrior
from tests.calibrate.boards import BOARD, CAMERA, T_FORWARD, in_use, simulate
from tests.calibrate.test_tolerances import KNOWN, REAL, as_profiled, with_errors
from tests.export.conftest import calibration

ROUGH = LensPrior(CAMERA, focal_length=0.004, principal_point_px=3.6, distortion_px=2.2)
EXACT = LensPrior(CAMERA, 0.0, 0.0, 0.0, is_board_exact=True)
SETTINGS = EstimateSettings("ml", laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005)


def of_profile(prior):
    return replace(SETTINGS, tolerances=replace(KNOWN, lens=prior))


@pytest.fixture(scope="module")
def captures():
    return simulate(20, 1, REAL)


def images(captures):
    return {"frames": [each.image for each in captures]}


@pytest.mark.parametrize(
    "errors",
    [(0.003, 4.0, -5.0, 2.0), (0.02, 10.0, -10.0, 0.0), (0.02, 0.0, 0.0, 0.0), (-0.02, 0.0, 0.0, 0.0)],
)
def test_session_lens_matches_true_lens(captures, errors):
    prior = replace(ROUGH, lens=with_errors(CAMERA, errors))
    lens = fit_session_lens(images(as_profiled(captures, prior.lens)), BOARD, prior)
    model = lens.estimate.model
    off = model.vector(lens.intrinsics) - model.vector(CAMERA)
    assert np.all(np.abs(off[:5]) < 3.5 * lens.estimate.sigma[:5])
    assert lens.estimate.is_contradicted == (abs(errors[0]) > 0.01)


@pytest.mark.long
def test_session_lens_rarely_contradicts(captures):
    contradicted = 0
    for errors in np.random.default_rng(0).normal(size=(12, 4)) * (0.004, 3.6, 3.6, 2.2):
        prior = replace(ROUGH, lens=with_errors(CAMERA, tuple(errors)))
        seen = as_profiled(captures, prior.lens)
        estimate = fit_session_lens(images(seen), BOARD, prior).estimate
        corners_px = np.array([o.image.corners_px for o in seen])
        setup = Setup.of(corners_px, BOARD, estimate.model, prior)
        lens = estimate.model.vector(estimate.intrinsics)
        contradicted += bool(setup.contradicted(lens, estimate.cov, 0.02))
    assert contradicted <= 3


def test_exact_profile_is_unchanged(captures):
    lens = fit_session_lens(images(captures), BOARD, EXACT)
    model = lens.estimate.model
    np.testing.assert_allclose(model.vector(lens.intrinsics), model.vector(CAMERA), rtol=1e-5)
    np.testing.assert_allclose(lens.estimate.corners_board, BOARD.corners(), atol=1e-6)
    for old, new in zip(captures, lens.refit(captures), strict=True):
        moved = difference(new.image.T_cam_board, old.image.T_cam_board)
        assert np.abs(moved).max() < 1e-4
        np.testing.assert_allclose(new.image.cov, old.image.cov, rtol=0.02, atol=1e-12)


def test_session_lens_ignores_lidar(captures):
    turned = perturb(np.eye(4), np.array([0, 0, 0, 0, 0, np.radians(0.2)]))
    moved = [
        replace(
            o,
            surface=replace(
                o.lidar,
                points=transform(turned, o.lidar.points),
                edge_points=transform(turned, o.lidar.edge_points),
                T_lidar_board=turned @ o.lidar.T_lidar_board,
                plane=o.lidar.plane @ invert(turned),
            ),
        )
        for o in captures
    ]
    first, second = (fit_extrinsic(each, BOARD, of_profile(ROUGH)) for each in (captures, moved))
    assert first.lens.intrinsics == second.lens.intrinsics
    shift = difference(second.T_cam_lidar, first.T_cam_lidar @ invert(turned))
    assert np.abs(shift[3:]).max() < np.radians(0.01)


@pytest.mark.long
def test_lens_change_moves_extrinsics(captures):
    estimate = fit_extrinsic(captures, BOARD, of_profile(ROUGH))
    lens = estimate.lens
    (by_lens,) = (each for each in estimate.sensitivities if each.source == "intrinsics")
    k = int(np.argmax(np.linalg.norm(by_lens.moves, axis=1)))
    poses, _, turns = lens.errors([o.image for o in estimate.observations.values()])
    poses = poses[:, :, k]
    moved = [
        replace(o, pose=replace(o.image, T_cam_board=perturb(o.image.T_cam_board, move)))
        for o, move in zip(estimate.observations.values(), poses, strict=True)
    ]
    again = fit_extrinsic(moved, BOARD, SETTINGS)
    still = fit_extrinsic(list(estimate.observations.values()), BOARD, SETTINGS)
    change = difference(again.T_cam_lidar, still.T_cam_lidar)
    matrix = by_lens.moves[k] - np.append(np.zeros(3), turns[:, k])
    np.testing.assert_allclose(change, matrix, atol=0.15 * np.linalg.norm(matrix))


def test_session_lens_joint_centre_is_right(captures):
    """Extrinsics are known better with the lens of the same result than alone, and the true errors agree."""
    prior = replace(ROUGH, lens=with_errors(CAMERA, (0, 5.0, -4.0, 0)))
    estimate = fit_extrinsic(as_profiled(captures, prior.lens), BOARD, of_profile(prior))
    cov = estimate.cov + summed_covariance(estimate.sensitivities)
    cross, fitted, lens = estimate.cov_with_lens, estimate.lens.estimate, estimate.lens.intrinsics
    joint = with_lens(cov, cross, fitted.cov)
    assert np.linalg.eigvalsh(joint / np.sqrt(np.outer(np.diag(joint), np.diag(joint)))).min() > -1e-9
    T_cam_lidar, result = estimate.T_cam_lidar, calibration()
    of_lens = {"intrinsics": lens, "intrinsics_cov": fitted.cov, "intrinsics_cross_cov": cross}
    alone = covariance_alone(replace(result, T_cam_lidar=T_cam_lidar, cov=cov, **of_lens))
    assert np.trace(cov[3:, 3:]) < 0.7 * np.trace(alone[3:, 3:])
    errors = difference(in_use(T_cam_lidar, lens), T_FORWARD), difference(T_cam_lidar, T_FORWARD)
    for error, claim in zip(errors, (cov, alone), strict=True):
        assert error @ np.linalg.solve(claim, error) < 22.5  # 99.9 % of chi squared with 6 freedoms
    (together,) = point_uncertainties(T_cam_lidar, joint, lens, [10.0])
    middle = np.array([[(lens.width_px - 1) / 2, (lens.height_px - 1) / 2]])
    point = 10.0 * lens.unproject(middle)
    pixel, _ = CAMERA.project(transform(T_FORWARD @ invert(estimate.T_cam_lidar), point))
    assert np.linalg.norm(pixel - middle) < 3 * together.centre_px
