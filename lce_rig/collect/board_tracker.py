"""Tracking of the board from frame to frame, in every image and scan."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from lce_rig.calibrate.consensus import CENTRE_TOLERANCE_M, NORMAL_TOLERANCE_RAD
from lce_rig.collect.findings import IMAGE_NONE, LIDAR_ELSEWHERE
from lce_rig.core.data import Scan
from lce_rig.core.findings import Losses, Refusal
from lce_rig.core.geometry import Array, invert
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.finder import BoardFinder
from lce_rig.detect.findings import BOARD_THERE
from lce_rig.detect.image.search import NOT_SEEN_AT_ONCE
from lce_rig.rig import Rig
from lce_rig.rig.profile import NominalExtrinsic
from lce_rig.timing.scan_pairing import Frame

ImageKey = tuple[str, str]

# Interval between full searches, s: of images without a board, and of scans whose candidate was lost.
_SEARCH_S = 0.3
# Factor on the tolerance of the nominal extrinsics within which a candidate counts as the camera's board.
_NOMINAL_MARGIN = 1.5
# Largest misfit, relative to its limit, that confirms nominal extrinsics for boards at all distances.
_PROVED = 0.5


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """The board detected in one frame.

    Attributes:
        images: detections by (camera, channel).
        lidars: candidates within the profile's limits, by LiDAR; they may include other objects of its size.
        unseen: refusal by (camera, channel), of searched images without the board.
        unscanned: refusal by LiDAR, of searched scans without such a candidate.
        unfit: refusal by (camera, channel), of boards in `images` outside the profile's limits.
    """

    frame: Frame
    images: dict[ImageKey, ImageBoard]
    lidars: dict[str, list[LidarBoard]]
    unseen: dict[ImageKey, Refusal] = field(default_factory=dict)
    unscanned: dict[str, Refusal] = field(default_factory=dict)
    unfit: dict[ImageKey, Refusal] = field(default_factory=dict)

    @property
    def poses(self) -> dict[ImageKey, Array]:
        """Pose by camera, T_cam_board (4, 4); without cameras by LiDAR, T_lidar_board (4, 4)."""
        if not self.images:
            return {(lidar, ""): boards[0].T_lidar_board for lidar, boards in self.lidars.items()}
        return {key: board.T_cam_board for key, board in self.images.items()}

    @property
    def is_usable(self) -> bool:
        """Whether enough sensors see a usable board: camera and LiDAR, or two in a rig of one kind."""
        if not self.images:
            return len(self.lidars) > 1
        cameras = {camera for camera, _ in self.images.keys() - self.unfit.keys()}
        is_of_one_kind = not self.frame.scans and not self.lidars
        return len(cameras) > 1 if is_of_one_kind else bool(cameras and self.lidars)


@dataclass(frozen=True, eq=False)
class CaptureMoment:
    """A detection worth capturing.

    Attributes:
        detection: the board in its frame.
        figures: how the board moved, kept with the capture: motion_m of a board that stood still; speed_mps,
            unsteady_m (rms from a straight, steady path) and events_px (events per pixel of the board in
            the second before) of one that moved; by_hand of one captured by a key.
    """

    detection: BoardDetection
    figures: Mapping[str, float]


@dataclass
class BoardTracker:
    """Finds the board in each frame, near its last position, so that long recordings are searched quickly.

    Attributes:
        rig: the profile.
        thorough_interval_s: interval between thorough searches of an image without a board, s, each of which
            takes most of a second; 0 for always.
        rescan_interval_s: interval between searches of a whole scan while all candidates are followed, s; 0
            for the interval that applies while one is lost.
        refusals: frames without the board, and boards that were found but are unusable.
    """

    rig: Rig
    thorough_interval_s: float = 0.0
    rescan_interval_s: float = 0.0
    refusals: Losses = field(default_factory=Losses)
    _seen: dict[ImageKey, ImageBoard] = field(default_factory=dict)
    _candidates: dict[str, list[LidarBoard]] = field(default_factory=dict)
    _n_candidates: dict[str, int] = field(default_factory=dict)
    _searched_ns: dict[ImageKey | str, int] = field(default_factory=dict)
    _thorough_ns: dict[ImageKey | str, int] = field(default_factory=dict)
    _unseen: dict[ImageKey, Refusal] = field(default_factory=dict)
    _are_proved: set[tuple[str, str]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.finder = BoardFinder(self.rig)

    def sight(self, frame: Frame) -> BoardDetection:
        """Find the board in every image and scan of a frame."""
        return self.sight_in_scans(self.sight_in_images(frame))

    def sight_in_images(self, frame: Frame) -> BoardDetection:
        """Find the board in every image of a frame; the results from scans are empty."""
        images: dict[ImageKey, ImageBoard] = {}
        unseen: dict[ImageKey, Refusal] = {}
        unfit: dict[ImageKey, Refusal] = {}
        for image in frame.images:
            key = (image.sensor, image.channel)
            last = self._seen.pop(key, None)
            if last is None and not _is_due(self._searched_ns, key, frame.time_ns, _SEARCH_S):
                continue
            if last is not None:
                # A quick search usually finds a board that was just lost.
                self._thorough_ns[key] = frame.time_ns
            is_thorough = _is_due(self._thorough_ns, key, frame.time_ns, self.thorough_interval_s)
            search = self.finder.search_image(image, last, is_thorough=is_thorough)
            if isinstance(search.located, Refusal):
                if search.located is not NOT_SEEN_AT_ONCE:
                    unseen[key] = search.located
                continue
            images[key] = self._seen[key] = search.located
            if isinstance(search.usable, Refusal):
                unfit[key] = search.usable
        return BoardDetection(frame, images, {}, unseen, {}, unfit)

    def sight_in_scans(self, detection: BoardDetection) -> BoardDetection:
        """If an image shows the board, find it in every scan too, and count unusable boards."""
        for refusal in detection.unfit.values():
            self.refusals.add(refusal)
        lidars: dict[str, list[LidarBoard]] = {}
        unscanned: dict[str, Refusal] = {}
        # Scans are not needed while no camera sees the board.
        are_scans_enough = not self.rig.cameras
        for scan in detection.frame.scans if detection.images or are_scans_enough else ():
            candidates = self._find_in_scan(scan, detection.frame.time_ns)
            if isinstance(candidates, Refusal):
                unscanned[scan.sensor] = candidates
            else:
                lidars[scan.sensor] = candidates
        if are_scans_enough or not lidars:
            for refusal in unscanned.values():
                self.refusals.add(refusal)
        for key in detection.images:
            self._unseen.pop(key, None)
        if not detection.images and not are_scans_enough:
            self._n_candidates.clear()  # Search at once for a board that returns.
            self.refusals.add(self._explain_none(detection))
        return replace(detection, lidars=lidars, unscanned=unscanned)

    def _explain_none(self, detection: BoardDetection) -> Refusal:
        """Return why a frame has no usable board: an image's refusal, else "not found".

        Frames between two searches of an image have the reason of the earlier one.
        """
        self._unseen |= detection.unseen
        for image in detection.frame.images:
            why = self._unseen.get((image.sensor, image.channel))
            if why is not None and why.code in BOARD_THERE:
                return why
        return IMAGE_NONE.refusal()

    def confirm(self, moment: CaptureMoment) -> CaptureMoment | Refusal:
        """Search the frame of a moment without a prior, as `check` does, so that the capture is usable later.

        Returns:
            The moment with the new detections, or the refusal.
        """
        detection = moment.detection
        keys = detection.images.keys()
        images = {
            (image.sensor, image.channel): self.finder.image(image)
            for image in detection.frame.images
            if (image.sensor, image.channel) in keys
        }
        scans = {scan.sensor: self.finder.scan(scan) for scan in detection.frame.scans}
        usable = {key: board for key, board in images.items() if isinstance(board, ImageBoard)}
        lidars = {name: boards for name, boards in scans.items() if isinstance(boards, list)}
        n_lidars = 0 if not self.rig.lidars else 1 if self.rig.cameras else 2
        n_images = min(len(images), 1 if self.rig.lidars else 2)
        for found, refused, n_needed in ((usable, images, n_images), (lidars, scans, n_lidars)):
            if len(found) < n_needed:
                return next(why for why in refused.values() if isinstance(why, Refusal))
        elsewhere = self._find_elsewhere(usable, lidars)
        if elsewhere is not None:
            return elsewhere
        return replace(moment, detection=BoardDetection(detection.frame, usable, lidars))

    def _find_elsewhere(
        self, images: dict[ImageKey, ImageBoard], lidars: dict[str, list[LidarBoard]]
    ) -> Refusal | None:
        """Refuse scans with candidates only at other positions than the board in the images.

        Nominal extrinsics may be wrong: they are used for a camera and a LiDAR once they have fitted a
            moment.
        """
        elsewhere: Refusal | None = None
        for (camera, _), board in images.items():
            for lidar, candidates in lidars.items():
                nominal = self.rig.nominal(camera, lidar)
                if nominal is None:
                    return None
                misfit, elsewhere = _compare(board, candidates, nominal)
                if misfit <= _PROVED:
                    self._are_proved.add((camera, lidar))
                if misfit <= 1 or (camera, lidar) not in self._are_proved:
                    return None
        return elsewhere

    def _find_in_scan(self, scan: Scan, time_ns: int) -> list[LidarBoard] | Refusal:
        known = self._candidates.get(scan.sensor, [])
        poses = [board.T_lidar_board for board in known]
        followed = self.finder.look_in_scan(scan, poses) if poses else None
        n_found = len(followed.located) if followed is not None and isinstance(followed.located, list) else 0
        are_all_there = n_found == self._n_candidates.get(scan.sensor)
        interval_s = max(_SEARCH_S, self.rescan_interval_s if are_all_there else 0.0)
        is_due = _is_due(self._searched_ns, scan.sensor, time_ns, interval_s)
        search = followed
        if search is None or not n_found or is_due:
            search = self.finder.search_scan(scan)
        self._candidates[scan.sensor] = search.located if isinstance(search.located, list) else []
        if search is not followed:
            self._n_candidates[scan.sensor] = len(self._candidates[scan.sensor])
        return search.usable


def _is_due(last_ns: dict[ImageKey | str, int], key: ImageKey | str, time_ns: int, interval_s: float) -> bool:
    """Check whether an interval has passed since the last time for a key; if so, store the new time."""
    before_ns = last_ns.get(key)
    if before_ns is not None and 0 <= time_ns - before_ns < interval_s * 1e9:
        return False
    last_ns[key] = time_ns
    return True


def _compare(
    board: ImageBoard, candidates: list[LidarBoard], nominal: NominalExtrinsic
) -> tuple[float, Refusal]:
    """Compare candidates with the board pose expected from an image and the nominal extrinsics.

    Returns:
        The misfit of the best one, relative to the limit, and the refusal if it exceeds the limit.
    """
    T_lidar_cam = invert(nominal.to_matrix())
    poses = [pose for pose in (board.T_cam_board, board.T_cam_board_alternative) if pose is not None]
    expected = np.repeat([T_lidar_cam @ pose for pose in poses], len(candidates), axis=0)
    measured = np.array([candidate.T_lidar_board for candidate in candidates] * len(poses))
    # The distance of the boards' centres, and the angle of their planes.
    distance = np.linalg.norm(expected[:, :3, 3] - measured[:, :3, 3], axis=1)
    angle = np.arccos(np.minimum(np.abs(np.sum(expected[:, :3, 2] * measured[:, :3, 2], axis=1)), 1.0))
    turn_rad = _NOMINAL_MARGIN * np.radians(nominal.tolerance_deg)
    range_m = float(np.linalg.norm(board.T_cam_board[:3, 3]))
    max_m = CENTRE_TOLERANCE_M + _NOMINAL_MARGIN * nominal.tolerance_m + range_m * turn_rad
    misfit = np.maximum(distance / max_m, angle / (NORMAL_TOLERANCE_RAD + turn_rad))
    best = int(np.argmin(misfit))
    figures = {
        "n_candidates": len(candidates),
        "distance_m": float(distance[best]),
        "rotation_deg": float(np.degrees(angle[best])),
    }
    return float(misfit[best]), LIDAR_ELSEWHERE.refusal(**figures)
