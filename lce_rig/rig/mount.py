"""Where a rig sits on its robot."""

import numpy as np

from lce_rig.core.geometry import Array, pose
from lce_rig.rig.settings import FrameName, Row, Settings


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
