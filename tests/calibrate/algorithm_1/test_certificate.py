"""The certificate: every global minimum has it, other solutions never."""

import numpy as np

from lce_rig.calibrate.algorithm_1.certificate import certify, solve_globally
from lce_rig.calibrate.algorithm_1.registration import (
    cube_rotations,
    eliminate_linear,
    minimise_on_so3,
    rotation_cost,
)
from lce_rig.core.geometry import exp_so3
from tests.calibrate.algorithm_1.test_registration import make_planes, moments_of


def problems(n, sigma_m, n_boards, spread=0.5):
    return np.stack(
        [eliminate_linear(moments_of(*make_planes(k, sigma_m, n_boards, spread)[:3]))[0] for k in range(n)]
    )


def all_minima(Q):
    """Minimise from 24 starts: rotations (n, 24, 3, 3) and costs (n, 24)."""
    R, cost = minimise_on_so3(np.repeat(Q, 24, axis=0), np.tile(cube_rotations(), (len(Q), 1, 1)))
    return R.reshape(len(Q), 24, 3, 3), cost.reshape(len(Q), 24)


def test_certify_global_minima_all_certified():
    for sigma_m, n_boards, spread in ((0.01, 3, 0.5), (0.1, 4, 0.5), (0.03, 20, 0.5), (0.03, 20, 0.05)):
        Q = problems(60, sigma_m, n_boards, spread)
        R, certificates = solve_globally(Q, np.broadcast_to(np.eye(3), (len(Q), 3, 3)))
        assert certificates.is_optimal.all()
        assert (certificates.relative_gap < 1e-5).all()
        _, cost = all_minima(Q)
        np.testing.assert_allclose(rotation_cost(Q, R), cost.min(axis=1), rtol=1e-6, atol=1e-12)


def test_certify_local_minima_none_certified():
    """The gap covers the excess cost of each local minimum."""
    Q = problems(80, 0.05, 3, 0.2)
    R, cost = all_minima(Q)
    best = cost.min(axis=1, keepdims=True)
    which, start = np.nonzero(cost > 1.01 * best + 1e-9)
    assert len(which) > 20
    certificates = certify(Q[which], R[which, start])
    assert not certificates.is_optimal.any()
    missed = cost[which, start] - best[which, 0]
    assert (certificates.gap >= missed * (1 - 1e-9)).all()


def test_no_rotation_off_the_minimum_is_certified():
    Q = problems(40, 0.02, 6)
    R, certificates = solve_globally(Q, np.broadcast_to(np.eye(3), (40, 3, 3)))
    assert certificates.is_optimal.all()
    nudged = R @ exp_so3(np.array([0.0, 0.01, 0.0]))
    off = certify(Q, nudged)
    assert not off.is_optimal.any()
    assert (off.gap >= rotation_cost(Q, nudged) - rotation_cost(Q, R)).all()


def test_certify_single_board_gap_is_small():
    """The bound is tight although one board does not determine the rotation."""
    Q = problems(5, 0.01, 1)
    _, certificates = solve_globally(Q, np.broadcast_to(np.eye(3), (5, 3, 3)))
    assert (certificates.relative_gap < 1e-3).all()
