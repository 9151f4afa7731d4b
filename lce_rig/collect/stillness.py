"""Moments at which the board stands still in every sensor that sees it."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from lce_rig.collect.watching import Moment, Sighting
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard


@dataclass(frozen=True)
class StillnessOptions:
    """When a board counts as standing still.

    Attributes:
        window_s: for how long it has to.
        max_motion_m: how far it may move meanwhile; a hand never holds it quite still.
        dwell_s: after this long a capture is taken without waiting for the board to be moved on.
        search_interval_s: how often a whole picture is searched while no board is in sight.
    """

    window_s: float = 0.5
    max_motion_m: float = 0.01
    dwell_s: float = 2.0
    search_interval_s: float = 0.3


def find_still_moments(
    sightings: Iterable[Sighting], board: Board, options: StillnessOptions
) -> Iterator[Moment]:
    """Yield the stillest moment of every stretch in which the board stands still.

    It is the middle of a window in which nothing moved more than its figure `motion_m`. A stretch ends when
    the board moves, is lost, or has stood for `dwell_s`; it is then reported once.
    """
    window: deque[Sighting] = deque()
    best: Moment | None = None
    best_m = np.inf
    since_ns = 0
    for sighting in sightings:
        if not sighting.images or not sighting.lidars or _is_gap(window, sighting, options):
            window.clear()
        if sighting.images and sighting.lidars:
            window.append(sighting)
        while len(window) > 2 and _span_s(window) - _step_s(window) >= options.window_s:
            window.popleft()
        is_full = len(window) > 2 and _span_s(window) >= options.window_s * 0.999
        motion_m = _motion_m(window, board, options.max_motion_m) if is_full else np.inf
        now_ns = sighting.frame.time_ns
        if motion_m <= options.max_motion_m:
            since_ns = since_ns if best is not None else now_ns
            if best is None or motion_m < best_m:
                best = Moment(window[len(window) // 2], {"motion_m": round(motion_m, 6)})
                best_m = motion_m
        if best is not None and (
            motion_m > options.max_motion_m or now_ns - since_ns > options.dwell_s * 1e9
        ):
            yield best
            best = None
    if best is not None:
        yield best


def _is_gap(window: deque[Sighting], sighting: Sighting, options: StillnessOptions) -> bool:
    return bool(window) and not 0 < sighting.frame.time_ns - window[-1].frame.time_ns < options.window_s * 1e9


def _span_s(window: deque[Sighting]) -> float:
    return (window[-1].frame.time_ns - window[0].frame.time_ns) * 1e-9


def _step_s(window: deque[Sighting]) -> float:
    return (window[1].frame.time_ns - window[0].frame.time_ns) * 1e-9


def _motion_m(window: deque[Sighting], board: Board, max_motion_m: float) -> float:
    """Measure how far the board moved within a window.

    Corners tell of motion across the line of sight much better than poses do; planes tell of motion along it.
    """
    middle = window[len(window) // 2]
    motions: list[float] = []
    for key, reference in middle.images.items():
        others = [s.images[key].corners_px for s in window if key in s.images]
        motions.append(max(_corner_motion_m(corners, reference.corners_px, board) for corners in others))
    lidar_motions = [
        max(_plane_motion_m(candidate, sighting.lidars.get(lidar, []), max_motion_m) for sighting in window)
        for lidar, candidates in middle.lidars.items()
        for candidate in candidates
    ]
    # Walls and tables always stand still: the cameras, which know the board by its print, must agree.
    return max(max(motions), min(lidar_motions))


def _corner_motion_m(corners_px: Array, reference_px: Array, board: Board) -> float:
    grid = reference_px.reshape(board.rows, board.cols, 2)
    square_px = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=-1)))
    # The order may start at the other end of the print where the pattern does not say which is up.
    shift_px = min(_rms(corners_px - reference_px), _rms(corners_px[::-1] - reference_px))
    return shift_px * board.square_m / max(square_px, 1e-6)


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
