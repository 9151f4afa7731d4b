"""Probe points: a written file must project the same LiDAR points to the same pixels."""

from pathlib import Path

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.rig import Rig

TOLERANCE = 1e-6


def probe_points(calibration: Calibration, rig: Rig) -> Array:
    """List points (N, 3) m, frame LiDAR, that cover the camera's image at 1 to 10 m."""
    intrinsics = rig.cameras[calibration.camera].to_intrinsics()
    u = np.linspace(0.05, 0.95, 5) * (intrinsics.width_px - 1)
    v = np.linspace(0.05, 0.95, 5) * (intrinsics.height_px - 1)
    rays = intrinsics.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    # A lens model may end before the image's corners.
    rays = rays[np.isfinite(rays).all(axis=1)]
    points_camera = (rays[:, None, :] * np.array([1.0, 3.0, 10.0])[:, None]).reshape(-1, 3)
    return transform(invert(calibration.T_cam_lidar), points_camera)


def check_pose(path: Path, what: str, T_cam_lidar: Array, calibration: Calibration, rig: Rig) -> None:
    """Check a pose read back from a file by the probe points, in metres and pixels.

    Raises:
        LceRigError: a point lands more than 1e-6 m or px elsewhere.
    """
    intrinsics = rig.cameras[calibration.camera].to_intrinsics()
    check_projection(path, what, T_cam_lidar, intrinsics, calibration, rig)


def check_projection(
    path: Path,
    what: str,
    T_cam_lidar: Array,
    intrinsics: Intrinsics,
    calibration: Calibration,
    rig: Rig,
    wanted: Intrinsics | None = None,
) -> None:
    """Check a pose and a camera model read back from a file by the probe points.

    Args:
        path: the file that was read back.
        what: the entry in the file.
        T_cam_lidar: (4, 4) as read.
        intrinsics: as read.
        calibration: what should have been written.
        rig: what should have been written.
        wanted: the camera model that should have been written; the profile's if None.

    Raises:
        LceRigError: a point lands more than 1e-6 m or px elsewhere.
    """
    wanted = wanted or rig.cameras[calibration.camera].to_intrinsics()
    points_lidar = probe_points(calibration, rig)
    points_wanted = transform(calibration.T_cam_lidar, points_lidar)
    points_read = transform(T_cam_lidar, points_lidar)
    pixels_wanted, is_seen = wanted.project(points_wanted)
    pixels_read, _ = intrinsics.project(points_read)
    off_m = float(np.abs(points_read - points_wanted).max())
    # A fitted lens may end before that of the profile.
    off_px = float(np.abs(pixels_read - pixels_wanted)[is_seen].max())
    if not (off_m <= TOLERANCE and off_px <= TOLERANCE):
        raise LceRigError(
            f"{path}: {what} reads back differently: a point moves by {off_m:.3g} m, {off_px:.3g} px",
            "Do not use the file. Check the disk, or report this as a bug of lce-rig.",
        )
