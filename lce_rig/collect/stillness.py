"""Moments at which the board stands still in every sensor that sees it."""

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from lce_rig.collect.pairing import Frame
from lce_rig.core.board import Board
from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array
from lce_rig.core.results import ImageBoard, LidarBoard, Refusal
from lce_rig.detect.image_board import find_image_board, region_around
from lce_rig.detect.lidar_board import find_lidar_boards
from lce_rig.detect.lidar_track import track_lidar_board
from lce_rig.rig import Rig

ImageKey = tuple[str, str]


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


@dataclass(frozen=True, eq=False)
class Sighting:
    """The board in one frame.

    Attributes:
        images: by (camera, channel), where it was found.
        lidars: candidates by LiDAR; things of the board's size may be among them.
    """

    frame: Frame
    images: dict[ImageKey, ImageBoard]
    lidars: dict[str, list[LidarBoard]]


@dataclass(frozen=True, eq=False)
class Still:
    """A moment worth a capture: the middle of a window in which nothing moved more than `motion_m`."""

    sighting: Sighting
    motion_m: float


@dataclass
class BoardWatcher:
    """Finds the board frame by frame, near where it was, so that a long recording is searched quickly."""

    rig: Rig
    options: StillnessOptions
    counts: Counter[str] = field(default_factory=Counter)
    _seen: dict[ImageKey, ImageBoard] = field(default_factory=dict)
    _candidates: dict[str, list[LidarBoard]] = field(default_factory=dict)
    _searched_ns: dict[ImageKey | str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._board: Board = self.rig.board.to_board()

    def sight(self, frame: Frame) -> Sighting:
        """Find the board in every picture and scan of a frame."""
        images = {}
        for image in frame.images:
            key = (image.sensor, image.channel)
            found = self._find_in_image(image, key, frame.time_ns)
            if found is not None:
                images[key] = found
        lidars = {}
        # Nothing is gained from scans while no camera sees the board.
        for scan in frame.scans if images else ():
            candidates = self._find_in_scan(scan, frame.time_ns)
            if candidates:
                lidars[scan.sensor] = candidates
        if not images:
            self.counts["no board in any picture"] += 1
        elif not lidars:
            self.counts["no board in the scan"] += 1
        return Sighting(frame, images, lidars)

    def _find_in_image(self, image: Image, key: ImageKey, time_ns: int) -> ImageBoard | None:
        last = self._seen.pop(key, None)
        if last is None and not self._is_search_due(key, time_ns):
            return None
        region = None if last is None else region_around(last, image)
        intrinsics = self.rig.cameras[image.sensor].to_intrinsics()
        found = find_image_board(image, self._board, intrinsics, region=region)
        if isinstance(found, Refusal):
            return None
        self._seen[key] = found
        return found

    def _find_in_scan(self, scan: Scan, time_ns: int) -> list[LidarBoard]:
        tracked = (track_lidar_board(scan, self._board, old) for old in self._candidates.get(scan.sensor, []))
        found = [board for board in tracked if isinstance(board, LidarBoard)]
        if self._is_search_due(scan.sensor, time_ns) or not found:
            settings = self.rig.lidars[scan.sensor]
            reach_m = min(settings.max_range_m, self.rig.quality.max_distance_m)
            search = find_lidar_boards(
                scan, self._board, min_range_m=settings.min_range_m, max_range_m=reach_m
            )
            found = [] if isinstance(search, Refusal) else search
        self._candidates[scan.sensor] = found
        return found

    def _is_search_due(self, key: ImageKey | str, time_ns: int) -> bool:
        last_ns = self._searched_ns.get(key)
        if last_ns is not None and 0 <= time_ns - last_ns < self.options.search_interval_s * 1e9:
            return False
        self._searched_ns[key] = time_ns
        return True


def find_still_moments(
    sightings: Iterable[Sighting], board: Board, options: StillnessOptions
) -> Iterator[Still]:
    """Yield the stillest moment of every stretch in which the board stands still.

    A stretch ends when the board moves, is lost, or has stood for `dwell_s`; it is then reported once.
    """
    window: deque[Sighting] = deque()
    best: Still | None = None
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
            if best is None or motion_m < best.motion_m:
                best = Still(window[len(window) // 2], motion_m)
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
