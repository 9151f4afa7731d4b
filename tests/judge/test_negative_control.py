"""The control of results with sensor constants, on linear problems whose optimum is known."""

import numpy as np
import pytest

from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.geometry import Array
from lce_rig.judge.negative_control import control_findings, run_control_with_constants
from lce_rig.rig import load_rig

N_CAPTURES, N_ROWS, SIGMA_M = 20, 40, 0.005
TARGET = load_rig("rlfs").calibration


def problem(seed: int, at: Array, constants: Array) -> Quadratics:
    """Residuals linear in extrinsics (6) and two constants (m), expanded about `at` and 0."""
    rng = np.random.default_rng(seed)
    gradients, hessians = [], []
    for _ in range(N_CAPTURES):
        J = rng.normal(size=(N_ROWS, 8)) * [1, 1, 1, 3, 3, 3, 1, 1]
        r = J @ np.r_[at, -constants] + rng.normal(scale=SIGMA_M, size=N_ROWS)
        gradients.append(J.T @ r / SIGMA_M**2)
        hessians.append(J.T @ J / SIGMA_M**2)
    prior = np.zeros((8, 8))
    prior[6:, 6:] = np.eye(2) / 0.02**2
    return Quadratics(np.array(gradients), np.array(hessians), prior, np.zeros(8), np.arange(N_CAPTURES))


def verdict(quadratics: Quadratics) -> list[str]:
    cov = quadratics.covariance()[:6, :6]
    found = control_findings(run_control_with_constants(quadratics, cov, 3.0, TARGET, 3.0))
    return [finding.severity for finding in found]


@pytest.mark.parametrize("seed", range(5))
def test_a_result_near_the_truth_passes_whatever_the_constants(seed: int) -> None:
    assert verdict(problem(seed, np.zeros(6), np.array([0.03, -0.02]))) == []


@pytest.mark.parametrize("axis", range(6))
def test_a_result_far_off_fails_along_every_axis(axis: int) -> None:
    # Moves are twice three deviations or the target, whichever is larger; half of that is tolerated.
    off = np.zeros(6)
    off[axis] = 2 * (TARGET.target_sigma_m if axis < 3 else np.radians(TARGET.target_sigma_deg))
    assert verdict(problem(0, off, np.zeros(2))) == ["error"]
