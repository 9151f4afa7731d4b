"""Boards and scene in one estimate: the boards give the prior, the edges of the scene the likelihood."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Figure, Finding
from lce_rig.core.geometry import difference, tangent_sizes
from lce_rig.core.results import Calibration, SceneShare
from lce_rig.detect.detection import Detections
from lce_rig.extrinsics import CalibrationEstimate
from lce_rig.extrinsics.metrics import capture_residual, summarise
from lce_rig.pipeline.witness import scene_views
from lce_rig.scene.alignment import SceneView
from lce_rig.scene.estimate import estimate
from lce_rig.scene.views import MAX_CAPTURES, without_movers
from lce_rig.session import Session
from lce_rig.validation.weighing import reason

_KNOWN_SHARE = 0.02  # of the boards' variance that the scene must remove in a direction to have a say in it
_CHANCE = 0.01  # of a scene that agrees with the boards to be refused

Sharpen = Callable[[Calibration], SceneShare]
"""Asks the scene of a session about extrinsics that its boards gave."""


def sharpen(session: Session, detections: Detections, calibration: Calibration) -> SceneShare:
    """Add what the edges of a session's scene tell to extrinsics that its boards gave.

    Args:
        session: of the captures; damaged ones are skipped.
        detections: of the session: edges at the board and its holder are left out.
        calibration: by the boards alone.
    """
    lens = session.rig.cameras[calibration.camera].to_intrinsics()
    return share_of(scene_views(session, detections, calibration, MAX_CAPTURES), lens, calibration)


def share_of(views: Sequence[SceneView], lens: Intrinsics, calibration: Calibration) -> SceneShare:
    """Estimate extrinsics from boards and scene, and test whether the two agree.

    The change d from the boards' extrinsics has the covariance P - P', with P that of the boards and P' that
    of both: d^T (P - P')^-1 d, over the directions in which the scene knows anything, is chi-squared.

    What moves before a standing rig is left out, such as whoever holds the board.

    Args:
        views: of the scene, without the board.
        lens: of the camera.
        calibration: by the boards alone.
    """
    from scipy.stats import chi2

    views = without_movers(views)
    T_boards, cov_boards = calibration.T_cam_lidar, calibration.cov
    found = estimate(views, lens, T_boards, (T_boards, cov_boards))
    change = difference(found.T_cam_lidar, T_boards)
    root = np.linalg.cholesky(cov_boards)
    whitened = np.linalg.solve(root, np.linalg.solve(root, cov_boards - found.cov).T)
    removed, directions = np.linalg.eigh(0.5 * (whitened + whitened.T))
    is_known = removed > _KNOWN_SHARE
    along = directions.T @ np.linalg.solve(root, change)
    surprise = float(np.sum(along[is_known] ** 2 / removed[is_known]))
    n_known = int(np.count_nonzero(is_known))
    is_surprising = n_known > 0 and surprise > chi2.ppf(1 - _CHANCE, n_known)
    expected = np.sqrt(np.maximum(np.diag(cov_boards - found.cov), 0.0))
    return SceneShare(
        state="contradicts" if is_surprising else "used" if n_known else "unknown",
        n_captures=len(views),
        n_edges=sum(len(view.edges) for view in views),
        T_cam_lidar=found.T_cam_lidar,
        cov=found.cov,
        T_cam_lidar_boards=T_boards,
        cov_boards=cov_boards,
        change=change,
        change_sigma=expected,
        surprise=surprise,
        n_directions=n_known,
    )


def fuse(by_boards: CalibrationEstimate, share: SceneShare, board: Board) -> CalibrationEstimate:
    """Replace the extrinsics by those of boards and scene; residuals are those of the boards under them.

    Args:
        by_boards: the boards' own.
        share: of the scene.
        board: its size.
    """
    T, observations = share.T_cam_lidar, by_boards.observations
    residuals = tuple(
        capture_residual(T, observations[each.capture], board, each.held_out_m)
        for each in by_boards.residuals
    )
    return replace(
        by_boards,
        T_cam_lidar=T,
        cov=share.cov,
        residuals=residuals,
        metrics=summarise(residuals),
    )


def by_boards(calibration: Calibration) -> Calibration:
    """Give the extrinsics of the boards alone, of which the scene is independent."""
    share = calibration.scene_share
    if share is None:
        return calibration
    return replace(calibration, T_cam_lidar=share.T_cam_lidar_boards, cov=share.cov_boards)


def share_findings(share: SceneShare) -> list[Finding]:
    """Tell what the scene did to the extrinsics."""
    rotation_deg, translation_m = tangent_sizes(share.change)
    sigma_deg, sigma_m = tangent_sizes(share.change_sigma)
    figures: dict[str, Figure] = {
        "rotation_deg": rotation_deg,
        "translation_m": translation_m,
        "rotation_sigma_deg": sigma_deg,
        "translation_sigma_m": sigma_m,
        "n_captures": share.n_captures,
        "n_edges": share.n_edges,
    }
    if share.state == "contradicts":
        return [reason("verdict.scene_not_used", figures, is_fail=False)]
    code = "verdict.scene_used" if share.state == "used" else "verdict.scene_unknown"
    return [Finding(code, "note", figures=figures)]
