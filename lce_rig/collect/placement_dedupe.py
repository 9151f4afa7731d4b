"""Check whether a board placement differs from those of all captures."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, parse_pose, rotation_angle
from lce_rig.core.results import ImageBoard
from lce_rig.detect.finder import BoardFinder
from lce_rig.session import Capture, Session, check_capture

ImageKey = tuple[str, str]
#: Placements moved and rotated by less than this count as the same.
MIN_MOVE_M, MIN_TURN_DEG = 0.15, 10.0


def find_alike(held: Array, others: Array, min_move_m: float, min_turn_rad: float) -> NDArray[np.bool_]:
    """Check which of the other poses (M, 4, 4) match which of the captured poses (N, 4, 4): (N, M)."""
    way_m = np.linalg.norm(held[:, None, :3, 3] - others[None, :, :3, 3], axis=-1)
    # The pattern may be detected in either orientation.
    half_turn = np.diag([-1.0, -1.0, 1.0])
    R, R_others = held[:, None, :3, :3], others[None, :, :3, :3]
    turn = np.minimum(rotation_angle(R, R_others), rotation_angle(R @ half_turn, R_others))
    return np.asarray((way_m < min_move_m) & (turn < min_turn_rad))


class Placements:
    """Poses of the captured boards, by camera.

    Args:
        min_move_m, min_turn_deg: minimum translation or rotation of a board to a new placement.
    """

    def __init__(self, min_move_m: float = MIN_MOVE_M, min_turn_deg: float = MIN_TURN_DEG) -> None:
        self._min_move_m = min_move_m
        self._min_turn_rad = float(np.radians(min_turn_deg))
        self._poses: dict[str, Mapping[ImageKey, Array]] = {}

    def add(self, name: str, poses: Mapping[ImageKey, Array]) -> None:
        """Add the poses T_cam_board (4, 4) of a capture."""
        self._poses[name] = poses

    def remove(self, name: str) -> None:
        """Remove a capture, so that its placement counts as new."""
        self._poses.pop(name, None)

    def has_like(self, poses: Mapping[ImageKey, Array]) -> bool:
        """Check whether a capture has the same poses for every camera."""
        return any(self.are_alike(held, poses) for held in self._poses.values())

    def are_alike(self, one: Mapping[ImageKey, Array], two: Mapping[ImageKey, Array]) -> bool:
        """Check whether every camera that detected both boards found them in one place; False if none did."""
        limits = self._min_move_m, self._min_turn_rad
        shared = one.keys() & two.keys()
        return bool(shared) and all(find_alike(one[key][None], two[key][None], *limits) for key in shared)


def pose_figures(poses: Mapping[ImageKey, Array]) -> dict[str, Any]:
    """List the board's pose by camera, or without cameras by LiDAR, for a capture's metadata."""
    return {"T_cam_board": {".".join(key): np.round(T, 9).tolist() for key, T in sorted(poses.items())}}


def capture_poses(capture: Capture, session: Session) -> dict[ImageKey, Array]:
    """Find the board's pose by (camera, channel), T_cam_board (4, 4), or by LiDAR.

    Raises:
        SessionError: the capture is damaged, or of another rig.
    """
    check_capture(session.rig, capture)
    stored = capture.meta.get("T_cam_board")
    poses: dict[ImageKey, Array] = {}
    if isinstance(stored, dict):
        cameras = session.rig.cameras
        for name, value in stored.items():
            camera, _, channel = name.partition(".")
            is_lidar = not cameras and camera in session.rig.lidars
            if is_lidar or (camera in cameras and channel in cameras[camera].channels):
                with suppress(ValueError):
                    poses[camera, channel] = parse_pose(value)
        return poses
    finder = BoardFinder(session.rig)
    for camera, channel in capture.image_keys:
        board = finder.search_image(capture.image(camera, channel)).located
        if isinstance(board, ImageBoard):
            poses[camera, channel] = board.T_cam_board
    for lidar in () if session.rig.cameras else capture.lidars:
        boards = finder.scan(capture.scan(lidar))
        if isinstance(boards, list):
            poses[lidar, ""] = boards[0].T_lidar_board
    return poses
