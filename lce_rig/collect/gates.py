"""Moments worth capturing: a board at rest, or the best moment at each place that a moving board passes.

Events need motion, the LiDAR needs stillness. A detection is usable if, in an event camera, the board

- is not faster than `quality.max_board_speed_mps`,
- generated at least `quality.min_events_px` events per pixel in the second before,
- and moves at 3 cm/s or more, or generated plenty of events nevertheless: it has just stopped, or the rig
  moves. Events of flickering light do not count.

Among such moments within seconds of each other and at one placement, the one with complete events and the
steadiest speed nearest to 10 cm/s is chosen.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment, ImageKey
from lce_rig.collect.findings import READ_NO_EVENTS_AT_SCAN
from lce_rig.collect.placement_dedupe import Placements
from lce_rig.core.board import Board
from lce_rig.core.findings import Losses, Refusal
from lce_rig.core.geometry import Array, transform
from lce_rig.core.results import LidarBoard
from lce_rig.detect.events.figures import (
    MEMORY_NS,
    MIN_SPEED_MPS,
    SLOW_EVENTS_PX,
    event_quality,
    explain_missing_board,
    outline_px,
    too_fast,
    too_few_events,
)
from lce_rig.detect.events.windows import is_flickering
from lce_rig.detect.findings import IMAGE_FLICKER
from lce_rig.rig import Rig
from lce_rig.timing.scan_pairing import EventCut, rig_time_ns

# Minimum time of rest, in seconds and in scans.
_WINDOW_S, _WINDOW_SCANS = 0.5, 2.5


def stillness_window_s(rig: Rig) -> float:
    """Return the required time of rest: LiDARs without rings accumulate scans in this time."""
    slowest_hz = min((lidar.rate_hz for lidar in rig.lidars.values() if not lidar.has_rings), default=np.inf)
    return max(_WINDOW_S, _WINDOW_SCANS / slowest_hz)


class StillnessGate:
    """Picks the moment of least motion in each period of rest; detections come in order of time.

    It is the middle of the window with the least motion, of those below `max_motion_m`. A period ends when
    the board moves, is lost, or has stood for `dwell_s`; its moment is then returned once.

    Args:
        board: the profile's board.
        max_motion_m: largest motion of the board in a window; hands are never quite still.
        dwell_s: time after which a capture is taken even if the board has not moved on.
        takes_singles: whether an isolated detection, without others in two windows before and after it, is
            accepted unchecked, as in a recording triggered once per placement.
        window_s: length of the window of stillness.

    Attributes:
        motion_m: motion of the board in the last window; infinite without a complete window.
        held_s: duration of the present period since its first complete window; None outside a period.
    """

    def __init__(
        self,
        board: Board,
        max_motion_m: float,
        dwell_s: float = 2.0,
        *,
        takes_singles: bool = False,
        window_s: float = _WINDOW_S,
    ) -> None:
        self._takes_singles, self._window_ns = takes_singles, window_s * 1e9
        self._last_ns: int | None = None
        self._single: BoardDetection | None = None
        self.motion_m = np.inf
        self.held_s: float | None = None
        self._board = board
        self._max_motion_m, self._dwell_ns = max_motion_m, dwell_s * 1e9
        self._window: deque[BoardDetection] = deque()
        self._best: CaptureMoment | None = None
        self._best_m = np.inf
        self._since_ns = 0

    def take(self, detection: BoardDetection) -> list[CaptureMoment]:
        """Take the next detection; if it ends a period of rest, return the moment of that period."""
        now_ns = detection.frame.time_ns
        is_apart = self._last_ns is None or now_ns - self._last_ns > 2 * self._window_ns
        alone = self._take_single() if is_apart else []
        self._single = detection if self._takes_singles and is_apart and detection.is_usable else None
        self._last_ns = now_ns
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
            return [*alone, *self._end_stretch()]
        return alone

    def finish(self) -> list[CaptureMoment]:
        """End the present period of rest and return its moment, if any."""
        return [*self._take_single(), *self._end_stretch()]

    def _take_single(self) -> list[CaptureMoment]:
        single, self._single = self._single, None
        return [] if single is None else [CaptureMoment(single, {})]

    def _end_stretch(self) -> list[CaptureMoment]:
        best, self._best, self.held_s = self._best, None, None
        return [] if best is None else [best]

    def _measure(self, detection: BoardDetection) -> float:
        """Add a detection to the window and compute how far the board moved in it."""
        window = self._window
        now_ns, window_ns = detection.frame.time_ns, self._window_ns
        # Start again after a gap, or if the clock was set back.
        if not detection.is_usable or (window and not 0 < now_ns - window[-1].frame.time_ns < window_ns):
            window.clear()
        if detection.is_usable:
            window.append(detection)
        while len(window) > 2 and now_ns - window[1].frame.time_ns >= window_ns:
            window.popleft()
        is_full = len(window) > 2 and now_ns - window[0].frame.time_ns >= 0.999 * window_ns
        return _motion_m(window, self._board, self._max_motion_m) if is_full else np.inf


def _motion_m(window: deque[BoardDetection], board: Board, max_motion_m: float) -> float:
    """Compute how far the board moved within a window.

    Corners show motion across the line of sight much better than poses do; planes show motion along it.
    """
    middle = window[len(window) // 2]
    motions: list[float] = []
    for key, reference in middle.images.items():
        others = [s.images[key].corners_px for s in window if key in s.images]
        # Without markers, the corner order may start at the other end: a symmetric pattern has no unique top,
        # and reconstructed images may invert the squares' colours.
        steps = (1,) if board.has_markers else (1, -1)
        shift_px = max(
            min(_rms(corners[::step] - reference.corners_px) for step in steps) for corners in others
        )
        square_px = _square_px(reference.corners_px, board)
        motions.append(shift_px * board.square_m / max(square_px, 1e-6))
    # Corners reveal rotations; without a camera, the planes at the plate's position must.
    where = np.zeros((1, 3)) if motions else board.outline()
    lidar_motions = [
        min(
            max(
                _plane_motion_m(each, detection.lidars.get(lidar, []), max_motion_m, where)
                for detection in window
            )
            for each in candidates
        )
        for lidar, candidates in middle.lidars.items()
    ]
    # Walls and tables never move, so the cameras, which identify the board by its pattern, must agree.
    if not motions or not lidar_motions:
        return max([*motions, *lidar_motions])
    return max(max(motions), min(lidar_motions))


def _square_px(corners_px: Array, board: Board) -> float:
    """Return the median side of a square, px; from the spread of corners if no two neighbours are visible."""
    grid = corners_px.reshape(board.rows, board.cols, 2)
    sides = np.linalg.norm(np.diff(grid, axis=1), axis=-1)
    if np.isfinite(sides).any():
        return float(np.nanmedian(sides))
    is_seen = np.isfinite(corners_px).all(axis=1)
    spread_px, spread_m = (
        np.linalg.norm(corners[is_seen].std(axis=0)) for corners in (corners_px, board.corners())
    )
    return float(board.square_m * spread_px / spread_m)


def _rms(difference: Array) -> float:
    """Compute the rms difference (N, 2) of the corners visible in both images; infinite without any."""
    squares = np.sum(difference**2, axis=-1)
    squares = squares[np.isfinite(squares)]
    return float(np.sqrt(np.mean(squares))) if len(squares) else np.inf


def _plane_motion_m(
    reference: LidarBoard, candidates: list[LidarBoard], max_motion_m: float, where: Array
) -> float:
    """Return the largest distance of points (K, 3) of the reference from the nearest candidate's plane, m.

    The centre is accurate to a few centimetres only along the board, and serves to select the plate.
    """
    centre = reference.T_lidar_board[:3, 3]
    distances = [float(np.linalg.norm(c.T_lidar_board[:3, 3] - centre)) for c in candidates]
    if not distances or min(distances) > 0.1 + max_motion_m:
        return float("inf")
    plane = candidates[int(np.argmin(distances))].plane
    return float(np.abs(transform(reference.T_lidar_board, where) @ plane[:3] + plane[3]).max())


# Best speed of the board, m/s: slower motion gives few events, faster motion smears.
BEST_SPEED_MPS = 0.1

_LEAST_DETECTIONS = 3
# Time without events while the board moves after which a camera's stream counts as ended, ns.
_SILENT_NS = 100_000_000


def judge_detection(
    detection: BoardDetection, around: Sequence[BoardDetection], rig: Rig, *, takes_frames: bool = False
) -> CaptureMoment | Refusal | None:
    """Check whether a detection is worth capturing.

    Args:
        detection: the board in its frame.
        around: all detections shortly before and after, itself among them.
        rig: the profile.
        takes_frames: whether frames alone make a moment, too.

    Returns:
        The moment, or its refusal; None if the tracker has counted the refusal.
    """
    cuts = {cut.sensor: cut for cut in detection.frame.events}
    if detection.images and not cuts:
        slow = _judge_frames(detection, around, rig) if takes_frames else None
        return slow or READ_NO_EVENTS_AT_SCAN.refusal()
    watched = [key for key in sorted(detection.images) if key[0] in cuts]
    if not watched:
        # The events explain why their images do not show the board.
        for (camera, channel), refusal in sorted(detection.unseen.items()):
            if rig.cameras[camera].channels[channel].kind == "events" and camera in cuts:
                stamp_ns = detection.frame.time_ns - cuts[camera].offset_ns
                recent = cuts[camera].events.between(stamp_ns - MEMORY_NS, stamp_ns)
                return explain_missing_board(recent, stamp_ns, refusal, rig.quality)
        return None
    if not detection.lidars:
        return None
    judged = [_judge_camera(key, detection, around, cuts[key[0]], rig) for key in watched]
    return next((verdict for verdict in judged if isinstance(verdict, CaptureMoment)), judged[0])


def _judge_frames(
    detection: BoardDetection, around: Sequence[BoardDetection], rig: Rig
) -> CaptureMoment | None:
    """Make a moment of frames without events, of a board within the profile's limit of speed."""
    ways = [_follow(key, around) for key in sorted(detection.images) if key not in detection.unfit]
    for speed_mps, unsteady_m in filter(None, ways if detection.lidars else []):
        if speed_mps <= rig.quality.max_board_speed_mps:
            return CaptureMoment(
                detection, {"speed_mps": round(speed_mps, 5), "unsteady_m": round(unsteady_m, 5)}
            )
    return None


