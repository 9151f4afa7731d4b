"""Find the board in every image, every scan and all raw events of a session, once."""

import hashlib
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TypeVar, cast

import cv2
import numpy as np

from lce_rig.calibrate.association import find_association_error
from lce_rig.calibrate.consensus import Consensus, find_consensus, open_poses
from lce_rig.core.data import Image
from lce_rig.core.errors import NotEnoughDataError, ProfileError, SessionError, refusal_of
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import Array, invert
from lce_rig.core.progress import Progress, begin, silent
from lce_rig.core.results import BoardSurface, Observation
from lce_rig.detect.detection import Detections, ImageDetection, LidarDetection, Pair, from_arrays, to_arrays
from lce_rig.detect.events.reconstructor import SHIPPED_NETWORK, Reconstructor
from lce_rig.detect.events.search import find_event_board
from lce_rig.detect.finder import BoardFinder
from lce_rig.detect.findings import LIDAR_OTHER_ORIGIN
from lce_rig.io.beams import compare_beams
from lce_rig.io.findings import LIDAR_RINGS_SKIPPED, RINGS_SKIPPED
from lce_rig.pipeline.findings import NO_AGREEMENT
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session, check_capture
from lce_rig.session.durable import load_arrays, store_arrays
from lce_rig.show.overlays.canvas import Thumbnails, reduced

Key = tuple[str, str]
_ImageJob = tuple[Capture, str, str]
_Found = TypeVar("_Found", ImageDetection, LidarDetection, Image | Refusal)
#: Minimum number of captures that agree on extrinsics, beside a majority, before others are searched again.
_LEAST_AGREEING = 5


def detect_boards(
    session: Session,
    *,
    progress: Progress = silent,
    n_threads: int = 2,
    thumbnails: Thumbnails | None = None,
) -> Detections:
    """Find the board in all samples of a session, or read earlier detections from the cache.

    If most captures agree on extrinsics, scans of the others are searched again around the board's position
    predicted by their image.

    Images are reconstructed from a capture's raw events for the time at which the LiDAR saw the board.

    Args:
        session: open for reading is enough.
        progress: called with (done, total).
        n_threads: detectors that run in parallel.
        thumbnails: receives the images that were decoded.
    """
    finder = _Finder(session, thumbnails)
    scan_jobs, image_jobs, event_jobs = finder.jobs(session.captures)
    n_scans, total = len(scan_jobs), len(scan_jobs) + len(image_jobs) + len(event_jobs)
    images: dict[Key, dict[str, ImageDetection]] = {}
    lidars: dict[str, dict[str, LidarDetection]] = {}

    def find_in_events(job: _ImageJob) -> ImageDetection:
        name = job[0].name
        return finder.events(*job, {lidar: by[name] for lidar, by in lidars.items() if name in by})

    def counted(results: Iterable[_Found], n_before: int, total: int) -> Iterator[_Found]:
        for n_done, result in enumerate(results, start=n_before + 1):
            yield result
            progress(n_done, total)

    with ThreadPoolExecutor(n_threads) as pool:
        scanned = pool.map(lambda job: finder.scan(*job), scan_jobs)
        for (capture, lidar), scan in zip(scan_jobs, counted(scanned, 0, total), strict=True):
            lidars.setdefault(lidar, {})[capture.name] = scan
        # The LiDAR's detection gives the time for the images from events.
        pictured = pool.map(lambda job: finder.image(*job), image_jobs)
        developed = pool.map(find_in_events, event_jobs)
        seen = counted(chain(pictured, developed), n_scans, total)
        for (capture, camera, channel), image in zip([*image_jobs, *event_jobs], seen, strict=True):
            images.setdefault((camera, channel), {})[capture.name] = image
        detections = Detections(images, lidars)
        by_name = {capture.name: capture for capture, _ in scan_jobs}
        again = [
            (by_name[name], lidar, poses)
            for lidar, expected in expected_poses(session.rig, detections).items()
            for name, poses in expected.items()
        ]
        if again:
            begin(progress, "searching about predicted places")
        looked = pool.map(lambda job: finder.look(*job), again)
        for (capture, lidar, _), found in zip(again, counted(looked, 0, len(again)), strict=True):
            before = lidars[lidar][capture.name]
            if not isinstance(found, Refusal):
                lidars[lidar][capture.name] = [*found, *(before if isinstance(before, list) else [])]
            elif isinstance(before, Refusal) and before.stage == "lidar":
                lidars[lidar][capture.name] = found
    return detections


