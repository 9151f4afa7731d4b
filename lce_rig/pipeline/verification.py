"""Pictures and residuals: an extrinsic held against captures, and what each sensor saw."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from lce_rig.core.errors import SessionError
from lce_rig.core.results import Calibration, Refusal
from lce_rig.detect.detection import Detections, Pair
from lce_rig.detect.event_board import EventImage
from lce_rig.pipeline.detection import event_picture
from lce_rig.pipeline.event_detection import event_channels
from lce_rig.pipeline.progress import Progress, silent
from lce_rig.pipeline.result_files import OVERLAYS, keep_foreign, result_content
from lce_rig.pipeline.solving import clocks_of
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session
from lce_rig.session.session import CALIBRATION, DEBUG
from lce_rig.verify.event_picture import CameraView
from lce_rig.verify.session_check import SessionCheck, check_session
from lce_rig.verify.writing import is_overlay


def verify(
    session: Session,
    detections: Detections,
    calibrations: Sequence[Calibration],
    *,
    event_image: EventImage | None = None,
    result: bytes | None = None,
    folder: Path | None = None,
    progress: Progress = silent,
) -> list[SessionCheck]:
    """Hold extrinsics against every capture of a session, and draw the LiDAR into its pictures.

    Args:
        session: may be another one than the calibrations come from.
        detections: of this session.
        calibrations: as a rule from its result.json.
        event_image: as the detections were made.
        result: content of the session's own result.json, where the calibrations come from it.
        folder: for the images; by default the session's calibration/overlays/ where the result is its own,
            else its overlays/, which are replaced as a whole. Several pairs get a folder each.
        progress: called with (done, total) for each pair in turn.

    Returns:
        A check of each channel; of sensors of which the session has no captures there is none.

    Raises:
        SessionError: the session has no captures of any calibration's sensors; or its result was replaced
            meanwhile, and the overlays there are untouched.
    """
    jobs = [(c, pair) for c in calibrations for pair in _pairs_held(detections, c)]
    if not jobs:
        wanted = ", ".join(str(Pair.of(c)) for c in calibrations)
        raise SessionError(
            f"{session.path} holds no captures of {wanted}", "The result belongs to another session."
        )

    def check(base: Path) -> list[SessionCheck]:
        return [
            check_session(
                session,
                detections,
                c,
                pair.channel,
                base if len(jobs) == 1 else base / pair.folder_name,
                clocks=clocks_of(session.rig, pair.camera, pair.lidar),
                view_of=partial(_view, session, pair.camera, pair.channel, event_image),
                progress=progress,
            )
            for c, pair in jobs
        ]

    if folder is not None:
        return check(folder)

    def finish(earlier: Path, draft: Path) -> None:
        if result is not None and result_content(session) != result:
            raise SessionError(
                f"{session.path / CALIBRATION} was calibrated again while overlays were drawn",
                "Run `lce-rig verify` again.",
            )
        _keep_users_files(session.rig, earlier, draft)

    parts = (OVERLAYS,) if result is None else (CALIBRATION, OVERLAYS)
    with session.replacing(*parts, finish=finish) as draft:
        checks = check(draft)
    place = session.path.joinpath(*parts)
    return [each.moved(draft, place) for each in checks]


def _keep_users_files(rig: Rig, earlier: Path, draft: Path) -> None:
    """Take over what `verify` did not draw, beside its images and in its folders."""
    folders = {
        Pair(camera, channel, lidar).folder_name
        for camera, sensor in rig.cameras.items()
        for channel in sensor.channels
        for lidar in rig.lidars
    }
    keep_foreign(earlier, draft, lambda path: path.name in folders or is_overlay(path))
    for name in folders:
        if not (earlier / name).is_symlink():
            keep_foreign(earlier / name, draft / name, is_overlay)


def _pairs_held(detections: Detections, calibration: Calibration) -> list[Pair]:
    """Name those pairs behind a calibration that the session holds captures of."""
    pairs = [Pair(calibration.camera, channel, calibration.lidar) for channel in sorted(calibration.channels)]
    return [pair for pair in pairs if pair in detections.pairs]


def write_debug_images(
    session: Session,
    detections: Detections,
    *,
    event_image: EventImage | None = None,
    folder: Path | None = None,
    progress: Progress = silent,
) -> Path:
    """Draw for every capture what each sensor saw of the board, and why it was refused.

    Args:
        session: whose captures are drawn.
        detections: of the session.
        event_image: as the detections were made.
        folder: for the pictures; the session's debug/ where None.
        progress: called with (done, total).

    Returns:
        The folder of the pictures.
    """
    from lce_rig.verify.debug_image import draw_debug
    from lce_rig.verify.writing import write_picture

    base = folder or session.own(DEBUG)
    jobs = [(pair, name) for pair in detections.pairs for name in detections.captures(pair)]
    for done, (pair, name) in enumerate(jobs, start=1):
        capture, (image, lidar) = session.capture(name), detections.of(pair, name)
        view = _view(session, pair.camera, pair.channel, event_image, capture)
        try:
            scan = capture.scan(pair.lidar)
        except SessionError:
            # It is damaged, as its detection says.
            scan = None
        picture = draw_debug(
            None if view is None else view.image,
            scan,
            image,
            lidar,
            board=session.rig.board.to_board(),
            intrinsics=session.rig.cameras[pair.camera].to_intrinsics(),
            title=f"{pair}  {name}",
            events=None if view is None else view.events,
        )
        own = base if len(detections.pairs) == 1 else base / pair.folder_name
        if folder is None:
            session.own(*own.relative_to(session.path).parts)
        write_picture(own / f"{name}.png", picture)
        progress(done, len(jobs))
    return base


def _view(
    session: Session, camera: str, channel: str, event_image: EventImage | None, capture: Capture
) -> CameraView | None:
    """Give what a camera saw; None where it is damaged, or events gave no picture, as its detection says."""
    try:
        if (camera, channel) not in event_channels(session.rig, capture, event_image):
            return CameraView(capture.image(camera, channel))
        picture = event_picture(session, capture, camera, channel, event_image)
        return None if isinstance(picture, Refusal) else CameraView.of_events(picture, capture.events(camera))
    except SessionError:
        return None
