"""One order of corners, and one of the two poses, for all pictures of the same board."""

from dataclasses import replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, exp_so3, pose, rotation_angle, skew
from lce_rig.core.results import ImageBoard
from lce_rig.solvers.pnp import pose_covariance


def align_corner_order(found: ImageBoard, reference: ImageBoard, board: Board) -> ImageBoard:
    """Count the corners from the same end of the print as another picture of about the same time does.

    The pattern looks the same when it is turned by 180 deg, a square one by 90 deg, but for the colours of
    its squares, and a reconstruction can have those wrong. The turn that brings the two poses nearest to each
    other is taken; the board may not have turned by half of that between the pictures.

    Args:
        found: the board whose corners are put in order.
        reference: the board as another picture of the camera shows it; of frames and events, the frame.
        board: the board.

    Returns:
        `found` as it is, or with corners, poses, covariances and track turned.
    """
    turns = (0, 1, 2, 3) if board.rows == board.cols else (0, 2)
    R_reference = reference.T_cam_board[:3, :3]
    angles = [
        float(rotation_angle((found.T_cam_board @ _turn(board, k))[:3, :3], R_reference)) for k in turns
    ]
    best = turns[int(np.argmin(angles))]
    return found if best == 0 else _turned(found, board, best)


def nearest_pose(
    found: ImageBoard, T_near: Array, board: Board, intrinsics: Intrinsics
) -> tuple[Array, Array]:
    """Choose the one of the two poses that is turned least against T_near (4, 4).

    Returns:
        T_cam_board (4, 4) and its covariance (6, 6).
    """
    other = found.T_cam_board_alternative
    if other is None:
        return found.T_cam_board, found.cov
    poses = np.stack([found.T_cam_board, other])
    if int(np.argmin(rotation_angle(poses[:, :3, :3], T_near[:3, :3]))) == 0:
        return found.T_cam_board, found.cov
    return other, pose_covariance(other, board.corners(), intrinsics, found.sigma_px)


def _turn(board: Board, n_quarters: int) -> Array:
    """Build the motion (4, 4) of the board that `numpy.rot90` of its corners amounts to."""
    R = exp_so3(np.array([0.0, 0.0, -n_quarters * np.pi / 2]))
    centre = np.array([*board.pattern_offset_m, 0.0])
    return pose(R, centre - R @ centre)


def _turned(found: ImageBoard, board: Board, n_quarters: int) -> ImageBoard:
    F = _turn(board, n_quarters)
    grid = found.corners_px.reshape(board.rows, board.cols, 2)
    other, track = found.T_cam_board_alternative, found.track_T_cam_board
    track_cov = found.track_cov
    if track is not None and track_cov is not None:
        track_cov = _turned_cov(track, track_cov, F)
    return replace(
        found,
        corners_px=np.ascontiguousarray(np.rot90(grid, n_quarters).reshape(-1, 2)),
        T_cam_board=found.T_cam_board @ F,
        cov=_turned_cov(found.T_cam_board, found.cov, F),
        T_cam_board_alternative=None if other is None else other @ F,
        track_T_cam_board=None if track is None else track @ F,
        track_cov=track_cov,
    )


def _turned_cov(T: Array, cov: Array, F: Array) -> Array:
    """Move covariances (..., 6, 6) from T to T F: the new origin is R f + t, with d(R f) = phi x R f."""
    A = np.broadcast_to(np.eye(6), cov.shape).copy()
    A[..., :3, 3:] = -skew(T[..., :3, :3] @ F[:3, 3])
    return np.asarray(A @ cov @ np.swapaxes(A, -1, -2))