def unlike_models(session: Session, detections: Detections) -> list[Finding]:
    """Compare the first scan of each LiDAR with its model's beams, as in `collect`.

    Boards are also found in scans with skipped points, at wrong places. Refusals that name these suffice.

    Args:
        session: open for reading is enough.
        detections: detections of the session.
    """
    found: list[Finding] = []
    for lidar, by_capture in detections.lidars.items():
        codes = {each.code for each in by_capture.values() if isinstance(each, Refusal)}
        if LIDAR_RINGS_SKIPPED.code in codes or not by_capture:
            continue
        with suppress(SessionError):  # The detection reports damaged scans.
            scan = session.capture(min(by_capture)).scan(lidar)
            found += compare_beams(scan, session.rig.lidars[lidar])
    return found


def event_picture(session: Session, capture: Capture, camera: str, channel: str) -> Image | Refusal:
    """Return the image reconstructed from a capture's raw events, or the cause if there is none.

    Args:
        session: open for reading is enough.
        capture: capture with events of the camera.
        camera, channel: the image's camera and channel.
    """
    finder = _Finder(session)
    scans = {lidar: finder.scan(capture, lidar) for lidar in capture.lidars}
    return finder.picture(capture, camera, channel, scans)


class _Finder:
    """Detects boards and stores the detections in the session's cache."""

    def __init__(self, session: Session, thumbnails: Thumbnails | None = None) -> None:
        self._session = session
        self._thumbnails = {} if thumbnails is None else thumbnails
        self._boards = BoardFinder(session.rig)
        self._digest = detection_digest(session.rig)
        # Images depend on the network, too.
        with_network = hashlib.sha256(self._digest.encode() + SHIPPED_NETWORK.read_bytes())
        self._event_digest = with_network.hexdigest()[:12]

    def jobs(
        self, captures: Sequence[Capture]
    ) -> tuple[list[tuple[Capture, str]], list[_ImageJob], list[_ImageJob]]:
        """List the scans, the images and the raw events to search.

        A capture with a damaged manifest, or with sensors that the rig lacks, counts as holding the same as
        the others, so that every pair reports it.
        """
        held: dict[str, tuple[list[str], list[Key], list[Key]]] = {}
        for capture in captures:
            with suppress(SessionError):
                made_here = event_channels(self._session.rig, capture)
                stored = [key for key in capture.image_keys if key not in made_here]
                held[capture.name] = capture.lidars, stored, made_here
        if captures and not held:
            check_capture(self._session.rig, captures[0])  # raises the manifest's error
        lidars = sorted({lidar for own, _, _ in held.values() for lidar in own})
        images = sorted({key for _, own, _ in held.values() for key in own})
        events = sorted({key for _, _, own in held.values() for key in own} - set(images))
        wanted = [(capture, held.get(capture.name, (lidars, images, events))) for capture in captures]
        return (
            [(capture, lidar) for capture, (own, _, _) in wanted for lidar in own],
            [(capture, *key) for capture, (_, own, _) in wanted for key in own],
            [(capture, *key) for capture, (_, _, own) in wanted for key in own],
        )

    def image(self, capture: Capture, camera: str, channel: str) -> ImageDetection:
        """Find the board in an image that the capture holds."""

        def find() -> ImageDetection:
            image = capture.image(camera, channel)
            self._thumbnails[capture.name, camera, channel] = reduced(image.pixels)
            try:
                return self._boards.image(image)
            except ProfileError as error:
                return refusal_of("image", error)

        return self._remembered(self._digest, capture, f"{camera}.{channel}", find)

    def scan(self, capture: Capture, lidar: str) -> LidarDetection:
        """Find the surfaces of the board's size in a scan."""

        def find() -> LidarDetection:
            scan = capture.scan(lidar)
            found = self._boards.scan(scan)
            if not isinstance(found, Refusal) or found.stage != "lidar":
                return found
            # Skipped points hide the board at any placement.
            seen = compare_beams(scan, self._session.rig.lidars[lidar])
            skipped = next((each for each in seen if each.code == RINGS_SKIPPED.code), None)
            return found if skipped is None else LIDAR_RINGS_SKIPPED.refusal(lidar, **skipped.figures)

        return self._remembered(self._digest, capture, lidar, find)

    def look(self, capture: Capture, lidar: str, poses: Sequence[Array]) -> LidarDetection:
        """Find the board in a scan near one of the predicted poses T_lidar_board (4, 4)."""

        def find() -> LidarDetection:
            found = self._boards.look_in_scan(capture.scan(lidar), poses).usable
            return found if isinstance(found, Refusal) else found[:1]

        where = hashlib.sha256(np.round(np.stack(poses), 3).tobytes()).hexdigest()[:12]
        return self._remembered(self._digest, capture, f"{lidar}.at-{where}", find)

    def events(
        self, capture: Capture, camera: str, channel: str, scans: Mapping[str, LidarDetection]
    ) -> ImageDetection:
        """Find the board in raw events, and keep the reconstructed image."""

        def find() -> ImageDetection:
            picture, board = self._see(capture, camera, channel, scans)
            key = _cache_key(self._event_digest, capture, f"{camera}.{channel}.picture")
            self._keep(key, picture)
            return board

        return self._remembered(self._event_digest, capture, f"{camera}.{channel}", find)

    def picture(
        self, capture: Capture, camera: str, channel: str, scans: Mapping[str, LidarDetection]
    ) -> Image | Refusal:
        """Return the image reconstructed from raw events."""

        def find() -> Image | Refusal:
            return self._see(capture, camera, channel, scans)[0]

        return self._remembered(self._event_digest, capture, f"{camera}.{channel}.picture", find)

    def _see(
        self, capture: Capture, camera: str, channel: str, lidars: Mapping[str, LidarDetection]
    ) -> tuple[Image | Refusal, ImageDetection]:
        """Reconstruct an image of a capture's events at the scan's time of the board, and find the board."""
        from lce_rig.detect.events.figures import sweep_time_s

        rig, events = self._session.rig, capture.events(camera)
        stamp_ns = picture_stamp_ns(rig, capture, camera, channel, lidars)
        if stamp_ns is None:
            stamp_ns = int(events.t_ns[-1]) if len(events) else 0
        boards = [(name, found[0]) for name, found in lidars.items() if isinstance(found, list) and found]
        return find_event_board(
            events,
            stamp_ns,
            Reconstructor(channel),
            rig.board.to_board(),
            rig.cameras[camera].to_intrinsics(),
            rig.quality,
            sweep_s=sweep_time_s(boards[0][1], 1 / rig.lidars[boards[0][0]].rate_hz) if boards else None,
            frame_speed_mps=_frame_speed_mps(capture, camera),
        )

    def _remembered(
        self, digest: str, capture: Capture, sensor: str, find: Callable[[], _Found]
    ) -> _Found | Refusal:
        """Read a detection from the session's cache, or compute and store it; damage gives a refusal."""
        try:
            check_capture(self._session.rig, capture)
            capture.check()
            key = _cache_key(digest, capture, sensor)
            arrays = load_arrays(self._session.cached(key))
            if arrays is not None:
                with suppress(ValueError):
                    return cast(_Found, from_arrays(arrays))
            detection = find()
        except SessionError as error:
            return refusal_of("read", error)
        self._keep(key, detection)
        return detection

    def _keep(self, key: str, detection: ImageDetection | LidarDetection | Image) -> None:
        store_arrays(self._session.cached(key), to_arrays(detection))


