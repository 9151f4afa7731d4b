"""The story in order: captures -> detections -> extrinsics -> files and pictures. Start reading here.

Every step takes a session and what the step before it made. Results are frozen dataclasses; only the
session and the export layer touch files.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from lce_rig.calibrate import CalibrateOptions, CalibrationEstimate, CaptureCandidates
from lce_rig.calibrate import calibrate as estimate_extrinsic
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.metrics import error_to_reference
from lce_rig.calibrate.verdict import judge
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import NotEnoughDataError, SessionError
from lce_rig.core.geometry import Array
from lce_rig.core.results import Calibration, Refusal
from lce_rig.detect.detection import (
    Detections,
    ImageDetection,
    LidarDetection,
    Pair,
    from_arrays,
    to_arrays,
)
from lce_rig.detect.gates import gate_image_board, gate_lidar_boards
from lce_rig.export.reference import Reference
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session
from lce_rig.verify.session_check import SessionCheck, check_session

Progress = Callable[[int, int], None]
Sample = TypeVar("Sample", Image, Scan)
CALIBRATION, OVERLAYS, DEBUG = "calibration", "overlays", "debug"


def _silent(done: int, total: int) -> None:
    pass


def detect(session: Session, *, progress: Progress = _silent, n_threads: int = 2) -> Detections:
    """Find the board in every picture and scan of a session; what was found before is not sought again.

    Args:
        session: open for reading is enough.
        progress: called with (done, total).
        n_threads: detectors at work side by side.
    """
    digest = _detection_digest(session.rig)
    jobs = [(capture, sensor) for capture in session.captures for sensor in _sensors(session.rig, capture)]
    images: dict[tuple[str, str], dict[str, ImageDetection]] = {}
    lidars: dict[str, dict[str, LidarDetection]] = {}
    with ThreadPoolExecutor(n_threads) as pool:
        found = pool.map(lambda job: _detect_one(session, *job, digest), jobs)
        for done, ((capture, sensor), detection) in enumerate(zip(jobs, found, strict=True), start=1):
            if isinstance(sensor, tuple):
                images.setdefault(sensor, {})[capture.name] = detection  # type: ignore[assignment]
            else:
                lidars.setdefault(sensor, {})[capture.name] = detection  # type: ignore[assignment]
            progress(done, len(jobs))
    return Detections(images, lidars)


def _sensors(rig: Rig, capture: Capture) -> list[tuple[str, str] | str]:
    """Name the sensors a capture holds samples of: (camera, channel) pairs and LiDARs."""
    try:
        return [*capture.image_keys, *capture.lidars]
    except SessionError:
        # Its manifest is damaged: every sensor is asked, so that every pair says so.
        channels = [(name, channel) for name, camera in rig.cameras.items() for channel in camera.channels]
        return [*sorted(channels), *sorted(rig.lidars)]


def _detect_one(
    session: Session, capture: Capture, sensor: tuple[str, str] | str, digest: str
) -> ImageDetection | LidarDetection:
    name = ".".join(sensor) if isinstance(sensor, tuple) else sensor
    try:
        # The content is part of the key: a capture may be removed and another take its name.
        key = f"{digest}/{capture.name}-{capture.content_sha256[:12]}.{name}"
        cached = session.load_cached(key)
        if cached is not None:
            with suppress(ValueError):
                return from_arrays(cached.arrays)
        if isinstance(sensor, tuple):
            detection: ImageDetection | LidarDetection = detect_image(session.rig, capture.image(*sensor))
        else:
            detection = detect_scan(session.rig, capture.scan(sensor))
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
    package = Path(__file__).parent
    for folder in ("core", "detect", "solvers"):
        for source in sorted((package / folder).glob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:12]


def calibrate(
    rig: Rig,
    detections: Detections,
    options: CalibrateOptions,
    *,
    reference: Reference | None = None,
    progress: Progress = _silent,
) -> list[tuple[Calibration, CalibrationEstimate]]:
    """Estimate and judge the extrinsic of every camera channel with every LiDAR.

    Args:
        rig: thresholds, targets and nominal extrinsics.
        detections: of one session.
        options: switches of the algorithm.
        reference: extrinsics to report errors against; they never enter the estimate or the verdict.
        progress: called with (done, total) for each pair in turn.

    Raises:
        NotEnoughDataError: a pair has too few captures, or a direction stays open; the causes are named.
    """
    results = []
    for pair in detections.pairs:
        candidates, refused = _candidates(detections, pair)
        needed = rig.quality.min_captures
        if len(candidates) < needed:
            raise NotEnoughDataError(
                f"{pair}: the board was found by both sensors in {len(candidates)} of "
                f"{len(candidates) + len(refused)} captures, at least {needed} are needed",
                _commonest(refused) or "collect more captures",
            )
        estimate = estimate_extrinsic(candidates, rig.board.to_board(), options, progress)
        calibration = _judged(rig, pair, estimate, n_captures=len(candidates) + len(refused), refused=refused)
        truth = reference.of(pair.camera, pair.lidar) if reference else None
        if truth is not None:
            calibration = compare_with_reference(calibration, truth)
        results.append((calibration, estimate))
    return results


def compare_with_reference(calibration: Calibration, reference: Array) -> Calibration:
    """Report the error against a T_cam_lidar (4, 4) that somebody else vouches for."""
    rotation_deg, translation_m = error_to_reference(calibration.T_cam_lidar, reference)
    return replace(calibration, egt_rotation_deg=rotation_deg, egt_translation_m=translation_m)


def _candidates(detections: Detections, pair: Pair) -> tuple[list[CaptureCandidates], dict[str, Refusal]]:
    candidates, refused = [], {}
    for name in detections.captures(pair):
        image, lidar = detections.of(pair, name)
        if isinstance(image, Refusal):
            refused[name] = image
        elif isinstance(lidar, Refusal):
            refused[name] = lidar
        else:
            candidates.append(CaptureCandidates(name, image, lidar))
    return candidates, refused


def refusals(rig: Rig, detections: Detections, pair: Pair) -> dict[str, Refusal]:
    """Say why captures of a pair cannot be used: a sensor saw no board, or both sensors disagree."""
    candidates, refused = _candidates(detections, pair)
    consensus = find_consensus(candidates, rig.board.to_board()) if len(candidates) >= 3 else None
    return dict(sorted({**refused, **(consensus.refused if consensus else {})}.items()))


def _commonest(refused: dict[str, Refusal]) -> str:
    """List the commonest causes of refusal, one a line."""
    counts = Counter((why.stage, why.cause, why.action) for why in refused.values())
    return "\n".join(
        f"{n} x {stage}: {cause}: {action}" for (stage, cause, action), n in counts.most_common(3)
    )


def _judged(
    rig: Rig, pair: Pair, estimate: CalibrationEstimate, *, n_captures: int, refused: dict[str, Refusal]
) -> Calibration:
    verdict, reasons = judge(estimate, rig, pair.camera, pair.lidar)
    return Calibration(
        camera=pair.camera,
        channel=pair.channel,
        lidar=pair.lidar,
        T_cam_lidar=estimate.T_cam_lidar,
        cov=estimate.cov,
        certificate=estimate.certificate,
        metrics=estimate.metrics,
        n_captures=n_captures,
        n_detected=n_captures - len(refused),
        captures_used=estimate.used,
        captures_refused=dict(sorted({**refused, **estimate.refused}.items())),
        verdict=verdict,
        reasons=reasons,
        diagnostics=estimate.diagnostics,
    )


def write_results(session: Session, calibrations: list[Calibration], *, force: bool) -> list[Path]:
    """Write result.json and, unless a verdict forbids it, every export beside it.

    Returns:
        The files written, result.json first.
    """
    from lce_rig.export import remove_exports, write_exports
    from lce_rig.export.result import write_result

    folder = session.path / CALIBRATION
    folder.mkdir(exist_ok=True)
    result = folder / "result.json"
    write_result(result, session.rig.name, calibrations)
    if any(c.verdict == "fail" for c in calibrations) and not force:
        remove_exports(folder)
        return [result]
    return [result, *write_exports(calibrations, session.rig, folder, is_forced=force)]


def verify(
    session: Session,
    detections: Detections,
    calibrations: Sequence[Calibration],
    *,
    folder: Path | None = None,
    progress: Progress = _silent,
) -> list[SessionCheck]:
    """Hold extrinsics against every capture of a session, and draw the LiDAR into its pictures.

    Args:
        session: may be another one than the calibrations come from.
        detections: of this session.
        calibrations: as a rule from its result.json.
        folder: for the pictures; the session's calibration/overlays/ where None. Several pairs get a
            folder each.
        progress: called with (done, total) for each pair in turn.
    """
    base = folder or session.path / CALIBRATION / OVERLAYS
    checks = []
    for c in calibrations:
        own = base if len(calibrations) == 1 else base / f"{c.camera}.{c.channel}.{c.lidar}"
        checks.append(check_session(session, detections, c, own, progress))
    return checks


def write_debug_images(
    session: Session, detections: Detections, *, folder: Path | None = None, progress: Progress = _silent
) -> Path:
    """Draw for every capture what each sensor saw of the board, and why it was refused.

    Returns:
        The folder of the pictures; the session's debug/ by default.
    """
    from lce_rig.verify.debug_image import draw_debug
    from lce_rig.verify.writing import write_picture

    base = folder or session.path / DEBUG
    jobs = [(pair, name) for pair in detections.pairs for name in detections.captures(pair)]
    for done, (pair, name) in enumerate(jobs, start=1):
        capture, (image, lidar) = session.capture(name), detections.of(pair, name)
        picture = draw_debug(
            _readable(capture.image, pair.camera, pair.channel),
            _readable(capture.scan, pair.lidar),
            image,
            lidar,
            board=session.rig.board.to_board(),
            intrinsics=session.rig.cameras[pair.camera].to_intrinsics(),
            title=f"{pair}  {name}",
        )
        own = base if len(detections.pairs) == 1 else base / f"{pair.camera}.{pair.channel}.{pair.lidar}"
        write_picture(own / f"{name}.png", picture)
        progress(done, len(jobs))
    return base


def _readable(read: Callable[..., Sample], *sensor: str) -> Sample | None:
    """Read a sample; None where it is damaged, as its detection says."""
    try:
        return read(*sensor)
    except SessionError:
        return None
