"""Board search in a separate process: in the newest images of a live rig, or ahead in a recording."""

import time
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

from lce_rig.collect.board_tracker import BoardDetection, BoardTracker, CaptureMoment
from lce_rig.collect.worker import Worker
from lce_rig.core.findings import Refusal
from lce_rig.rig import Rig
from lce_rig.timing.scan_pairing import Frame

# Maximum number of frames waiting for the image search; each holds an image per camera.
_N_AHEAD = 8


def sight_ahead(tracker: BoardTracker, frames: Iterable[Frame]) -> Iterator[BoardDetection]:
    """Find the board in frames, searching images in another process and scans in this one.

    Args:
        tracker: an unused tracker.
        frames: frames in order of time.
    """
    waiting: deque[tuple[Frame, Future[BoardDetection]]] = deque()
    with (
        Worker("search images", _Search, tracker.rig, tracker.thorough_interval_s) as images,
        ThreadPoolExecutor(1) as caller,
    ):

        def next_seen() -> BoardDetection:
            frame, seen = waiting.popleft()
            return tracker.sight_in_scans(replace(seen.result(), frame=frame))

        try:
            for frame in frames:
                bare = replace(frame, scans=(), events=())
                waiting.append((frame, caller.submit(images.call, "look", bare)))
                if len(waiting) > _N_AHEAD:
                    yield next_seen()
            while waiting:
                yield next_seen()
        finally:
            caller.shutdown(wait=False, cancel_futures=True)


# Minimum interval between thorough searches of an image without a board, s; they delay the guidance.
_THOROUGH_S = 3.0
# Minimum interval between searches of a whole scan while all candidates are tracked, s.
_RESCAN_S = 1.0
# Minimum interval of both in units of the longest recent time per frame; decay of that time per frame.
_RARE, _FORGET = 6.0, 0.95


class BoardSearch(Worker):
    """A `BoardTracker` in its own process, which does not receive the frames' events."""

    def __init__(self, rig: Rig) -> None:
        """Prepare; see `BoardTracker`."""
        super().__init__("search for the board", _Search, rig, _THOROUGH_S, _RESCAN_S)

    def sight(self, frame: Frame) -> BoardDetection:
        """Find the board in every image and scan of a frame.

        Raises:
            LceRigError: the profile cannot be used.
        """
        detection: BoardDetection = self.call("sight", replace(frame, events=()))
        return replace(detection, frame=frame)

    def confirm(self, moment: CaptureMoment) -> CaptureMoment | Refusal:
        """Search the frame of a moment as `check` does; see `BoardTracker.confirm`."""
        frame = moment.detection.frame
        bare = replace(moment.detection, frame=replace(frame, events=()))
        confirmed: CaptureMoment | Refusal = self.call("confirm", replace(moment, detection=bare))
        if isinstance(confirmed, Refusal):
            return confirmed
        return replace(confirmed, detection=replace(confirmed.detection, frame=frame))


class _Search:
    """The tracker in that process; it does not send the searched samples back."""

    def __init__(self, rig: Rig, thorough_interval_s: float, rescan_interval_s: float = 0.0) -> None:
        self._tracker = BoardTracker(rig, thorough_interval_s, rescan_interval_s)
        self._longest_s = 0.0

    def look(self, frame: Frame) -> BoardDetection:
        """Find the board in the images only."""
        return _without_samples(self._tracker.sight_in_images(frame))

    def sight(self, frame: Frame) -> BoardDetection:
        began_s = time.monotonic()
        detection = self._tracker.sight(frame)
        # On a busy computer a thorough search may take longer than the interval to the next one. Keep such
        # searches rare, so that not every frame waits for one.
        self._longest_s = max(time.monotonic() - began_s, _FORGET * self._longest_s)
        self._tracker.thorough_interval_s = max(_THOROUGH_S, _RARE * self._longest_s)
        self._tracker.rescan_interval_s = max(_RESCAN_S, _RARE * self._longest_s)
        return _without_samples(detection)

    def confirm(self, moment: CaptureMoment) -> CaptureMoment | Refusal:
        confirmed = self._tracker.confirm(moment)
        if isinstance(confirmed, CaptureMoment):
            return replace(confirmed, detection=_without_samples(confirmed.detection))
        return confirmed


def _without_samples(detection: BoardDetection) -> BoardDetection:
    """Drop the searched images and scans, which are slow to send to another process."""
    return replace(detection, frame=replace(detection.frame, images=(), scans=()))