def _frame_speed_mps(capture: Capture, camera: str) -> float:
    """Return the board's speed in a camera's frames channel, as measured by `collect`; NaN if unknown."""
    has_frames = any(sensor == camera for sensor, _ in capture.image_keys)
    speed_mps = capture.meta.get("speed_mps")
    return float(speed_mps) if has_frames and isinstance(speed_mps, float) else math.nan


def _cache_key(digest: str, capture: Capture, sensor: str) -> str:
    # Samples and timestamps are part of the key: a capture may be removed and another take its name.
    return f"{digest}/{capture.name}-{capture.manifest_sha256[:12]}.{sensor}"


def detection_digest(rig: Rig) -> str:
    """Hash the inputs of a detection besides the capture, to 12 digits: profile, code and libraries."""
    digest = hashlib.sha256(rig.model_dump_json(include={"board", "cameras", "lidars", "quality"}).encode())
    package = Path(__file__).parents[1]
    digest.update(f"{cv2.__version__} {np.__version__}".encode())
    rooms = ("core", "detect", "rig")
    sources = [source for folder in rooms for source in (package / folder).rglob("*.[jp]*[ny]")]
    for source in sorted([*sources, Path(__file__)]):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]


def event_channels(rig: Rig, capture: Capture) -> list[tuple[str, str]]:
    """List the (camera, channel) whose images are reconstructed here from raw events.

    An image that the capture already holds takes precedence.

    Raises:
        SessionError: the capture is damaged, or names sensors that the rig lacks.
    """
    check_capture(rig, capture)
    return [
        (camera, name)
        for camera in capture.event_cameras
        for name, channel in rig.cameras[camera].channels.items()
        if channel.kind == "events" and not capture.has_image(camera, name)
    ]


