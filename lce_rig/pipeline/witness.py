"""Edges of the scene outside the boards: an independent check of extrinsics."""

from contextlib import suppress

from lce_rig.core.calibration import Calibration, SceneOpinion
from lce_rig.core.errors import SessionError
from lce_rig.detect.detection import Detections
from lce_rig.judge.scene_drift import watch_scene
from lce_rig.scene.outline_score import OutlineView
from lce_rig.scene.views import build_view, evenly, without_board, without_movers
from lce_rig.session import Session
from lce_rig.show.overlays.canvas import Thumbnails, reduced

_MOST_CAPTURES = 6
"""More captures of one place add time, mainly for decoding images, and no information."""


def hear_scene(
    session: Session,
    detections: Detections,
    calibration: Calibration,
    thumbnails: Thumbnails | None = None,
) -> SceneOpinion:
    """Compare extrinsics with the edges of the scene in some captures of a session, spread over it.

    Damaged captures are skipped. Cameras without frames are not checked.

    Args:
        session: any session of the rig.
        detections: detections of the board in this session.
        calibration: the extrinsics and their covariance.
        thumbnails: receives the images that were decoded.
    """
    c = calibration
    views = scene_views(session, detections, c, thumbnails)
    return watch_scene(without_movers(views), session.rig.lens_of(c), c).opinion


def scene_views(
    session: Session, detections: Detections, c: Calibration, thumbnails: Thumbnails | None = None
) -> list[OutlineView]:
    """Find the edges of the scene without those at the board; arguments as in `hear_scene`."""
    channel = session.rig.cameras[c.camera].first_channel("frames") or ""
    boards = detections.images.get((c.camera, channel), {})
    names = sorted(boards.keys() & detections.lidars.get(c.lidar, {}).keys())
    views = []
    for name in evenly(names, _MOST_CAPTURES):
        with suppress(SessionError):
            capture = session.capture(name)
            image, scan = capture.image(c.camera, channel), session.scan(capture, c.lidar)
            if thumbnails is not None:
                thumbnails[name, c.camera, channel] = reduced(image.pixels)
            view = build_view(session.rig, c, capture.name, image, scan)
            views.append(without_board(view, boards[capture.name], session.rig, c))
    return views
