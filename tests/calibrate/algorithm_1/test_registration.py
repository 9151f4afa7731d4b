"""Registration on sufficient statistics: the cost is the sum of squares, and its minimum is found."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.calibrate.algorithm_1.certificate import solve_globally
from lce_rig.calibrate.algorithm_1.registration import (
    cube_rotations,
    eliminate_linear,
    linear_unknowns,
    minimise_on_so3,
    rotation_cost,
    vec_rotation,
    with_one,
)
from lce_rig.calibrate.plane_and_ends import residual_rows
from lce_rig.core.geometry import exp_so3, project_to_so3, rotation_angle


def make_planes(seed, sigma_m=0.0, n_boards=8, spread=0.5):
    """Points on random planes seen from two frames, with the true R and t."""
    rng = np.random.default_rng(seed)
    R, t = project_to_so3(rng.normal(size=(3, 3))), rng.normal(size=3)
    normals = spread * rng.normal(size=(n_boards, 1, 3)) + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    anchors = 0.5 * rng.normal(size=(n_boards, 1, 3)) + [0, 0, 3]
    spots = rng.normal(size=(n_boards, 40, 3)) * 0.3
    spots -= np.sum(spots * normals, axis=-1, keepdims=True) * normals
    points = (spots + anchors - t) @ R + sigma_m * rng.normal(size=spots.shape)
    return np.broadcast_to(normals, points.shape), np.broadcast_to(anchors, points.shape), points, R, t


def moments_of(normals, anchors, points):
    rows = residual_rows(normals, anchors, points).reshape(-1, 13)
    return rows.T @ rows / len(rows)


def test_moments_of_residual_rows_give_the_sum_of_squared_residuals():
    normals, anchors, points, R, t = make_planes(0, sigma_m=0.02)
    rng = np.random.default_rng(1)
    shifts, s = rng.normal(size=(*points.shape[:-1], 2)), np.array([0.1, -0.2])
    rows = residual_rows(normals, anchors, points, shifts).reshape(-1, 15)
    weights = rng.uniform(0.5, 2, len(rows))
    x = with_one(np.concatenate([vec_rotation(R), t, s]))
    direct = np.sum(normals * (anchors - points @ R.T - t), axis=-1) + shifts @ s
    np.testing.assert_allclose(
        x @ (rows.T * weights @ rows) @ x, np.sum(weights * direct.ravel() ** 2), rtol=1e-9
    )


def test_elimination_leaves_the_least_cost_over_the_linear_unknowns():
    normals, anchors, points, R, _ = make_planes(2, sigma_m=0.02)
    M = moments_of(normals, anchors, points)
    Q, L = eliminate_linear(M)
    best = linear_unknowns(L, R)
    x = with_one(np.concatenate([vec_rotation(R), best]))
    np.testing.assert_allclose(rotation_cost(Q, R), x @ M @ x, rtol=1e-8)
    for step in 1e-3 * np.eye(3):
        other = with_one(np.concatenate([vec_rotation(R), best + step]))
        assert other @ M @ other > x @ M @ x


def test_a_direction_that_no_plane_sees_is_left_at_zero():
    normals = np.tile([0.0, 0.0, 1.0], (20, 1))
    points = np.random.default_rng(0).normal(size=(20, 3))
    Q, L = eliminate_linear(moments_of(normals, np.zeros((20, 3)), points))
    assert np.isfinite(Q).all()
    np.testing.assert_allclose(linear_unknowns(L, np.eye(3))[:2], 0, atol=1e-12)


@given(st.integers(0, 10_000))
def test_the_pose_of_exact_planes_is_found_whatever_the_start(seed):
    normals, anchors, points, R_true, t_true = make_planes(seed)
    Q, L = eliminate_linear(moments_of(normals, anchors, points))
    R_start = exp_so3(np.random.default_rng(seed + 1).normal(size=3) * 2)
    R, certificates = solve_globally(Q[None], R_start[None])
    assert certificates.is_optimal.all()
    assert rotation_angle(R[0], R_true) < 1e-5
    np.testing.assert_allclose(linear_unknowns(L, R[0]), t_true, atol=1e-5)


def test_every_minimum_found_is_a_minimum():
    Q = np.stack([eliminate_linear(moments_of(*make_planes(k, 0.05, 4)[:3]))[0] for k in range(10)])
    starts = cube_rotations()
    R, cost = minimise_on_so3(np.repeat(Q, 24, axis=0), np.tile(starts, (10, 1, 1)))
    nudges = exp_so3(1e-4 * np.concatenate([np.eye(3), -np.eye(3)]))
    for nudge in nudges:
        assert (rotation_cost(np.repeat(Q, 24, axis=0), R @ nudge) >= cost * (1 - 1e-12)).all()


def test_the_cube_has_24_rotations():
    R = cube_rotations()
    assert R.shape == (24, 3, 3)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    angles = rotation_angle(R[:, None], R[None]) + 10 * np.eye(24)
    assert angles.min() > 1.5