def picture_stamp_ns(
    rig: Rig, capture: Capture, camera: str, channel: str, lidars: Mapping[str, LidarDetection]
) -> int | None:
    """Return the time at which a LiDAR saw the board, on the channel's clock; None without timestamps.

    Of several LiDARs, the first one in the profile that detected the board is used. If none did, or points
    have no times, the time is the middle of the scan.
    """
    names = [name for name in rig.lidars if name in lidars]
    for name in sorted(names, key=lambda name: not isinstance(lidars[name], list)):
        settings, found = rig.lidars[name], lidars[name]
        board = found[0] if isinstance(found, list) and found else None
        stamp_ns = capture.scan(name).stamp_ns if board is None else board.stamp_ns
        if stamp_ns is None:
            continue
        seen_ns = round(0.5e9 / settings.rate_hz)
        if board is not None and board.offset_ns is not None and len(board.offset_ns):
            seen_ns = round(float(np.median(board.offset_ns)))
        own = rig.cameras[camera].channels[channel].timestamps.expected_offset_s
        return stamp_ns + seen_ns + round(1e9 * (settings.timestamps.expected_offset_s - own))
    return None


def boards_in(
    detections: Detections, camera: str, lidar: str, captures: Collection[str] | None = None
) -> Array:
    """Stack the board's poses T_cam_board (N, 4, 4) in captures with the board in both sensors; None: all."""
    poses: dict[str, Array] = {}
    for pair in detections.pairs:
        if (pair.camera, pair.lidar) == (camera, lidar):
            for name in detections.captures(pair):
                image, scan = detections.of(pair, name)
                if not isinstance(image, Refusal) and not isinstance(scan, Refusal):
                    poses[name] = image.T_cam_board
    chosen = [T for name, T in poses.items() if captures is None or name in captures]
    return np.array(chosen).reshape(-1, 4, 4)


def match_sensors(
    rig: Rig, detections: Detections, pair: Pair
) -> tuple[dict[str, Refusal], dict[str, BoardSurface]]:
    """Choose the LiDAR's candidates that agree with the images.

    Returns:
        Reasons why captures are unusable (a sensor found no board, or both disagree); and the matched
        candidate by capture, if at least three captures agree.
    """
    chosen: dict[str, BoardSurface] = {}
    candidates, refused = detections.candidates(pair, rig.board.to_board())
    consensus = _consensus(rig, candidates)
    if consensus is not None:
        refused |= consensus.refused
        chosen = {observation.capture: observation.surface for observation in consensus.observations}
    elif len(candidates) >= 3:
        refused |= {item.capture: NO_AGREEMENT.refusal(n_captures=len(candidates)) for item in candidates}
    return dict(sorted(refused.items())), chosen


def association_errors(rig: Rig, detections: Detections, pair: Pair) -> list[Finding]:
    """List the association error of a pair's images and scans, if there is one."""
    candidates, _ = detections.candidates(pair, rig.board.to_board())
    consensus = _consensus(rig, candidates)
    error = find_association_error(candidates, rig.board.to_board(), consensus)
    return [] if error is None else [error]


def _consensus(rig: Rig, candidates: Sequence[Observation]) -> Consensus | None:
    try:
        return find_consensus(candidates, rig.board.to_board())
    except NotEnoughDataError:
        return None


def expected_poses(rig: Rig, detections: Detections) -> Mapping[str, Mapping[str, list[Array]]]:
    """Predict the board's position in scans without it, or with it elsewhere than in the images.

    Returns:
        Possible poses T_lidar_board (4, 4) given the image, by LiDAR and capture.
    """
    expected: dict[str, dict[str, list[Array]]] = {}
    for pair in detections.pairs:
        candidates, _ = detections.candidates(pair, rig.board.to_board())
        consensus = _consensus(rig, candidates)
        n_agreeing = len(consensus.observations) if consensus else 0
        if consensus is None or n_agreeing < max(_LEAST_AGREEING, len(candidates) / 2):
            continue
        agreeing = {each.capture for each in consensus.observations}
        T_lidar_cam = invert(consensus.T_cam_lidar)
        for name in detections.captures(pair):
            image, scan = detections.of(pair, name)
            is_moved = isinstance(scan, Refusal) and scan.code == LIDAR_OTHER_ORIGIN.code
            if name not in agreeing and not isinstance(image, Refusal) and not is_moved:
                poses = [T_lidar_cam @ T_cam_board for T_cam_board in open_poses(image)]
                expected.setdefault(pair.lidar, {}).setdefault(name, poses)
    return expected
