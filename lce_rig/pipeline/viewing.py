"""A session's result in 3D: the captures' clouds in the colours of the cameras."""

from collections.abc import Sequence

import numpy as np

from lce_rig.core.calibration import Calibration, read_result
from lce_rig.core.errors import SessionError
from lce_rig.pipeline.result_files import RESULT, result_parts
from lce_rig.scene.colouring import colour_points
from lce_rig.session import Capture, Session
from lce_rig.show.overlays.view_3d import CameraIn3D, CaptureIn3D


def view_of(
    session: Session, name: str | None = None
) -> tuple[tuple[CameraIn3D, ...], tuple[Calibration, ...]]:
    """Give the cameras of a result that share the first one's LiDAR, and their calibrations.

    Args:
        session: with the result.
        name: of the result; None for the one in calibration/.

    Raises:
        SessionError: there is no result.
    """
    pairs = read_result(session.path.joinpath(*result_parts(name), RESULT)).pairs
    shared = tuple(c for c in pairs if c.lidar == pairs[0].lidar)
    cameras = tuple(CameraIn3D(session.rig.lens_of(c), c.T_cam_lidar) for c in shared)
    return cameras, shared


def capture_in_3d(session: Session, capture: Capture, calibrations: Sequence[Calibration]) -> CaptureIn3D:
    """Colour the points of one capture; of several cameras, the first that sees a point gives its colour.

    Raises:
        SessionError: the capture is damaged, or has no scan of the LiDAR.
    """
    lidar = calibrations[0].lidar
    if lidar not in capture.lidars:
        raise SessionError(f"capture {capture.name} has no scan of {lidar}", "Choose another capture.")
    scan = capture.scan(lidar)
    points = scan.points
    colours, is_seen = np.zeros((len(points), 3), np.uint8), np.zeros(len(points), bool)
    for c in calibrations:
        for channel in c.channels:
            if capture.has_image(c.camera, channel):
                pixels = capture.image(c.camera, channel).pixels
                lens = session.rig.lens_of(c)
                own, is_own = colour_points(scan, pixels, c.T_cam_lidar, lens)
                colours[is_own & ~is_seen] = own[is_own & ~is_seen]
                is_seen |= is_own
    is_finite = np.isfinite(points).all(axis=1)
    shown = points[is_finite].astype(np.float32)
    return CaptureIn3D(capture.name, shown, colours[is_finite], is_seen[is_finite])
