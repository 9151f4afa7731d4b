"""Where one camera sits to another from two poses: its derivatives and covariance against samples."""

import numpy as np

from lce_rig.core.geometry import difference, exp_so3, perturb, pose, relative_covariance, relative_pose

RNG = np.random.default_rng(0)
T_SECOND, T_FIRST = (
    pose(exp_so3(RNG.standard_normal((4, 3))), RNG.standard_normal((4, 3))) for _ in range(2)
)


def test_relative_pose_derivatives_match_differences() -> None:
    _, J = relative_pose(T_SECOND, T_FIRST)
    for axis in range(12):
        tangent = 1e-6 * np.eye(12)[axis]
        moved = [
            relative_pose(perturb(T_SECOND, s * tangent[:6]), perturb(T_FIRST, s * tangent[6:]))[0]
            for s in (1, -1)
        ]
        assert np.allclose(J[..., axis], difference(*moved) / 2e-6, atol=1e-7)


def test_relative_pose_covariance_matches_samples() -> None:
    T, J = relative_pose(T_SECOND[0], T_FIRST[0])
    roots = 1e-3 * RNG.standard_normal((2, 6, 6))
    covs = roots @ np.swapaxes(roots, 1, 2)
    second, first = (RNG.standard_normal((20_000, 6)) @ root.T for root in roots)
    sampled = difference(relative_pose(perturb(T_SECOND[0], second), perturb(T_FIRST[0], first))[0], T)
    expected = relative_covariance(J, *covs)
    scale = np.outer(*2 * [np.sqrt(np.diag(expected))])
    # 20000 samples: correlations to 0.007.
    assert np.allclose(np.cov(sampled.T) / scale, expected / scale, atol=0.04)
