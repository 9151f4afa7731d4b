"""Rotations in the formats' representations: quaternions and fixed-axis angles.

References:
    K. Shoemake, "Euler angle conversion", Graphics Gems IV, 1994.
"""

import numpy as np

from lce_rig.core.geometry import Array, project_to_so3


def quaternion_wxyz(R: Array) -> Array:
    """Compute the unit quaternion (4,), scalar first and not negative, of R (3, 3)."""
    from scipy.spatial.transform import Rotation

    wxyz = np.roll(Rotation.from_matrix(R).as_quat(), 1)
    return np.asarray(wxyz if wxyz[0] >= 0 else -wxyz)


def rotation_from_quaternion(wxyz: Array) -> Array:
    """Compute R (3, 3) = (w^2 - v.v) I + 2 v v^T + 2 w v^ from a unit quaternion (4,), scalar first."""
    w, x, y, z = wxyz / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


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


def rotation_from_rpy(angles: Array) -> Array:
    """Compute R (3, 3) = Rz(yaw) Ry(pitch) Rx(roll) from (roll, pitch, yaw) in rad."""
    (cos_r, cos_p, cos_y), (sin_r, sin_p, sin_y) = np.cos(angles), np.sin(angles)
    Rx = np.array([[1, 0, 0], [0, cos_r, -sin_r], [0, sin_r, cos_r]])
    Ry = np.array([[cos_p, 0, sin_p], [0, 1, 0], [-sin_p, 0, cos_p]])
    Rz = np.array([[cos_y, -sin_y, 0], [sin_y, cos_y, 0], [0, 0, 1]])
    return np.asarray(Rz @ Ry @ Rx)
