"""Ask the scene for its opinion on extrinsics that a board gave: its edges are no part of the evidence."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from lce_rig.core.calibration import AxisOpinion, Calibration, Extrinsics, OpinionState, SceneOpinion
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import SessionError
from lce_rig.detect.detection import Detections
from lce_rig.scene.alignment import SceneView
from lce_rig.scene.depth_edges import evenly
from lce_rig.scene.drift import AxisDrift, State, watch
from lce_rig.scene.views import build_view, without_board, without_movers
from lce_rig.session import Session

MAX_CAPTURES = 6
"""More captures of one place add time, mainly for decoding images, and no information."""
_STATES: dict[State, OpinionState] = {
    "unchanged": "agrees",
    "changed": "contradicts",
    "unknown": "unknown",
}


def hear_scene(session: Session, detections: Detections, calibration: Calibration) -> SceneOpinion:
    """Compare extrinsics with the edges of the scene in some captures of a session, spread over it.

    Damaged captures are skipped. A camera without frames has no opinion.

    Args:
        session: any session of the rig.
        detections: of this session: its captures, and where the board is.
        calibration: the extrinsics and their covariance.
    """
    views = scene_views(session, detections, calibration, MAX_CAPTURES)
    return opinion_of(views, session.rig.cameras[calibration.camera].to_intrinsics(), calibration)


def scene_views(
    session: Session, detections: Detections, extrinsics: Extrinsics, n_most: int
) -> list[SceneView]:
    """Find the edges of the scene in captures of a session, spread over it, without those at the board.

    Args:
        session, detections: as of `hear_scene`.
        extrinsics: as of `hear_scene`.
        n_most: captures.
    """
    c = extrinsics
    channel = session.rig.cameras[c.camera].first_channel("frames") or ""
    boards = detections.images.get((c.camera, channel), {})
    names = sorted(boards.keys() & detections.lidars.get(c.lidar, {}).keys())
    views = []
    for name in evenly(names, n_most):
        with suppress(SessionError):
            capture = session.capture(name)
            image, scan = capture.image(c.camera, channel), capture.scan(c.lidar)
            view = build_view(session.rig, c, capture.name, image, scan)
            views.append(without_board(view, boards[capture.name], session.rig, c))
    return views


def opinion_of(views: Sequence[SceneView], lens: Intrinsics, calibration: Calibration) -> SceneOpinion:
    """Compare extrinsics with the edges of some captures, without what moves before a standing rig."""
    c = calibration
    drift = watch(without_movers(views), lens, c.T_cam_lidar, c.cov, is_joint=False)
    if not drift.curves:
        return SceneOpinion(drift.n_captures, drift.n_edges)
    return SceneOpinion(drift.n_captures, drift.n_edges, tuple(map(_of_axis, drift.axes)))


def _of_axis(drift: AxisDrift) -> AxisOpinion:
    smallest = float(drift.smallest) if np.isfinite(drift.smallest) else None
    change, sigma = float(drift.change), float(drift.sigma)
    return AxisOpinion(drift.axis, _STATES[drift.state], drift.unit, change, sigma, smallest)
