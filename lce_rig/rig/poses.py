"""Poses of a profile: of the rig on its robot, and of its sensors by the CAD model."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from lce_rig.core.geometry import Array, pose, project_to_so3
from lce_rig.rig.settings import Figure, FrameName, Name, Positive, Row, Settings, problem

# CAD models and papers round to three digits, which changes a unit quaternion's norm by up to about 1e-3.
_ROUNDING = 5e-3
# Two sensors of one rig are not farther apart; larger figures are millimetres.
_Metres = Annotated[float, Field(ge=-20, le=20)]


class Mount(Settings):
    """The pose of one sensor on the robot, which makes the sensors part of the robot's tree of frames.

    Attributes:
        parent: a frame of the robot, such as base_link.
        of: the frame of the LiDAR, or of a camera's body, whose pose is given.
        xyz_m: its origin in the parent's frame.
        rpy_deg: (roll, pitch, yaw) about the parent's fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF.
    """

    parent: FrameName
    of: FrameName
    xyz_m: Row
    rpy_deg: Row = (0.0, 0.0, 0.0)

    def to_matrix(self) -> Array:
        """Build T_parent_of (4, 4)."""
        from scipy.spatial.transform import Rotation

        R = Rotation.from_euler("xyz", self.rpy_deg, degrees=True).as_matrix()
        return pose(R, np.array(self.xyz_m))


class NominalExtrinsic(Settings):
    """The expected pose of a camera; compared with the result, never used as an initial guess.

    It takes points from the LiDAR's frame to the camera's optical frame: p_cam = R p_lidar + t. The rotation
    is given in exactly one way.

    Attributes:
        quaternion_wxyz: unit quaternion of R, scalar first.
        rpy_deg: (roll, pitch, yaw) about fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF.
        matrix: the rows of R.
        translation_m: t, the LiDAR's origin in the optical frame.
        source: "cad", this rig's CAD model, with which the result must agree; or "typical", how such rigs are
            built: for guidance and simulation, and no test of a result.
        tolerance_deg: larger differences from the result are reported.
        tolerance_m: larger differences from the result are reported.
    """

    camera: Name
    lidar: Name
    quaternion_wxyz: tuple[Figure, Figure, Figure, Figure] | None = None
    rpy_deg: Row | None = None
    matrix: tuple[Row, Row, Row] | None = None
    translation_m: tuple[_Metres, _Metres, _Metres]
    source: Literal["cad", "typical"] = "cad"
    tolerance_deg: Positive = 5.0
    tolerance_m: Positive = 0.1

    @model_validator(mode="after")
    def _is_a_pose(self) -> "NominalExtrinsic":
        rotations = [
            key for key in ("quaternion_wxyz", "rpy_deg", "matrix") if getattr(self, key) is not None
        ]
        if len(rotations) != 1:
            names = " and ".join(rotations) if rotations else "none"
            raise problem(f"{names} given; give the rotation as one of quaternion_wxyz, rpy_deg, matrix")
        if self.quaternion_wxyz is not None:
            norm = float(np.linalg.norm(self.quaternion_wxyz))
            if abs(norm - 1) > _ROUNDING:
                raise problem(f"not a unit quaternion: its norm is {norm:.4g}", "quaternion_wxyz")
        if self.matrix is not None:
            R = np.array(self.matrix)
            error = float(np.abs(R @ R.T - np.eye(3)).max())
            if error > 2 * _ROUNDING:
                raise problem(f"not a rotation: R R^T differs from the identity by {error:.3g}", "matrix")
            if np.linalg.det(R) < 0:
                raise problem("not a rotation but a mirroring: its determinant is -1", "matrix")
        return self

    def to_matrix(self) -> Array:
        """Build T_cam_lidar (4, 4)."""
        from scipy.spatial.transform import Rotation

        if self.quaternion_wxyz is not None:
            R = Rotation.from_quat(np.roll(self.quaternion_wxyz, -1)).as_matrix()
        elif self.rpy_deg is not None:
            R = Rotation.from_euler("xyz", self.rpy_deg, degrees=True).as_matrix()
        else:
            R = project_to_so3(np.array(self.matrix))
        return pose(R, np.array(self.translation_m))
