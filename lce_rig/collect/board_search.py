"""The board searched for by another process: in the newest frame of a live rig, or ahead in a recording.

In a recording only images in which the board may be at rest are searched. Comparing images at an eighth of
their size takes half a millisecond. A board is searched for where something has come to rest since the last
search, and followed where it is at rest itself.
"""

import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.collect.board_tracker import BoardDetection, BoardTracker, CaptureMoment, ImageKey
from lce_rig.collect.worker import Worker
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.rig import Rig
from lce_rig.timing.scan_pairing import Frame

# Frames that wait for their images to be searched; each holds an image of each camera.
_N_AHEAD = 8
# Small images are about so wide.
_SMALL_PX = 160
# Grey values by which a pixel of a small image changes at least where something moves: noise is below 1.
_CHANGE = 8.0
# Of a board that moves by a third of a square the difference of two images varies as the images do.
_MOST_CHANGED = 0.95
# Pixels of a small image that the smallest board takes, about.
_BOARD_PX = 24
# Where nothing new has come to rest, images are searched, and searched thoroughly, as often as this.
_BLIND_S, _BLIND_THOROUGH_S = 1.0, 5.0


@dataclass(frozen=True, eq=False)
class Glance:
    """What an image shows at an eighth of its size.

    Attributes:
        small: (h, w) grey values.
        others: (h, w) each, those of the images before and after.
    """

    small: NDArray[np.float32]
    others: list[NDArray[np.float32]]

    def rests_within(self, corners: Array) -> bool:
        """Check whether a board may be at rest where the last search found its corners (N, 2)."""
        (u0, v0), (u1, v1) = np.floor(np.nanmin(corners, axis=0)), np.ceil(np.nanmax(corners, axis=0)) + 1
        part = slice(max(int(v0), 0), max(int(v1), 1)), slice(max(int(u0), 0), max(int(u1), 1))
        spread = float(np.std(self.small[part]))
        changes = [float(np.std(self.small[part] - other[part])) for other in self.others]
        return not changes or min(changes) <= _MOST_CHANGED * spread + 1.0

    def resting(self) -> NDArray[np.bool_]:
        """Find the pixels that are as before or after, (h, w)."""
        same = [_is_same(self.small, other) for other in self.others]
        return np.logical_or.reduce(same) if same else np.ones(self.small.shape, dtype=np.bool_)


Glances = Mapping[ImageKey, Glance]


def sight_ahead(
    tracker: BoardTracker, frames: Iterable[Frame], *, is_still_wanted: bool
) -> Iterator[BoardDetection]:
    """Find the board in frames: in images by another process, while this one reads on and searches scans.

    Args:
        tracker: has not been used before.
        frames: in order of time.
        is_still_wanted: whether only boards at rest are of use: images of others are not searched.
    """
    arguments = tracker.rig, tracker.search_interval_s, tracker.thorough_interval_s
    looks = glance_at(frames) if is_still_wanted else ((frame, {}) for frame in frames)
    waiting: deque[tuple[Frame, Future[BoardDetection]]] = deque()
    with Worker("search images", RestingTracker, *arguments) as images, ThreadPoolExecutor(1) as caller:
        try:
            for frame, glances in looks:
                bare = replace(frame, scans=(), events=())
                waiting.append((frame, caller.submit(images.call, "look", bare, glances)))
                if len(waiting) > _N_AHEAD:
                    yield _in_scans(tracker, *waiting.popleft())
            while waiting:
                yield _in_scans(tracker, *waiting.popleft())
        finally:
            caller.shutdown(wait=False, cancel_futures=True)


