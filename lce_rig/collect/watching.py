"""The board followed from frame to frame, in every picture and scan."""

from collections import Counter
from dataclasses import dataclass, field

from lce_rig.collect.pairing import Frame
from lce_rig.core.board import Board
from lce_rig.core.data import Image, Scan
from lce_rig.core.results import ImageBoard, LidarBoard, Refusal
from lce_rig.detect.event_board import find_in_reconstruction
from lce_rig.detect.image_board import NOT_SEEN_AT_ONCE, find_image_board, region_around
from lce_rig.detect.lidar_board import find_lidar_boards
from lce_rig.detect.lidar_track import track_lidar_board
from lce_rig.rig import Rig

ImageKey = tuple[str, str]


@dataclass(frozen=True, eq=False)
class Sighting:
    """The board in one frame.

    Attributes:
        images: by (camera, channel), where it was found.
        lidars: candidates by LiDAR; things of the board's size may be among them.
        unseen: why it was not found, by (camera, channel), where it was looked for.
        unscanned: why it was not found, by LiDAR, where it was looked for.
    """

    frame: Frame
    images: dict[ImageKey, ImageBoard]
    lidars: dict[str, list[LidarBoard]]
    unseen: dict[ImageKey, Refusal] = field(default_factory=dict)
    unscanned: dict[str, Refusal] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Moment:
    """A sighting worth a capture.

    Attributes:
        figures: how still or how fast the board was, by name; kept with the capture.
    """

    sighting: Sighting
    figures: dict[str, float]


@dataclass
class BoardWatcher:
    """Finds the board frame by frame, near where it was, so that a long recording is searched quickly.

    Attributes:
        rig: the profile.
        search_interval_s: how often a whole picture is searched while no board is in sight.
        counts: frames in which it was not found, by sensor.
        thorough_interval_s: how often such a search is thorough, which takes most of a second; 0 for always.
        rescan_interval_s: how often a whole scan is searched while all candidates are followed; 0 for as
            often as while one is lost.
    """

    rig: Rig
    search_interval_s: float
    counts: Counter[str] = field(default_factory=Counter)
    thorough_interval_s: float = 0.0
    rescan_interval_s: float = 0.0
    _seen: dict[ImageKey, ImageBoard] = field(default_factory=dict)
    _candidates: dict[str, list[LidarBoard]] = field(default_factory=dict)
    _n_candidates: dict[str, int] = field(default_factory=dict)
    _searched_ns: dict[ImageKey | str, int] = field(default_factory=dict)
    _thorough_ns: dict[ImageKey | str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._board: Board = self.rig.board.to_board()

    def sight(self, frame: Frame) -> Sighting:
        """Find the board in every picture and scan of a frame."""
        images: dict[ImageKey, ImageBoard] = {}
        unseen: dict[ImageKey, Refusal] = {}
        for image in frame.images:
            key = (image.sensor, image.channel)
            found = self._find_in_image(image, key, frame.time_ns)
            if isinstance(found, Refusal):
                unseen[key] = found
            elif found is not None:
                images[key] = found
        lidars: dict[str, list[LidarBoard]] = {}
        unscanned: dict[str, Refusal] = {}
        # Nothing is gained from scans while no camera sees the board.
        for scan in frame.scans if images else ():
            candidates = self._find_in_scan(scan, frame.time_ns)
            if isinstance(candidates, Refusal):
                unscanned[scan.sensor] = candidates
            else:
                lidars[scan.sensor] = candidates
        if not images:
            self._n_candidates.clear()  # A board that comes back is searched for at once.
            self.counts["no board in any picture"] += 1
        elif not lidars:
            self.counts["no board in the scan"] += 1
        return Sighting(frame, images, lidars, unseen, unscanned)

    def _find_in_image(self, image: Image, key: ImageKey, time_ns: int) -> ImageBoard | Refusal | None:
        last = self._seen.pop(key, None)
        if last is None and not self._is_search_due(key, time_ns):
            return None
        region = None if last is None else region_around(last, image)
        camera = self.rig.cameras[image.sensor]
        intrinsics = camera.to_intrinsics()
        if camera.channels[image.channel].kind == "events":
            found = find_in_reconstruction(image, self._board, intrinsics, self.rig.quality, region)
        else:
            is_thorough = self._is_thorough_due(key, time_ns, was_seen=last is not None)
            found = find_image_board(
                image, self._board, intrinsics, region=region, last=last, is_thorough=is_thorough
            )
            if found is NOT_SEEN_AT_ONCE:
                return None
        if isinstance(found, ImageBoard):
            self._seen[key] = found
        return found

    def _find_in_scan(self, scan: Scan, time_ns: int) -> list[LidarBoard] | Refusal:
        known = self._candidates.get(scan.sensor, [])
        tracked = (track_lidar_board(scan, self._board, old) for old in known)
        found = [board for board in tracked if isinstance(board, LidarBoard)]
        are_all_there = len(found) == self._n_candidates.get(scan.sensor)
        interval_s = max(self.search_interval_s, self.rescan_interval_s if are_all_there else 0.0)
        if not _is_due(self._searched_ns, scan.sensor, time_ns, interval_s) and found:
            self._candidates[scan.sensor] = found
            return found
        settings = self.rig.lidars[scan.sensor]
        reach_m = min(settings.max_range_m, self.rig.quality.max_distance_m)
        search = find_lidar_boards(scan, self._board, min_range_m=settings.min_range_m, max_range_m=reach_m)
        self._candidates[scan.sensor] = [] if isinstance(search, Refusal) else search
        self._n_candidates[scan.sensor] = len(self._candidates[scan.sensor])
        return search

    def _is_search_due(self, key: ImageKey | str, time_ns: int) -> bool:
        return _is_due(self._searched_ns, key, time_ns, self.search_interval_s)

    def _is_thorough_due(self, key: ImageKey, time_ns: int, *, was_seen: bool) -> bool:
        """Tell whether it is time for a thorough search; a board just lost is soon seen again without."""
        if was_seen and self.thorough_interval_s > 0:
            self._thorough_ns[key] = time_ns
            return False
        return _is_due(self._thorough_ns, key, time_ns, self.thorough_interval_s)


def _is_due(last_ns: dict[ImageKey | str, int], key: ImageKey | str, time_ns: int, interval_s: float) -> bool:
    """Tell whether an interval has gone by since something was done last, and note that it is done now."""
    before_ns = last_ns.get(key)
    if before_ns is not None and 0 <= time_ns - before_ns < interval_s * 1e9:
        return False
    last_ns[key] = time_ns
    return True
