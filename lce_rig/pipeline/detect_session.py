"""Find the board in every picture, every scan and all raw events of a session, once."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.data import Image
from lce_rig.core.errors import ProfileError, SessionError
from lce_rig.core.results import ImageBoard, Refusal
from lce_rig.detect.detection import Detections, ImageDetection, LidarDetection, from_arrays, to_arrays
from lce_rig.detect.events.search import EventImage, EventSighting, find_event_board, reconstructor_for
from lce_rig.detect.finder import BoardFinder
from lce_rig.rig import ReconstructionSettings, Rig
from lce_rig.session import Capture, Session, check_capture

Key = tuple[str, str]
Progress = Callable[[int, int], None]
"""Called with (done, total)."""


def silent(done: int, total: int) -> None:
    """Report no progress."""


def detect(
    session: Session,
    *,
    event_image: EventImage | None = None,
    progress: Progress = silent,
    n_threads: int = 2,
) -> Detections:
    """Find the board in all samples of a session; what was found before is not sought again.

    A capture's raw events are seen through pictures made for the time at which the LiDAR saw the board.

    Args:
        session: open for reading is enough.
        event_image: how pictures are made of raw events; None as the profile says.
        progress: called with (done, total).
        n_threads: detectors at work side by side.

    Raises:
        ProfileError: a network that the profile names cannot be used.
    """
    finder = _Finder(session, event_image)
    held = finder.held(session.captures)
    scan_jobs = [(each.capture, lidar) for each in held for lidar in each.lidars]
    image_jobs = [(each.capture, camera, channel) for each in held for camera, channel in each.images]
    event_jobs = [(each.capture, camera, channel) for each in held for camera, channel in each.events]
    total = len(scan_jobs) + len(image_jobs) + len(event_jobs)
    images: dict[Key, dict[str, ImageDetection]] = {}
    lidars: dict[str, dict[str, LidarDetection]] = {}
    with ThreadPoolExecutor(n_threads) as pool:
        scanned = pool.map(lambda job: finder.scan(*job), scan_jobs)
        for (capture, lidar), scan in _counted(scan_jobs, scanned, progress, 0, total):
            lidars.setdefault(lidar, {})[capture.name] = scan
        # What the LiDAR saw says when pictures of events are wanted.
        pictured = pool.map(lambda job: finder.image(*job), image_jobs)
        developed = pool.map(lambda job: finder.events(*job, scans=_in_capture(lidars, job[0])), event_jobs)
        for jobs, seen, n_before in (
            (image_jobs, pictured, len(scan_jobs)),
            (event_jobs, developed, len(scan_jobs) + len(image_jobs)),
        ):
            for (capture, camera, channel), image in _counted(jobs, seen, progress, n_before, total):
                images.setdefault((camera, channel), {})[capture.name] = image
    return Detections(images, lidars)


def event_picture(
    session: Session, capture: Capture, camera: str, channel: str, event_image: EventImage | None = None
) -> Image | Refusal:
    """Give the picture through which a capture's raw events were seen, or why there is none.

    Args:
        session: open for reading is enough.
        capture: holds events of the camera.
        camera, channel: whose picture it is.
        event_image: as in `detect`.
    """
    finder = _Finder(session, event_image)
    scans = {lidar: finder.scan(capture, lidar) for lidar in capture.lidars}
    return finder.picture(capture, camera, channel, scans=scans)


def _in_capture(
    lidars: Mapping[str, Mapping[str, LidarDetection]], capture: Capture
) -> dict[str, LidarDetection]:
    return {lidar: found[capture.name] for lidar, found in lidars.items() if capture.name in found}


def _counted(
    jobs: list[Any], results: Iterable[Any], progress: Progress, n_before: int, total: int
) -> Iterator[tuple[Any, Any]]:
    for done, job_and_result in enumerate(zip(jobs, results, strict=True), start=n_before + 1):
        yield job_and_result
        progress(done, total)


@dataclass(frozen=True)
class _Held:
    """What a capture holds: pictures and raw events by (camera, channel), and scans by LiDAR."""

    capture: Capture
    images: list[Key]
    events: list[Key]
    lidars: list[str]


class _Finder:
    """Finds boards, and remembers them in the session's cache."""

    def __init__(self, session: Session, event_image: EventImage | None) -> None:
        self._session = session
        self._event_image = event_image
        self._boards = BoardFinder(session.rig)
        self._digest = detection_digest(session.rig)
        self._event_digests: dict[Key, str] = {}

    def held(self, captures: list[Capture]) -> list[_Held]:
        """List what each capture holds.

        A capture whose manifest is damaged, or names sensors that the rig lacks, is asked for what the others
        hold, so that every pair says so.
        """
        known: dict[str, _Held] = {}
        for capture in captures:
            with suppress(SessionError):
                made_here = event_channels(self._session.rig, capture, self._event_image)
                stored = [key for key in capture.image_keys if key not in made_here]
                known[capture.name] = _Held(capture, stored, made_here, capture.lidars)
        if captures and not known:
            check_capture(self._session.rig, captures[0])  # raises what is wrong with it
        every = list(known.values())
        images = sorted({key for each in every for key in each.images})
        events = sorted({key for each in every for key in each.events} - set(images))
        lidars = sorted({lidar for each in every for lidar in each.lidars})
        return [known.get(capture.name, _Held(capture, images, events, lidars)) for capture in captures]

    def image(self, capture: Capture, camera: str, channel: str) -> ImageDetection:
        """Find the board in a picture that the capture holds."""

        def find() -> ImageDetection:
            try:
                return self._boards.image(capture.image(camera, channel))
            except ProfileError as error:
                return Refusal.of_error("image", error)

        found: ImageDetection = self._remembered(
            self._digest, capture, f"{camera}.{channel}", ImageBoard, find
        )
        return found

    def scan(self, capture: Capture, lidar: str) -> LidarDetection:
        """Find the surfaces of the board's size in a scan."""

        def find() -> LidarDetection:
            return self._boards.scan(capture.scan(lidar))

        found: LidarDetection = self._remembered(self._digest, capture, lidar, list, find)
        return found

    def events(
        self, capture: Capture, camera: str, channel: str, *, scans: Mapping[str, LidarDetection]
    ) -> ImageDetection:
        """Find the board in raw events, and keep the picture it was found in."""
        digest = self._event_digest(camera, channel)

        def find() -> ImageDetection:
            seen = see_events(self._session, capture, camera, channel, scans, self._event_image)
            self._keep(_cache_key(digest, capture, f"{camera}.{channel}.picture"), seen.picture)
            return seen.board

        found: ImageDetection = self._remembered(digest, capture, f"{camera}.{channel}", ImageBoard, find)
        return found

    def picture(
        self, capture: Capture, camera: str, channel: str, *, scans: Mapping[str, LidarDetection]
    ) -> Image | Refusal:
        """Give the picture that raw events were seen through."""

        def find() -> Image | Refusal:
            seen = see_events(self._session, capture, camera, channel, scans, self._event_image)
            return seen.picture

        digest = self._event_digest(camera, channel)
        found: Image | Refusal = self._remembered(digest, capture, f"{camera}.{channel}.picture", Image, find)
        return found

    def _event_digest(self, camera: str, channel: str) -> str:
        if (camera, channel) not in self._event_digests:
            self._event_digests[camera, channel] = event_digest(
                self._session, camera, channel, self._event_image, self._digest
            )
        return self._event_digests[camera, channel]

    def _remembered(
        self,
        digest: str,
        capture: Capture,
        sensor: str,
        kind: type,
        find: Callable[[], ImageDetection | LidarDetection | Image],
    ) -> Any:
        """Look a detection up in the session's cache, or make and keep it; a damaged sample is a refusal."""
        try:
            check_capture(self._session.rig, capture)
            capture.check()
            key = _cache_key(digest, capture, sensor)
            cached = self._session.load_cached(key)
            if cached is not None:
                with suppress(ValueError):
                    return self._require(from_arrays(cached.arrays), kind)
            detection = find()
        except SessionError as error:
            return Refusal.of_error("read", error)
        self._keep(key, detection)
        return detection

    def _require(self, detection: Any, kind: type) -> Any:
        """Refuse what is kept of another kind of sample, or of another board, by a ValueError."""
        if not isinstance(detection, (kind, Refusal)):
            raise ValueError(f"not a detection of kind {kind.__name__}")
        board = self._session.rig.board.to_board()
        if isinstance(detection, ImageBoard) and len(detection.corners_px) != board.cols * board.rows:
            raise ValueError("a detection of another board")
        return detection

    def _keep(self, key: str, detection: ImageDetection | LidarDetection | Image) -> None:
        self._session.store_cached(key, to_arrays(detection), {})


