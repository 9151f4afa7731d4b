"""Whether the board stands differently from every capture before."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, rotation_angle
from lce_rig.core.results import ImageBoard
from lce_rig.detect.image_board import find_image_board
from lce_rig.session import Capture, Session

ImageKey = tuple[str, str]
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])


class KnownPoses:
    """Poses of the board in a session's captures, as each camera saw it.

    Captures made from folders carry no poses: their pictures are searched for the board once.
    """

    def __init__(self, session: Session, min_move_m: float, min_turn_deg: float) -> None:
        self._min_move_m = min_move_m
        self._min_turn_rad = float(np.radians(min_turn_deg))
        self._poses: list[tuple[str, ImageKey, Array]] = []
        for capture in session.captures:
            try:
                self._poses.extend((capture.name, *entry) for entry in _poses_of(capture, session))
            except LceRigError:
                continue  # A damaged capture is named when it is used.

    def find_like(self, boards: Mapping[ImageKey, ImageBoard]) -> str | None:
        """Name a capture in which every camera saw the board where it is now; None where it is new."""
        likes: dict[str, list[bool]] = {}
        for name, key, T_cam_board in self._poses:
            if key in boards:
                likes.setdefault(name, []).append(self._is_like(T_cam_board, boards[key].T_cam_board))
        return next((name for name in sorted(likes) if all(likes[name])), None)

    def add(self, name: str, boards: Mapping[ImageKey, ImageBoard]) -> None:
        """Remember the poses of a new capture."""
        self._poses.extend((name, key, board.T_cam_board) for key, board in boards.items())

    def _is_like(self, T_1: Array, T_2: Array) -> bool:
        if float(np.linalg.norm(T_1[:3, 3] - T_2[:3, 3])) >= self._min_move_m:
            return False
        # The print may be read from either end.
        turns = [rotation_angle(T_1[:3, :3] @ flip, T_2[:3, :3]) for flip in (np.eye(3), _HALF_TURN)]
        return float(min(turns)) < self._min_turn_rad


def board_figures(boards: Mapping[ImageKey, ImageBoard]) -> dict[str, Any]:
    """List where each camera saw the board, for a capture's meta data."""
    poses = {".".join(key): np.round(board.T_cam_board, 9).tolist() for key, board in sorted(boards.items())}
    return {"T_cam_board": poses}


def _poses_of(capture: Capture, session: Session) -> list[tuple[ImageKey, Array]]:
    stored = capture.meta.get("T_cam_board")
    found: list[tuple[ImageKey, Array]] = []
    for camera, channel in capture.image_keys:
        if camera not in session.rig.cameras:
            continue
        if isinstance(stored, dict):
            pose = np.array(stored.get(f"{camera}.{channel}", []), dtype=np.float64)
            if pose.shape == (4, 4):
                found.append(((camera, channel), pose))
            continue
        intrinsics = session.rig.cameras[camera].to_intrinsics()
        board = find_image_board(capture.image(camera, channel), session.rig.board.to_board(), intrinsics)
        if isinstance(board, ImageBoard):
            found.append(((camera, channel), board.T_cam_board))
    return found
