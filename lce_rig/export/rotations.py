"""Rotations as formats write them: quaternions, fixed-axis angles, and a camera's optical frame.

References:
    K. Shoemake, "Euler angle conversion", Graphics Gems IV, 1994.
"""

import numpy as np

from lce_rig.core.geometry import Array, pose, project_to_so3

# REP-103: z forward, x right, y down in the optical frame; x forward, y left, z up in the camera's own.
R_BODY_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
T_BODY_OPTICAL = pose(R_BODY_OPTICAL, np.zeros(3))
RPY_BODY_OPTICAL = (-np.pi / 2, 0.0, -np.pi / 2)


def quaternion_wxyz(R: Array) -> Array:
    """Compute the unit quaternion (4,), scalar first and not negative, of R (3, 3)."""
    from scipy.spatial.transform import Rotation

    wxyz = np.roll(Rotation.from_matrix(R).as_quat(), 1)
    return np.asarray(wxyz if wxyz[0] >= 0 else -wxyz)


def rpy(R: Array) -> Array:
    """Compute (roll, pitch, yaw) in rad with R = Rz(yaw) Ry(pitch) Rx(roll), to rounding at every pitch.

    Near pitch = +-90 deg yaw is ill-determined. Pitch and roll are therefore read from Rz(yaw)^T R for the
    chosen yaw, so that roll compensates for an error in yaw.
    """
    R = project_to_so3(R)
    yaw = np.arctan2(R[1, 0], R[0, 0])
    cos_yaw, sin_yaw = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[2, 0], cos_yaw * R[0, 0] + sin_yaw * R[1, 0])
    cos_roll = cos_yaw * R[1, 1] - sin_yaw * R[0, 1]
    sin_roll = sin_yaw * R[0, 2] - cos_yaw * R[1, 2]
    return np.array([np.arctan2(sin_roll, cos_roll), pitch, yaw])
