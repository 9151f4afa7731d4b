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
)
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
    """Sum the squares of n . (g - R p - t) as moments of [vec R; t; 1]."""
    lever = -(points[..., :, None] * normals[..., None, :]).reshape(*points.shape[:-1], 9)
    offset = np.sum(normals * anchors, axis=-1, keepdims=True)
    rows = np.concatenate([lever, -normals, offset], axis=-1).reshape(-1, 13)
    return rows.T @ rows / len(rows)


def test_unobserved_direction_stays_zero():
    normals = np.tile([0.0, 0.0, 1.0], (20, 1))
    points = np.random.default_rng(0).normal(size=(20, 3))
    Q, L = eliminate_linear(moments_of(normals, np.zeros((20, 3)), points))
    assert np.isfinite(Q).all()
    np.testing.assert_allclose(linear_unknowns(L, np.eye(3))[:2], 0, atol=1e-12)


@given(st.integers(0, 10_000))
def test_register_any_start_finds_the_pose(seed):
    normals, anchors, points, R_true, t_true = make_planes(seed)
    Q, L = eliminate_linear(moments_of(normals, anchors, points))
    R_start = exp_so3(np.random.default_rng(seed + 1).normal(size=3) * 2)
    R, certificates = solve_globally(Q[None], R_start[None])
    assert certificates.is_optimal.all()
    assert rotation_angle(R[0], R_true) < 1e-5
    np.testing.assert_allclose(linear_unknowns(L, R[0]), t_true, atol=1e-5)


def test_found_minima_are_stationary():
    Q = np.stack([eliminate_linear(moments_of(*make_planes(k, 0.05, 4)[:3]))[0] for k in range(10)])
    starts = cube_rotations()
    R, cost = minimise_on_so3(np.repeat(Q, 24, axis=0), np.tile(starts, (10, 1, 1)))
    nudges = exp_so3(1e-4 * np.concatenate([np.eye(3), -np.eye(3)]))
    for nudge in nudges:
        assert (rotation_cost(np.repeat(Q, 24, axis=0), R @ nudge) >= cost * (1 - 1e-12)).all()
