"""Find the board in every picture and scan of a session, once."""

import hashlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import ProfileError, SessionError
from lce_rig.core.results import Refusal
from lce_rig.detect.detection import Detections, ImageDetection, LidarDetection, from_arrays, to_arrays
from lce_rig.detect.gates import gate_image_board, gate_lidar_boards
from lce_rig.pipeline.progress import Progress, silent
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session


def detect(session: Session, *, progress: Progress = silent, n_threads: int = 2) -> Detections:
    """Find the board in every picture and scan of a session; what was found before is not sought again.

    Args:
        session: open for reading is enough.
        progress: called with (done, total).
        n_threads: detectors at work side by side.
    """
    digest = _detection_digest(session.rig)
    sensors = _sensors(session.captures)
    image_jobs = [(capture, *channel) for capture, channels, _ in sensors for channel in channels]
    scan_jobs = [(capture, lidar) for capture, _, names in sensors for lidar in names]
    total = len(image_jobs) + len(scan_jobs)
    images: dict[tuple[str, str], dict[str, ImageDetection]] = {}
    lidars: dict[str, dict[str, LidarDetection]] = {}
    with ThreadPoolExecutor(n_threads) as pool:
        seen = pool.map(lambda job: _image_detection(session, digest, *job), image_jobs)
        scanned = pool.map(lambda job: _scan_detection(session, digest, *job), scan_jobs)
        for done, ((capture, camera, channel), image) in enumerate(
            zip(image_jobs, seen, strict=True), start=1
        ):
            images.setdefault((camera, channel), {})[capture.name] = image
            progress(done, total)
        for done, ((capture, lidar), scan) in enumerate(
            zip(scan_jobs, scanned, strict=True), len(image_jobs) + 1
        ):
            lidars.setdefault(lidar, {})[capture.name] = scan
            progress(done, total)
    return Detections(images, lidars)


def _sensors(captures: list[Capture]) -> list[tuple[Capture, list[tuple[str, str]], list[str]]]:
    """Name the (camera, channel) pairs and the LiDARs that each capture holds samples of.

    A capture whose manifest is damaged is asked for what the others hold, so that every pair says so.
    """
    known: dict[str, tuple[list[tuple[str, str]], list[str]]] = {}
    for capture in captures:
        with suppress(SessionError):
            known[capture.name] = capture.image_keys, capture.lidars
    if captures and not known:
        captures[0].image_keys  # noqa: B018  raises what is wrong with it
    channels = sorted({channel for held, _ in known.values() for channel in held})
    lidars = sorted({lidar for _, held in known.values() for lidar in held})
    return [(capture, *known.get(capture.name, (channels, lidars))) for capture in captures]


def _image_detection(
    session: Session, digest: str, capture: Capture, camera: str, channel: str
) -> ImageDetection:
    def find() -> ImageDetection:
        try:
            return detect_image(session.rig, capture.image(camera, channel))
        except ProfileError as error:
            return Refusal("image", error.what, error.hint)

    found: ImageDetection = _remembered(session, digest, capture, f"{camera}.{channel}", find)
    return found


def _scan_detection(session: Session, digest: str, capture: Capture, lidar: str) -> LidarDetection:
    def find() -> LidarDetection:
        return detect_scan(session.rig, capture.scan(lidar))

    found: LidarDetection = _remembered(session, digest, capture, lidar, find)
    return found


def _remembered(
    session: Session,
    digest: str,
    capture: Capture,
    sensor: str,
    find: Callable[[], ImageDetection | LidarDetection],
) -> Any:
    """Look a detection up in the session's cache, or make and keep it; a damaged sample is a refusal."""
    try:
        capture.check()
        # The content is part of the key: a capture may be removed and another take its name.
        key = f"{digest}/{capture.name}-{capture.content_sha256[:12]}.{sensor}"
        cached = session.load_cached(key)
        if cached is not None:
            with suppress(ValueError):
                return from_arrays(cached.arrays)
        detection = find()
    except SessionError as error:
        return Refusal("read", error.what, error.hint or "collect this placement again")
    session.store_cached(key, to_arrays(detection), {})
    return detection


def detect_image(rig: Rig, image: Image) -> ImageDetection:
    """Find the board in one picture."""
    from lce_rig.detect.image_board import find_image_board

    found = find_image_board(
        image,
        rig.board.to_board(),
        rig.cameras[image.sensor].to_intrinsics(),
        max_reprojection_px=rig.quality.max_reprojection_px,
    )
    return found if isinstance(found, Refusal) else gate_image_board(found, rig.quality)


def detect_scan(rig: Rig, scan: Scan) -> LidarDetection:
    """Find the surfaces of the board's size in one scan, likeliest first."""
    from lce_rig.detect.lidar_board import find_lidar_boards
    from lce_rig.detect.lidar_features import Beam

    lidar, limits, board = rig.lidars[scan.sensor], rig.quality, rig.board.to_board()
    found = find_lidar_boards(
        scan,
        board,
        min_range_m=lidar.min_range_m,
        max_range_m=min(lidar.max_range_m, limits.max_distance_m),
        min_rings=limits.min_rings,
        max_rms_m=limits.max_thickness_m,
        beam=Beam(lidar.beam_aperture_m, lidar.beam_divergence_rad),
    )
    return found if isinstance(found, Refusal) else gate_lidar_boards(found, board, limits)


def _detection_digest(rig: Rig) -> str:
    """Name the cache after everything a detection depends on beside the capture: the profile and the code."""
    digest = hashlib.sha256(rig.model_dump_json(include={"board", "cameras", "lidars", "quality"}).encode())
    package = Path(__file__).parents[1]
    for folder in ("core", "detect", "solvers"):
        for source in sorted((package / folder).glob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
