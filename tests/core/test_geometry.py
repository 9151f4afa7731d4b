"""Laws of rotations, poses and tangents."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lce_rig.core.geometry import (
    difference,
    exp_so3,
    fit_plane,
    invert,
    log_so3,
    perturb,
    pose,
    rotation_angle,
    skew,
    transform,
)

vectors = arrays(np.float64, 3, elements=st.floats(-1.7, 1.7))


@given(vectors)
def test_log_undoes_exp_below_pi(phi):
    np.testing.assert_allclose(log_so3(exp_so3(phi)), phi, atol=1e-9)


@given(vectors, st.floats(1e-9, 1e-3))
def test_exp_is_smooth_at_series_switch(direction, angle):
    phi = direction / max(np.linalg.norm(direction), 1e-9) * angle
    R = exp_so3(phi)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(R, np.eye(3) + skew(phi) + skew(phi) @ skew(phi) / 2, atol=angle**3)


@given(vectors, vectors, vectors)
def test_a_pose_and_its_inverse_cancel(phi, t, p):
    T = pose(exp_so3(phi), t)
    np.testing.assert_allclose(invert(T) @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(transform(invert(T), transform(T, p[None])), p[None], atol=1e-9)


@given(vectors, vectors, arrays(np.float64, 6, elements=st.floats(-0.5, 0.5)))
def test_difference_undoes_perturb(phi, t, tangent):
    T = pose(exp_so3(phi), t)
    np.testing.assert_allclose(difference(perturb(T, tangent), T), tangent, atol=1e-9)


@given(vectors, st.floats(1e-10, 3.0))
def test_rotation_angle_tiny_is_exact(phi, angle):
    axis = np.array([0.6, 0.0, 0.8])
    R = exp_so3(phi)
    assert np.isclose(rotation_angle(R @ exp_so3(axis * angle), R), angle, rtol=1e-5, atol=1e-15)


def test_functions_take_batches():
    rng = np.random.default_rng(0)
    T = pose(exp_so3(rng.normal(size=(5, 2, 3))), rng.normal(size=(5, 2, 3)))
    points = rng.normal(size=(5, 2, 7, 3))
    moved = transform(T, points)
    np.testing.assert_allclose(moved[3, 1], transform(T[3, 1], points[3, 1]))
    np.testing.assert_allclose(transform(invert(T), moved), points, atol=1e-12)


@given(vectors, st.floats(0.5, 5.0))
def test_a_fitted_plane_faces_the_origin(phi, distance):
    rng = np.random.default_rng(1)
    R = exp_so3(phi)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (200, 2)), rng.normal(0, 0.01, 200)])
    plane, rms = fit_plane(points @ R.T + distance * R[:, 2])
    np.testing.assert_allclose(plane[:3], -R[:, 2], atol=0.02)
    assert abs(plane[3] - distance) < 0.01
    assert 0.008 < rms < 0.012