def _cache_key(digest: str, capture: Capture, sensor: str) -> str:
    # Samples and stamps are part of the key: a capture may be removed and another take its name.
    return f"{digest}/{capture.name}-{capture.manifest_sha256[:12]}.{sensor}"


def detection_digest(rig: Rig) -> str:
    """Name by 12 digits what a detection depends on beside the capture: the profile and the code."""
    digest = hashlib.sha256(rig.model_dump_json(include={"board", "cameras", "lidars", "quality"}).encode())
    package = Path(__file__).parents[1]
    sources = [
        source for folder in ("core", "detect", "solvers") for source in (package / folder).rglob("*.py")
    ]
    for source in sorted([*sources, Path(__file__)]):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]


def event_channels(rig: Rig, capture: Capture, event_image: EventImage | None) -> list[tuple[str, str]]:
    """List the (camera, channel) that are seen through pictures made here, of raw events.

    A picture that a capture holds already, made by others, is taken in place of one made here, unless a way
    of making it is asked for.

    Raises:
        SessionError: the capture is damaged, or names sensors that the rig lacks.
    """
    check_capture(rig, capture)
    return [
        (camera, name)
        for camera in capture.event_cameras
        for name, channel in rig.cameras[camera].channels.items()
        if channel.kind == "events" and (event_image is not None or not capture.has_image(camera, name))
    ]


