"""Edges of the scene beside the boards: an independent opinion on extrinsics, or part of one estimate."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from lce_rig.core.calibration import Calibration, SceneOpinion, SceneShare
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import SessionError
from lce_rig.core.geometry import Array, difference
from lce_rig.detect.detection import Detections
from lce_rig.scene.alignment import SceneView
from lce_rig.scene.depth_edges import evenly
from lce_rig.scene.drift import watch
from lce_rig.scene.estimate import estimate
from lce_rig.scene.views import MAX_CAPTURES, build_view, without_board, without_movers
from lce_rig.session import Session

OPINION_CAPTURES = 6
"""More captures of one place add time, mainly for decoding images, and no information."""
_KNOWN_SHARE = 0.02  # of the boards' variance that the scene must remove in a direction to have a say in it
_CHANCE = 0.01  # of a scene that agrees with the boards to be refused


def hear_scene(session: Session, detections: Detections, calibration: Calibration) -> SceneOpinion:
    """Compare extrinsics with the edges of the scene in some captures of a session, spread over it.

    Damaged captures are skipped. A camera without frames has no opinion.

    Args:
        session: any session of the rig.
        detections: of this session: its captures, and where the board is.
        calibration: the extrinsics and their covariance.
    """
    c = calibration
    views = scene_views(session, detections, c, OPINION_CAPTURES)
    drift = watch(without_movers(views), session.rig.lens_of(c), c.T_cam_lidar, c.cov)
    return SceneOpinion(drift.n_captures, drift.n_edges, drift.axes if drift.curves else ())


def scene_views(
    session: Session, detections: Detections, extrinsics: Calibration, n_most: int
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


def sharpen(session: Session, detections: Detections, by_boards: Calibration) -> SceneShare:
    """Add what the edges of the scene tell to extrinsics that boards gave.

    Args:
        session: of the captures; damaged ones are skipped.
        detections: of this session: edges at the board and its holder are left out.
        by_boards: the extrinsics by the boards alone.
    """
    views = without_movers(scene_views(session, detections, by_boards, MAX_CAPTURES))
    return share_of(views, session.rig.lens_of(by_boards), by_boards)


def share_of(views: Sequence[SceneView], lens: Intrinsics, by_boards: Calibration) -> SceneShare:
    """Estimate extrinsics from boards and scene, and test whether the two agree.

    Errors of the profile's lens and board (C) move all extrinsics found with it: the scene does not reduce
    them. With P = C + Q the covariance of the boards' extrinsics, Q is the prior, Q' the covariance of both
    that results, and C + Q' is what is claimed. The scene may not share all of C: with G = 1 - Q' Q^-1 the
    change d = G (scene - boards) has at most the covariance D = Q - Q' + G C G^T. d^T D^-1 d, over the
    directions in which the scene knows anything, is chi-squared.

    Args:
        views: of the scene, without the board and without what moves before a standing rig.
        lens: of the camera.
        by_boards: the extrinsics by the boards alone.
    """
    from scipy.stats import chi2

    T_boards, cov_boards = by_boards.T_cam_lidar, by_boards.cov
    own = cov_boards - by_boards.cov_shared
    T_both, cov_both = estimate(views, lens, T_boards, own)
    change = difference(T_both, T_boards)
    root = np.asarray(np.linalg.cholesky(own), dtype=np.float64)
    gain = np.eye(6) - np.linalg.solve(own, cov_both).T
    expected = own - cov_both + gain @ by_boards.cov_shared @ gain.T
    removed, directions = np.linalg.eigh(_whitened(own - cov_both, root))
    is_known = removed > _KNOWN_SHARE
    seen = directions[:, is_known].T
    along = seen @ np.linalg.solve(root, change)
    n_known = int(np.count_nonzero(is_known))
    surprise = float(along @ np.linalg.solve(seen @ _whitened(expected, root) @ seen.T, along))
    is_surprising = n_known > 0 and surprise > chi2.ppf(1 - _CHANCE, n_known)
    return SceneShare(
        state="contradicts" if is_surprising else "used" if n_known else "unknown",
        n_captures=len(views),
        n_edges=sum(len(view.edges) for view in views),
        T_cam_lidar=T_both,
        cov=cov_both + by_boards.cov_shared,
        T_cam_lidar_boards=T_boards,
        cov_boards=cov_boards,
        change=change,
        change_sigma=np.sqrt(np.maximum(np.diag(expected), 0.0)),
        surprise=surprise,
        n_directions=n_known,
    )


def _whitened(cov: Array, root: Array) -> Array:
    """Express a covariance (6, 6) in units of L L^T, with L = `root`."""
    scaled = np.linalg.solve(root, np.linalg.solve(root, cov).T)
    return np.asarray(0.5 * (scaled + scaled.T), dtype=np.float64)


def by_boards(calibration: Calibration) -> Calibration:
    """Give the extrinsics of the boards alone, of which the scene is independent."""
    share = calibration.scene_share
    if share is None:
        return calibration
    return replace(calibration, T_cam_lidar=share.T_cam_lidar_boards, cov=share.cov_boards)