def _judge_camera(
    key: ImageKey,
    detection: BoardDetection,
    around: Sequence[BoardDetection],
    cut: EventCut,
    rig: Rig,
) -> CaptureMoment | Refusal | None:
    if key in detection.unfit:
        return detection.unfit[key]
    motion = _follow(key, around)
    if motion is None:
        return None
    image = next(i for i in detection.frame.images if (i.sensor, i.channel) == key)
    # Frames and events of one camera may have different clocks or delays.
    time_ns = rig_time_ns(image, rig)
    stamp_ns = (detection.frame.time_ns if time_ns is None else time_ns) - cut.offset_ns
    # Count the events per pixel on the board in the second before its image.
    recent = cut.events.between(stamp_ns - MEMORY_NS, stamp_ns)
    camera, board = rig.cameras[key[0]], detection.images[key]
    outline = outline_px(board.T_cam_board, rig.board.to_board(), camera.to_intrinsics())
    (speed_mps, unsteady_m), events_px = motion, event_quality(recent, stamp_ns, outline).events_px
    limits = rig.quality
    if speed_mps > limits.max_board_speed_mps:
        return too_fast(speed_mps, limits.max_board_speed_mps)
    is_slow = speed_mps < MIN_SPEED_MPS
    needed_px = max(SLOW_EVENTS_PX if is_slow else 0.0, limits.min_events_px)
    if events_px < needed_px:
        if not is_slow and cut.last_ns < detection.frame.time_ns - _SILENT_NS:
            return READ_NO_EVENTS_AT_SCAN.refusal()
        return too_few_events(events_px, needed_px, np.nan if cut.missing_ns else speed_mps)
    if is_slow and is_flickering(recent):
        return IMAGE_FLICKER.refusal()
    figures = {"speed_mps": speed_mps, "unsteady_m": unsteady_m, "events_px": events_px}
    return CaptureMoment(detection, {name: round(figure, 5) for name, figure in figures.items()})