def see_events(
    session: Session,
    capture: Capture,
    camera: str,
    channel: str,
    lidars: Mapping[str, LidarDetection],
    event_image: EventImage | None,
) -> EventSighting:
    """Make a picture of a capture's events for the time at which the LiDAR saw the board, and find it there.

    Args:
        session: whose profile says how.
        capture: holds the camera's events.
        camera, channel: whose picture it is.
        lidars: what was seen in the capture's scans, by LiDAR.
        event_image: in place of the profile's method.

    Raises:
        ProfileError: the network cannot be used; with file and key.
        SessionError: the capture is damaged.
    """
    rig, events = session.rig, capture.events(camera)
    stamp_ns = picture_stamp_ns(rig, capture, camera, channel, lidars)
    if stamp_ns is None:
        stamp_ns = int(events.t_ns[-1]) if len(events) else 0
    settings = rig.cameras[camera].channels[channel].reconstruction
    try:
        return find_event_board(
            events,
            stamp_ns,
            reconstructor_for(settings, channel, event_image),
            rig.board.to_board(),
            rig.cameras[camera].to_intrinsics(),
            rig.quality,
            sweep_s=_sweep_s(rig, lidars),
        )
    except ProfileError as error:
        raise _in_profile(_profile_of(session), camera, channel, error) from error


def picture_stamp_ns(
    rig: Rig, capture: Capture, camera: str, channel: str, lidars: Mapping[str, LidarDetection]
) -> int | None:
    """Say when a LiDAR saw the board, on a channel's own clock; None where no scan carries a stamp.

    Of several LiDARs the first in the profile counts that found the board; where none did, or points carry no
    times, the middle of the sweep.
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


def event_digest(
    session: Session, camera: str, channel: str, event_image: EventImage | None, base: str
) -> str:
    """Name the cache after everything that pictures of events depend on beside the capture.

    Args:
        session: whose profile says how pictures are made.
        camera, channel: whose pictures they are.
        event_image: in place of the profile's method.
        base: what all detections depend on.

    Raises:
        ProfileError: the network's file cannot be read; with file and key.
    """
    from lce_rig.detect.events.reconstruct import model_bytes

    settings = session.rig.cameras[camera].channels[channel].reconstruction or ReconstructionSettings()
    settings = settings.model_copy(update={"method": event_image or settings.method})
    digest = hashlib.sha256(f"{base} {settings.model_dump_json()}".encode())
    if settings.method == "network":
        try:
            digest.update(model_bytes(None if settings.model is None else Path(settings.model)))
        except ProfileError as error:
            raise _in_profile(_profile_of(session), camera, channel, error) from error
    return digest.hexdigest()[:12]


def check_networks(rig: Rig, source: str) -> None:
    """Make sure that every network that a profile names can be used.

    Args:
        rig: the profile.
        source: its file, for errors.

    Raises:
        ProfileError: one cannot; with file and key.
    """
    for camera, settings in rig.cameras.items():
        for channel, stream in settings.channels.items():
            if stream.reconstruction is not None and stream.reconstruction.model is not None:
                try:
                    reconstructor_for(stream.reconstruction, channel)
                except ProfileError as error:
                    raise _in_profile(source, camera, channel, error) from error


def _sweep_s(rig: Rig, lidars: Mapping[str, LidarDetection]) -> float | None:
    """Measure how long the LiDAR saw the board; None where it did not."""
    from lce_rig.detect.events.figures import sweep_time_s

    for name, found in lidars.items():
        if isinstance(found, list) and found:
            return sweep_time_s(found[0], 1 / rig.lidars[name].rate_hz)
    return None


def _in_profile(source: str, camera: str, channel: str, error: ProfileError) -> ProfileError:
    """Name the file and the key that an error about a network comes from."""
    key = f"cameras.{camera}.channels.{channel}.reconstruction.model"
    return ProfileError(f"{source}: {key}: {error.what}", error.hint)


def _profile_of(session: Session) -> str:
    return str(session.path / "rig.yaml")
