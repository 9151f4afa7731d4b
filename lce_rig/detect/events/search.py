"""The board in a stream of events: detected in an image at the requested time, and tracked through others."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events, Image
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, exp_so3, pose, rotation_angle, skew
from lce_rig.core.planar_pose import pose_covariance
from lce_rig.core.results import ImageBoard
from lce_rig.detect.events.figures import (
    event_quality,
    explain_missing_board,
    gate_event_board,
    outline_px,
    with_motion,
)
from lce_rig.detect.events.reconstructor import Reconstructor
from lce_rig.detect.finder import gate_image_board
from lce_rig.detect.image.search import find_image_board
from lce_rig.rig import QualitySettings

# One order of corners, and one of the two poses, for all images of the same board.


def align_corner_order(found: ImageBoard, reference: ImageBoard, board: Board) -> ImageBoard:
    """Order the corners from the same end of the pattern as in another image of about the same time.

    The pattern looks the same when rotated by 180 deg, a square one by 90 deg, except for the colours of
    its squares, and a reconstruction can have those wrong. The turn that brings the two poses nearest to each
    other is taken; the board must not have rotated by half of that between the images.

    Args:
        found: the board whose corners are put in order.
        reference: the board as another image of the camera shows it; of frames and events, the frame.
        board: the board.

    Returns:
        `found` unchanged, or with corners, poses, covariances and track rotated.
    """
    if board.has_markers:
        return found
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


#: When the board is looked for besides the main picture, ns after it.
TRACK_NS = (-100_000_000, -50_000_000, 50_000_000, 100_000_000)
# Between neighbouring images no hand turns the board by more: it is another board, or misread.
_MAX_TURN_RAD = np.radians(45)


@dataclass(frozen=True, eq=False)
class EventSighting:
    """The detection in a stream of events.

    Attributes:
        picture: at the time asked for, or why there is none.
        board: in that image and, as its track, in those about it; or why it is not there.
    """

    picture: Image | Refusal
    board: ImageBoard | Refusal


def find_event_board(
    events: Events,
    stamp_ns: int,
    reconstructor: Reconstructor,
    board: Board,
    intrinsics: Intrinsics,
    limits: QualitySettings,
    *,
    sweep_s: float | None = None,
) -> EventSighting:
    """Make an image of the events up to a timestamp, find the board in it and follow it to either side.

    Args:
        events: from long enough before the timestamp for the network to settle.
        stamp_ns: on the events' clock.
        reconstructor: is reset.
        board: the board as the profile describes it.
        intrinsics: of the camera.
        limits: `quality` of the rig profile.
        sweep_s: how long the LiDAR sees the board; None if it does not.

    Raises:
        ProfileError: the intrinsics are for images of another size.
    """
    last_ns = int(events.t_ns[-1]) if len(events) else stamp_ns
    about = {min(stamp_ns + offset, max(last_ns, stamp_ns)) for offset in TRACK_NS}
    stamps = sorted({stamp_ns, *about})
    pictures = dict(zip(stamps, reconstructor.reconstruct([events], stamps), strict=True))
    picture = pictures.pop(stamp_ns)
    if isinstance(picture, Refusal):
        return EventSighting(picture, explain_missing_board(events, stamp_ns, picture, limits))
    found = find_image_board(picture, board, intrinsics, limits=limits, is_from_events=True)
    if isinstance(found, Refusal):
        return EventSighting(picture, explain_missing_board(events, stamp_ns, found, limits))
    found = _followed(replace(found, stamp_ns=stamp_ns), pictures, board, intrinsics, limits)
    made = event_quality(events, stamp_ns, outline_px(found.T_cam_board, board, intrinsics))
    gated = gate_image_board(replace(found, events=with_motion(made, found, sweep_s)), limits)
    return EventSighting(picture, gate_event_board(gated, limits) if isinstance(gated, ImageBoard) else gated)


def _followed(
    main: ImageBoard,
    others: Mapping[int, Image | Refusal],
    board: Board,
    intrinsics: Intrinsics,
    limits: QualitySettings,
) -> ImageBoard:
    """Follow the board from its main image to either side, and keep its poses as the track."""
    assert main.stamp_ns is not None
    track: dict[int, tuple[Array, Array]] = {}
    stamps = sorted(others)
    earlier = [stamp for stamp in reversed(stamps) if stamp < main.stamp_ns]
    later = [stamp for stamp in stamps if stamp > main.stamp_ns]
    for way in (earlier, later):
        last = main
        for stamp in way:
            other = others[stamp]
            if isinstance(other, Refusal):
                continue
            seen = find_image_board(other, board, intrinsics, last=last, limits=limits, is_from_events=True)
            if isinstance(seen, Refusal):
                continue
            seen = align_corner_order(seen, main, board)
            T, cov = nearest_pose(seen, main.T_cam_board, board, intrinsics)
            if rotation_angle(T[:3, :3], main.T_cam_board[:3, :3]) < _MAX_TURN_RAD:
                track[stamp], last = (T, cov), seen
    if not track:
        return main
    stamps = sorted(track)
    return replace(
        main,
        track_ns=np.array(stamps, dtype=np.int64),
        track_T_cam_board=np.stack([track[stamp][0] for stamp in stamps]),
        track_cov=np.stack([track[stamp][1] for stamp in stamps]),
    )
