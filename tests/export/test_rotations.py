"""Rotations as formats write them are exact everywhere, gimbal lock included."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lce_rig.core.geometry import exp_so3
from lce_rig.export.rotations import R_BODY_OPTICAL, RPY_BODY_OPTICAL, quaternion_wxyz, rpy


@given(st.tuples(*[st.floats(-4, 4)] * 3))
def test_quaternions_are_those_of_scipy_with_a_scalar_that_is_not_negative(phi: tuple[float, ...]) -> None:
    R = exp_so3(np.array(phi))
    wxyz = quaternion_wxyz(R)
    assert wxyz[0] >= 0
    np.testing.assert_allclose(Rotation.from_quat(np.roll(wxyz, -1)).as_matrix(), R, atol=1e-14)


@given(
    st.floats(-np.pi, np.pi),
    st.floats(-1.5, 1.5)
    | st.sampled_from([s * (np.pi / 2 - off) for s in (1, -1) for off in (0, 1e-12, 1e-7)]),
    st.floats(-np.pi, np.pi),
)
def test_angles_give_the_rotation_back_also_at_gimbal_lock(roll: float, pitch: float, yaw: float) -> None:
    R = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    np.testing.assert_allclose(Rotation.from_euler("xyz", rpy(R)).as_matrix(), R, atol=2e-14)


def test_the_optical_frame_is_that_of_rep_103() -> None:
    R = Rotation.from_euler("xyz", RPY_BODY_OPTICAL).as_matrix()
    np.testing.assert_allclose(R, R_BODY_OPTICAL, atol=1e-15)
    np.testing.assert_allclose(R_BODY_OPTICAL, Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]).as_matrix())
