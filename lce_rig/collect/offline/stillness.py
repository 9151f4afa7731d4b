"""Moments at which the board stands still in every sensor that sees it."""

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np

from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard

# For how long a board has to stand still.
_WINDOW_S = 0.5


def find_still_moments(
    detections: Iterable[BoardDetection], board: Board, max_motion_m: float
) -> Iterator[CaptureMoment]:
    """Yield the stillest moment of every stretch in which the board moves no more than that."""
    gate = StillnessGate(board, max_motion_m)
    for detection in detections:
        if (moment := gate.take(detection)) is not None:
            yield moment
    if (moment := gate.finish()) is not None:
        yield moment


class StillnessGate:
    """Takes detections in order of time, and gives the stillest moment of every stretch of stillness.

    It is the middle of a window in which nothing moved more than its figure `motion_m`. A stretch ends when
    the board moves, is lost, or has stood for `dwell_s`; it is then reported once.

    Args:
        board: the profile's.
        max_motion_m: how far it may move in a window; a hand never holds it quite still.
        dwell_s: after this long a capture is taken without waiting for the board to be moved on.

    Attributes:
        motion_m: how far the board moved in the last window; infinite where there is no whole one.
        held_s: for how long the present stretch has lasted, since its first whole window; None out of one.
    """

    def __init__(self, board: Board, max_motion_m: float, dwell_s: float = 2.0) -> None:
        self.motion_m = np.inf
        self.held_s: float | None = None
        self._board = board
        self._max_motion_m, self._dwell_ns = max_motion_m, dwell_s * 1e9
        self._window: deque[BoardDetection] = deque()
        self._best: CaptureMoment | None = None
        self._best_m = np.inf
        self._since_ns = 0

    def take(self, detection: BoardDetection) -> CaptureMoment | None:
        """Take the next detection, and give the moment of a stretch that has ended with it."""
        now_ns = detection.frame.time_ns
        self.motion_m = self._measure(detection)
        is_still = self.motion_m <= self._max_motion_m
        if is_still:
            self._since_ns = now_ns if self._best is None else self._since_ns
            if self._best is None or self.motion_m < self._best_m:
                middle = self._window[len(self._window) // 2]
                self._best = CaptureMoment(middle, {"motion_m": round(self.motion_m, 6)})
                self._best_m = self.motion_m
        self.held_s = (now_ns - self._since_ns) * 1e-9 if is_still else None
        if self._best is not None and (not is_still or now_ns - self._since_ns > self._dwell_ns):
            return self.finish()
        return None

    def finish(self) -> CaptureMoment | None:
        """Give the moment of the stretch that lasts, where there is one, and end it."""
        best, self._best, self.held_s = self._best, None, None
        return best

    def _measure(self, detection: BoardDetection) -> float:
        """Put a detection into the window and measure how far the board moved in it."""
        window = self._window
        now_ns, window_ns = detection.frame.time_ns, _WINDOW_S * 1e9
        # Start again after a gap, or where the clock was set back.
        if not detection.is_usable or (window and not 0 < now_ns - window[-1].frame.time_ns < window_ns):
            window.clear()
        if detection.is_usable:
            window.append(detection)
        while len(window) > 2 and now_ns - window[1].frame.time_ns >= window_ns:
            window.popleft()
        is_full = len(window) > 2 and now_ns - window[0].frame.time_ns >= 0.999 * window_ns
        return _motion_m(window, self._board, self._max_motion_m) if is_full else np.inf


def _motion_m(window: deque[BoardDetection], board: Board, max_motion_m: float) -> float:
    """Measure how far the board moved within a window.

    Corners show motion across the line of sight much better than poses do; planes show motion along it.
    """
    middle = window[len(window) // 2]
    motions: list[float] = []
    for key, reference in middle.images.items():
        others = [s.images[key].corners_px for s in window if key in s.images]
        grid = reference.corners_px.reshape(board.rows, board.cols, 2)
        square_px = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=-1)))
        # The order may start at the other end of the pattern where it has no unique top.
        shift_px = max(
            min(_rms(corners - reference.corners_px), _rms(corners[::-1] - reference.corners_px))
            for corners in others
        )
        motions.append(shift_px * board.square_m / max(square_px, 1e-6))
    lidar_motions = [
        max(_plane_motion_m(candidate, detection.lidars.get(lidar, []), max_motion_m) for detection in window)
        for lidar, candidates in middle.lidars.items()
        for candidate in candidates
    ]
    # Walls and tables always stand still: the cameras, which identify the board by its pattern, must agree.
    return max(max(motions), min(lidar_motions))


def _rms(difference: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=-1))))


def _plane_motion_m(reference: LidarBoard, candidates: list[LidarBoard], max_motion_m: float) -> float:
    """Measure by how much the plane of the nearest candidate passes by the reference's centre.

    The centre itself is known along the board to a few centimetres only, and serves to tell plates apart.
    """
    centre = reference.T_lidar_board[:3, 3]
    distances = [float(np.linalg.norm(c.T_lidar_board[:3, 3] - centre)) for c in candidates]
    if not distances or min(distances) > 0.1 + max_motion_m:
        return float("inf")
    plane = candidates[int(np.argmin(distances))].plane
    return float(abs(plane[:3] @ centre + plane[3]))
