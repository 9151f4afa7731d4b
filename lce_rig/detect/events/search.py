"""The board in a stream of events: detected in an image at the requested time, and tracked in others."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events, Image
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, exp_so3, pose, rotation_angle
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


def nearest_pose(
    found: ImageBoard, T_near: Array, board: Board, intrinsics: Intrinsics
) -> tuple[Array, Array]:
    """Choose the pose with the smallest rotation from T_near (4, 4) among those compatible with an image.

    The corners of one image fit two poses. Without markers, a pattern rotated by 180 deg (a square one by 90
    deg) has the same corners, and the colours of its squares are unreliable in reconstructed images: all
    these rotations of both poses are compared. Between the images, the board must rotate by less than half
    of that angle.

    Returns:
        T_cam_board (4, 4) and its covariance (6, 6).
    """
    step = 4 if board.has_markers else 1 if board.rows == board.cols else 2
    turns = [exp_so3(np.array([0.0, 0.0, k * np.pi / 2])) for k in range(0, 4, step)]
    centre = np.array([*board.pattern_offset_m, 0.0])
    poses = [T for T in (found.T_cam_board, found.T_cam_board_alternative) if T is not None]
    candidates = np.stack([T @ pose(R, centre - R @ centre) for T in poses for R in turns])
    T = candidates[int(np.argmin(rotation_angle(candidates[:, :3, :3], T_near[:3, :3])))]
    is_seen = np.isfinite(found.corners_px).all(axis=1)
    return T, pose_covariance(T, board.corners()[is_seen], intrinsics, found.sigma_px)


#: Times after the main image of the additional images in which the board is searched, ns.
TRACK_NS = (-100_000_000, -50_000_000, 50_000_000, 100_000_000)
# Maximum rotation by hand between neighbouring images, rad; above, it is another board or a wrong detection.
_MAX_TURN_RAD = np.radians(45)


def find_event_board(
    events: Events,
    stamp_ns: int,
    reconstructor: Reconstructor,
    board: Board,
    intrinsics: Intrinsics,
    limits: QualitySettings,
    *,
    sweep_s: float | None = None,
    frame_speed_mps: float = math.nan,
) -> tuple[Image | Refusal, ImageBoard | Refusal]:
    """Reconstruct an image at a timestamp, find the board and track it backwards and forwards.

    Args:
        events: events, from long enough before the timestamp for the network to settle.
        stamp_ns: the timestamp, on the events' clock.
        reconstructor: the reconstructor, which is reset first.
        board: the board as the profile describes it.
        intrinsics: intrinsics of the camera.
        limits: `quality` of the rig profile.
        sweep_s: duration of the LiDAR's returns from the board; None without any.
        frame_speed_mps: the board's speed in the camera's frames; NaN if unknown.

    Returns:
        The image at that time, and the board in it with its track in the images around it; or the refusals.

    Raises:
        ProfileError: the intrinsics are for images of another size.
    """
    last_ns = int(events.t_ns[-1]) if len(events) else stamp_ns
    about = {min(stamp_ns + offset, max(last_ns, stamp_ns)) for offset in TRACK_NS}
    stamps = sorted({stamp_ns, *about})
    pictures = dict(zip(stamps, reconstructor.reconstruct([events], stamps), strict=True))
    picture = pictures.pop(stamp_ns)
    if isinstance(picture, Refusal):
        return picture, explain_missing_board(events, stamp_ns, picture, limits, frame_speed_mps)
    found = find_image_board(picture, board, intrinsics, limits=limits, is_from_events=True)
    if isinstance(found, Refusal):
        return picture, explain_missing_board(events, stamp_ns, found, limits, frame_speed_mps)
    found = _followed(replace(found, stamp_ns=stamp_ns), pictures, board, intrinsics, limits)
    made = event_quality(events, stamp_ns, outline_px(found.T_cam_board, board, intrinsics))
    gated = gate_image_board(replace(found, events=with_motion(made, found, sweep_s)), limits)
    if isinstance(gated, ImageBoard):
        gated = gate_event_board(gated, limits, frame_speed_mps)
    return picture, gated


def _followed(
    main: ImageBoard,
    others: Mapping[int, Image | Refusal],
    board: Board,
    intrinsics: Intrinsics,
    limits: QualitySettings,
) -> ImageBoard:
    """Track the board from its main image backwards and forwards, and return its poses as the track."""
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