def glance_at(frames: Iterable[Frame]) -> Iterator[tuple[Frame, Glances]]:
    """Compare each frame's images with those of the frames before and after it."""
    held: tuple[Frame, dict[ImageKey, Glance]] | None = None
    for frame in frames:
        glances = {}
        for image in frame.images:
            height, width = image.pixels.shape[:2]
            factor = max(round(width / _SMALL_PX), 1)
            size = max(width // factor, 1), max(height // factor, 1)
            small = cv2.resize(image.pixels, size, interpolation=cv2.INTER_AREA)
            grey = np.asarray(small if small.ndim == 2 else small.mean(axis=2), dtype=np.float32)
            glances[image.sensor, image.channel] = Glance(grey, [])
        if held is not None:
            for key in held[1].keys() & glances.keys():
                before, after = held[1][key], glances[key]
                if before.small.shape == after.small.shape:
                    before.others.append(after.small)
                    after.others.append(before.small)
            yield held
        held = frame, glances
    if held is not None:
        yield held


class RestingTracker(BoardTracker):
    """Finds boards in images frame by frame, and skips images in which none can be at rest."""

    def __init__(self, rig: Rig, search_interval_s: float, thorough_interval_s: float) -> None:
        super().__init__(rig, search_interval_s, thorough_interval_s=thorough_interval_s)
        self._glances: Glances = {}
        self._searched: dict[ImageKey, tuple[int, Glance]] = {}
        self._searched_well: dict[ImageKey, tuple[int, Glance]] = {}

    def look(self, frame: Frame, glances: Glances) -> BoardDetection:
        """Find the board in those images that are worth it; images without a glance are."""
        self._glances = glances
        worth, are_moving = [], []
        for image in frame.images:
            key = (image.sensor, image.channel)
            glance, seen = glances.get(key), self._seen.get(key)
            if glance is None:
                worth.append(image)
                continue
            if seen is not None:
                scale = glance.small.shape[1] / self.rig.cameras[key[0]].resolution_px[0]
                is_worthwhile = glance.rests_within(seen.corners_px * scale)
            else:
                is_worthwhile = _has_come_to_rest(glance, self._searched.get(key), frame.time_ns, _BLIND_S)
            if is_worthwhile:
                self._searched[key] = frame.time_ns, glance
                worth.append(image)
                continue
            # An image may be skipped because something moves in it, or because nothing is new.
            is_same = _is_same(glance.small, self._searched[key][1].small)
            are_moving.append(seen is not None or int(np.sum(~is_same)) >= _BOARD_PX)
        detection = self.sight_in_images(replace(frame, images=tuple(worth)))
        return replace(_without_samples(detection), is_moving=not worth and any(are_moving))

    def _is_thorough_due(self, key: ImageKey, time_ns: int, *, was_seen: bool) -> bool:
        if not super()._is_thorough_due(key, time_ns, was_seen=was_seen):
            return False
        glance = self._glances.get(key)
        if glance is None:
            return True
        is_due = _has_come_to_rest(glance, self._searched_well.get(key), time_ns, _BLIND_THOROUGH_S)
        if is_due:
            self._searched_well[key] = time_ns, glance
        return is_due


def _without_samples(detection: BoardDetection) -> BoardDetection:
    """Drop the images and scans that were searched, which take long to send to another process."""
    return replace(detection, frame=replace(detection.frame, images=(), scans=()))


def _in_scans(tracker: BoardTracker, frame: Frame, images: Future[BoardDetection]) -> BoardDetection:
    return tracker.sight_in_scans(replace(images.result(), frame=frame))


def _has_come_to_rest(
    glance: Glance, searched: tuple[int, Glance] | None, time_ns: int, blind_s: float
) -> bool:
    """Check whether anything of a board's size has come to rest since a search, or that was long ago."""
    if searched is None or not 0 <= time_ns - searched[0] < blind_s * 1e9:
        return True
    is_new = glance.resting() & ~_is_same(glance.small, searched[1].small)
    return int(np.sum(is_new)) >= _BOARD_PX


def _is_same(one: NDArray[np.float32], two: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Find the pixels that did not change, (h, w); the light as a whole may."""
    if one.shape != two.shape:
        return np.zeros(one.shape, dtype=np.bool_)
    change = one - two
    return np.asarray(np.abs(change - np.median(change)) < _CHANGE)


# Interval of searches of a whole image while no board is in sight, which hold guidance up.
_SEARCH_S = 0.3
# Interval of thorough searches of an image without a board, which hold guidance up even longer.
_THOROUGH_S = 3.0
# Interval of searches of a scan for other things of the board's size while all known ones are followed.
_RESCAN_S = 1.0
# Such searches are as many times rarer than the longest of the last frames took, forgotten by this a frame.
_RARE, _FORGET = 6.0, 0.95


class BoardSearch(Worker):
    """A `BoardTracker` in its process; frames' events, which it has no use for, stay here."""

    def __init__(self, rig: Rig) -> None:
        """Prepare; see `BoardTracker`."""
        super().__init__("search for the board", _Search, rig)

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
    """The object in that process: it does not send the searched samples back."""

    def __init__(self, rig: Rig) -> None:
        self._tracker = BoardTracker(
            rig, _SEARCH_S, thorough_interval_s=_THOROUGH_S, rescan_interval_s=_RESCAN_S
        )
        self._longest_s = 0.0

    def sight(self, frame: Frame) -> BoardDetection:
        began_s = time.monotonic()
        detection = self._tracker.sight(frame)
        # On a busy computer a thorough search may take longer than the time to the next one: rare searches
        # must stay rare, or every frame waits for one.
        self._longest_s = max(time.monotonic() - began_s, _FORGET * self._longest_s)
        self._tracker.thorough_interval_s = max(_THOROUGH_S, _RARE * self._longest_s)
        self._tracker.rescan_interval_s = max(_RESCAN_S, _RARE * self._longest_s)
        return _without_samples(detection)

    def confirm(self, moment: CaptureMoment) -> CaptureMoment | Refusal:
        confirmed = self._tracker.confirm(moment)
        if isinstance(confirmed, CaptureMoment):
            return replace(confirmed, detection=_without_samples(confirmed.detection))
        return confirmed
