"""Parts of the reported covariance: errors of the profile, and contradictions."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import fit_extrinsic
from lce_rig.core.geometry import difference, sigma_sizes
from lce_rig.judge.contributions import OF_BOARD, summed_covariance
from lce_rig.judge.validate import validate
from lce_rig.rig import load_rig
from tests.calibrate.boards import BOARD, CAMERA, T_FORWARD, in_use, simulate
from tests.calibrate.test_tolerances import KNOWN, PRIOR, REAL, SETTINGS, as_profiled, with_errors

RIG = load_rig("rlfs")


def validated(lens=CAMERA, board=BOARD, seed=1):
    """Calibrate 20 captures with a profile's lens and board, and check the result."""
    captures = as_profiled(simulate(20, seed, REAL), lens, board)
    settings = replace(SETTINGS, method="paper", tolerances=replace(KNOWN, lens=replace(PRIOR, lens=lens)))
    estimate = fit_extrinsic(captures, board, settings)
    of_board = RIG.board.model_copy(update={"square_m": board.square_m})
    rig = RIG.model_copy(update={"board": of_board})
    return estimate, validate(estimate, rig, "cam", "lidar", lens)


@pytest.fixture(scope="module")
def sound():
    return validated()


def sources(examination):
    return {each.source for each in examination.contributions}


def test_sound_covariance_is_the_sum(sound):
    estimate, examination = sound
    assert not any(source.startswith("contradiction") for source in sources(examination))
    of_profile = summed_covariance(estimate.sensitivities)
    np.testing.assert_allclose(examination.cov, estimate.cov + of_profile)
    of_board = [each for each in estimate.sensitivities if each.source in OF_BOARD]
    np.testing.assert_array_equal(examination.cov_shared, summed_covariance(of_board))


def test_the_squares_of_the_contributions_add_up(sound):
    _, examination = sound
    total = np.sum(
        [[c.sigma_rotation_deg**2, c.sigma_translation_m**2] for c in examination.contributions], 0
    )
    assert np.sqrt(total) == pytest.approx(sigma_sizes(examination.cov), rel=1e-6)


@pytest.mark.parametrize(
    ("lens", "board", "expected"),
    [
        (with_errors(CAMERA, (0.02, 0, 0, 0)), BOARD, "intrinsics"),
        (with_errors(CAMERA, (0, 20, 0, 0)), BOARD, "intrinsics"),
        (CAMERA, replace(BOARD, square_m=1.02 * BOARD.square_m), "contradiction_scale"),
    ],
)
def test_wrong_profile_error_is_within_covariance(lens, board, expected):
    estimate, examination = validated(lens, board)
    assert expected in sources(examination)
    error = difference(in_use(estimate.T_cam_lidar, estimate.lens.intrinsics), T_FORWARD)
    sigma_deg, sigma_m = sigma_sizes(examination.cov)
    assert np.degrees(np.linalg.norm(error[3:])) < 2.5 * sigma_deg
    assert np.linalg.norm(error[:3]) < 2.5 * sigma_m
