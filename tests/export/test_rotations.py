"""Rotations as the formats write them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lce_rig.core.geometry import exp_so3
from lce_rig.export.rotations import quaternion_wxyz, rotation_from_quaternion, rotation_from_rpy, rpy

ANGLES = st.floats(-np.pi, np.pi)


@given(st.tuples(ANGLES, ANGLES, ANGLES))
def test_quaternions_round_trip_with_a_scalar_that_is_not_negative(phi: tuple[float, float, float]) -> None:
    R = exp_so3(np.array(phi))
    wxyz = quaternion_wxyz(R)
    assert wxyz[0] >= 0
    np.testing.assert_allclose(rotation_from_quaternion(wxyz), R, atol=1e-14)


@given(st.tuples(ANGLES, st.floats(-np.pi / 2, np.pi / 2), ANGLES))
def test_angles_agree_with_scipys(angles: tuple[float, float, float]) -> None:
    R = rotation_from_rpy(np.array(angles))
    np.testing.assert_allclose(R, Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotation_from_rpy(rpy(R)), R, atol=2e-14)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-12, 1e-9, 1e-8, 1e-7, 1e-6, 1e-4])
@given(ANGLES, ANGLES)
def test_angles_lose_nothing_where_pitch_is_90_deg(sign: int, off: float, roll: float, yaw: float) -> None:
    R = Rotation.from_euler("xyz", [roll, sign * (np.pi / 2 - off), yaw]).as_matrix()
    np.testing.assert_allclose(rotation_from_rpy(rpy(R)), R, atol=1e-14)


def test_two_turns_with_a_figure_everyone_knows() -> None:
    optical = rotation_from_rpy(np.array([-np.pi / 2, 0, -np.pi / 2]))
    np.testing.assert_allclose(quaternion_wxyz(optical), [0.5, -0.5, 0.5, -0.5], atol=1e-15)