def _follow(key: ImageKey, around: Sequence[BoardDetection]) -> tuple[float, float] | None:
    """Fit a straight constant-speed path to the plate's centre: speed, m/s, and rms deviation, m.

    The middle is accurate even if the tilt is not. None if the board was detected too rarely.
    """
    seen = [s for s in around if key in s.images]
    if len(seen) < _LEAST_DETECTIONS:
        return None
    time_s = 1e-9 * np.array([s.frame.time_ns - seen[0].frame.time_ns for s in seen])
    way: Array = np.stack([s.images[key].T_cam_board[:3, 3] for s in seen])
    time_s, way = time_s - time_s.mean(), way - way.mean(axis=0)
    velocity = time_s @ way / (time_s @ time_s)
    rest = way - time_s[:, None] * velocity
    return float(np.linalg.norm(velocity)), float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))


# Deviation from a straight path equivalent to a speed wrong by a factor e, m.
_UNSTEADY_M = 0.01


class MotionGate:
    """Picks the best moment at each placement that the board passes; detections come in order of time.

    Args:
        rig: the profile.
        taken: placements captured so far, with their minimum distance; new ones are added.
        tally: counts the refusals of all other detections.
        patience_s: time for which a moment waits for a better one of the same placement.
        takes_frames: whether frames are also captured where events are missing.

    Attributes:
        judged: result for the last detection that could be judged: a usable moment, or its refusal; None if
            no event camera saw the board.
    """

    def __init__(
        self,
        rig: Rig,
        taken: Placements,
        tally: Losses,
        patience_s: float = 2.0,
        *,
        takes_frames: bool = False,
    ) -> None:
        self.judged: CaptureMoment | Refusal | None = None
        self._rig, self._taken, self._tally = rig, taken, tally
        self._takes_frames = takes_frames
        # The board's speed is measured over half a second around a detection.
        self._half_ns, self._patience_ns = 0.25e9, patience_s * 1e9
        # The last detections wait for later ones close in time, and moments for better ones.
        self._near: deque[BoardDetection] = deque()
        self._n_waiting = 0
        self._pending: deque[CaptureMoment] = deque()

    def take(self, detection: BoardDetection) -> list[CaptureMoment]:
        """Take the next detection; return the moments that are final."""
        near, now_ns, moments = self._near, detection.frame.time_ns, list[CaptureMoment]()
        if near and now_ns <= near[-1].frame.time_ns:
            # The clocks were set back.
            moments = self._judge_until(np.inf)
            near.clear()
        near.append(detection)
        self._n_waiting += 1
        moments += self._judge_until(now_ns - self._half_ns)
        while near[-max(self._n_waiting, 1)].frame.time_ns - near[0].frame.time_ns > self._half_ns:
            near.popleft()
        return moments

    def finish(self) -> list[CaptureMoment]:
        """Return the remaining moments after the last detection."""
        moments = self._judge_until(np.inf)
        self._near.clear()
        while self._pending:
            moments += self._decide_oldest()
        return moments

    def _judge_until(self, end_ns: float) -> list[CaptureMoment]:
        """Judge the waiting detections up to a time; return the moments that are final."""
        moments: list[CaptureMoment] = []
        while self._n_waiting and self._near[-self._n_waiting].frame.time_ns <= end_ns:
            detection = self._near[-self._n_waiting]
            self._n_waiting -= 1
            now_ns = detection.frame.time_ns
            around = [each for each in self._near if abs(each.frame.time_ns - now_ns) <= self._half_ns]
            self.judged = judge_detection(detection, around, self._rig, takes_frames=self._takes_frames)
            if isinstance(self.judged, Refusal):
                self._tally.add(self.judged)
            while self._pending and not (
                0 <= now_ns - self._pending[0].detection.frame.time_ns < self._patience_ns
            ):
                moments += self._decide_oldest()
            if isinstance(self.judged, CaptureMoment) and not self._taken.has_like(detection.poses):
                self._pending.append(self.judged)
        return moments

    def _decide_oldest(self) -> list[CaptureMoment]:
        """Return the oldest moment if it is the best at its place, else drop it."""
        oldest = self._pending.popleft()
        if self._taken.has_like(oldest.detection.poses):
            return []

        def badness(moment: CaptureMoment) -> tuple[bool, float]:
            cuts = moment.detection.frame.events
            is_short = not cuts or any(cut.missing_ns > 0 for cut in cuts)
            speed_ratio = max(moment.figures["speed_mps"], 1e-3) / BEST_SPEED_MPS
            return is_short, abs(float(np.log(speed_ratio))) + moment.figures["unsteady_m"] / _UNSTEADY_M

        kept: list[CaptureMoment] = []
        for moment in sorted((oldest, *self._pending), key=badness):
            poses = moment.detection.poses
            if any(self._taken.are_alike(poses, other.detection.poses) for other in kept):
                continue
            if moment is oldest:
                self._taken.add(str(oldest.detection.frame.time_ns), poses)
                return [oldest]
            kept.append(moment)
        return []


def find_moments(
    detections: Iterable[BoardDetection], gate: StillnessGate | MotionGate
) -> Iterator[CaptureMoment]:
    """Yield the moments of a recording; a second run finds the same ones."""
    for detection in detections:
        yield from gate.take(detection)
    yield from gate.finish()
