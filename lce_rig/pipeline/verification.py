"""Pictures and residuals: an extrinsic held against captures, and what each sensor saw."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.core.results import Calibration
from lce_rig.detect.detection import Detections, Pair
from lce_rig.pipeline.calibration import CALIBRATION, OVERLAYS
from lce_rig.pipeline.progress import Progress, silent
from lce_rig.session import Session
from lce_rig.verify.session_check import SessionCheck, check_session

DEBUG = "debug"
Sample = TypeVar("Sample", Image, Scan)


def verify(
    session: Session,
    detections: Detections,
    calibrations: Sequence[Calibration],
    *,
    folder: Path | None = None,
    progress: Progress = silent,
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
        own = base if len(calibrations) == 1 else base / Pair.of(c).folder_name
        checks.append(check_session(session, detections, c, own, progress))
    return checks


def write_debug_images(
    session: Session, detections: Detections, *, folder: Path | None = None, progress: Progress = silent
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
        own = base if len(detections.pairs) == 1 else base / pair.folder_name
        write_picture(own / f"{name}.png", picture)
        progress(done, len(jobs))
    return base


def _readable(read: Callable[..., Sample], *sensor: str) -> Sample | None:
    """Read a sample; None where it is damaged, as its detection says."""
    try:
        return read(*sensor)
    except SessionError:
        return None
