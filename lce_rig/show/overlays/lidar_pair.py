"""Two LiDARs' clouds in one picture: the first one's is the image, the second one's is projected into it."""

from dataclasses import replace

import numpy as np

from lce_rig.calibrate.between_lidars import optical_frame
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array, transform
from lce_rig.judge.session_check import Meeting, SessionCheck
from lce_rig.show.overlays import canvas
from lce_rig.show.overlays.canvas import FAINT

_WINDOW = Intrinsics(640.0, 640.0, 639.5, 359.5, 1280, 720)


def seen_through_window(check: SessionCheck) -> tuple[SessionCheck, Array]:
    """Put a camera in the first LiDAR's place that looks at the boards.

    Args:
        check: of two LiDARs.

    Returns:
        The same as of that camera, and T_camera_first (4, 4).
    """
    middles = [meeting.measured.image.T_cam_board[:3, 3] for meeting in check.meetings.values()]
    T_view = optical_frame(np.array(middles).reshape(-1, 3))
    c = check.calibration
    seen: Calibration = replace(c, T_cam_lidar=T_view @ c.T_cam_lidar, intrinsics=_WINDOW)
    meetings = {name: _moved(meeting, T_view) for name, meeting in check.meetings.items()}
    return replace(check, calibration=seen, meetings=meetings), T_view


def _moved(meeting: Meeting, T_view: Array) -> Meeting:
    measured = meeting.measured
    image = replace(measured.image, T_cam_board=T_view @ measured.image.T_cam_board)
    return replace(meeting, measured=replace(measured, image=image))


def draw_cloud(scan: Scan, T_view: Array) -> Image:
    """Draw the first LiDAR's cloud in grey, as the camera in its place would see it.

    Args:
        scan: of the first LiDAR.
        T_view: (4, 4) from its frame to the camera's.
    """
    points = transform(T_view, scan.points[np.isfinite(scan.points).all(axis=1)])
    pixels, is_valid = _WINDOW.project(points)
    is_seen = is_valid & (points[:, 2] > 0) & _WINDOW.is_inside(pixels, -0.5)
    picture = canvas.panel(_WINDOW.width_px, _WINDOW.height_px)
    canvas.draw_discs(picture, pixels[is_seen], FAINT, 1.6)
    return Image(scan.sensor, "", scan.stamp_ns, picture)
