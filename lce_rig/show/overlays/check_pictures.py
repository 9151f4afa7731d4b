"""Draw a session's check: the point cloud projected into each capture's image, and contact sheets."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from lce_rig.core.calibration import Calibration, CaptureResidual
from lce_rig.core.data import Scan
from lce_rig.core.errors import SessionError
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import Detections
from lce_rig.judge.session_check import Meeting, SessionCheck
from lce_rig.session import Capture, Session
from lce_rig.show.overlays.event_picture import ImageWithEvents
from lce_rig.show.overlays.overlay import camera_part, draw_overlay, range_limits
from lce_rig.show.overlays.overlay_files import Overlay, SheetHead, write_overlays

# Scans that choose the range scale of a session's images.
_SCANS_OF_SCALE = 8


def draw_check(
    session: Session,
    detections: Detections,
    check: SessionCheck,
    folder: Path,
    *,
    view_of: Callable[[Capture], ImageWithEvents | None],
    progress: Callable[[int, int], None],
) -> SessionCheck:
    """Project the point cloud of every capture into its image, and return the check with the images' paths.

    Args:
        session: the source of the captures.
        detections: of the session.
        check: of one channel on these captures.
        folder: receives `<capture>.png` and contact sheets.
        view_of: returns the channel's image in a capture; None if it cannot be read.
        progress: called with (done, total).

    Raises:
        SessionError: an image cannot be written.
    """
    names, lidar = detections.captures(check.pair), check.pair.lidar
    scans = []
    for name in names[:: max(1, len(names) // _SCANS_OF_SCALE)]:
        with suppress(SessionError):
            scans.append(session.capture(name).scan(lidar))
    limits_m = range_limits(scans)

    def overlays() -> Iterator[Overlay]:
        for done, name in enumerate(names, start=1):
            capture = session.capture(name)
            view = view_of(capture)
            if view is not None:
                # A capture whose scan cannot be read is not drawn.
                with suppress(SessionError):
                    image, _ = detections.of(check.pair, name)
                    yield _draw(capture, capture.scan(lidar), session, check, view, image, limits_m)
            progress(done, len(names))

    c, m = check.calibration, check.metrics
    line = (
        f"{len(names)} captures, {len(c.captures_used)} used; "
        f"uncertainty {c.sigma_rotation_deg:.2g} deg, {1000 * c.sigma_translation_m:.2g} mm (1 sigma)"
    )
    if m is not None:
        line += f"; mean over captures: {_residual_words(m.mpe_m, m.mee_m, m.reprojection_px)}"
    lines = [line, *(finding.sentence for finding in (*c.findings, *check.findings))]
    head = SheetHead(f"{session.rig.name}  {check.pair}", c.verdict, lines, limits_m)
    pictures, sheets = write_overlays(folder, overlays(), head)
    return replace(check, pictures=tuple(pictures), contact_sheets=tuple(sheets))


def _residual_words(plane_m: float, edge_m: float, corner_px: float) -> str:
    return f"planes {1000 * plane_m:.1f} mm, edges {1000 * edge_m:.1f} mm, corners {corner_px:.2f} px"


def _draw(
    capture: Capture,
    scan: Scan,
    session: Session,
    check: SessionCheck,
    view: ImageWithEvents,
    detected: object,
    limits_m: tuple[float, float],
) -> Overlay:
    """Draw one capture with the board of both sensors."""
    rig, name, calibration = session.rig, capture.name, check.calibration
    meeting = check.meetings.get(name)
    r = next((each for each in check.residuals if each.capture == name), None)
    warning = ""
    if calibration.captures_used and name not in calibration.captures_used:
        # Extrinsics of another session were fitted to none of these captures.
        refusal = calibration.captures_refused.get(name)
        warning = "not used" if refusal is None else f"refused, {refusal.stage}: {refusal.sentence}"
    image_board = detected if isinstance(detected, ImageBoard) else None
    if meeting is not None:
        # The board's points are drawn separately, moved to the image's time.
        points, on_board = (
            np.ascontiguousarray(p, dtype=np.float32) for p in (scan.points, meeting.measured.lidar.points)
        )
        row = np.dtype((np.void, points.dtype.itemsize * 3))
        scan = scan.select(~np.isin(points.view(row).ravel(), on_board.view(row).ravel()))
    picture = draw_overlay(
        view.image,
        scan,
        rig.cameras[calibration.camera].to_intrinsics(),
        calibration.T_cam_lidar,
        lidar_board=None if meeting is None else meeting.lidar_at_image_time,
        image_board=image_board if meeting is None else meeting.measured.image,
        board=rig.board.to_board(),
        residuals=_legend(name, r, meeting, calibration),
        title=f"{rig.name}  {check.pair}  {name}",
        limits_m=limits_m,
        warning=warning,
        events=view.events,
    )
    words = "" if r is None else _residual_words(r.plane_mean_m, r.edge_mean_m, r.reprojection_px)
    return Overlay(name, picture, camera_part(picture, view.image), words, warning)


def _legend(
    name: str, residual: CaptureResidual | None, meeting: Meeting | None, calibration: Calibration
) -> dict[str, float | str]:
    figures: dict[str, float | str] = {}
    if residual is not None:
        figures = {
            "planes (mm)": round(1000 * residual.plane_mean_m, 1),
            "edges (mm)": round(1000 * residual.edge_mean_m, 1),
            "corners (px)": round(residual.reprojection_px, 2),
        }
    if meeting is not None and meeting.way_m > 0:
        figures["moved (mm)"] = round(1000 * meeting.way_m, 1)
    refusal = calibration.captures_refused.get(name)
    if calibration.captures_used:
        is_used = name in calibration.captures_used
        figures["capture"] = "used" if is_used else f"refused, {refusal.stage}" if refusal else "not used"
    figures["sigma"] = (
        f"{calibration.sigma_rotation_deg:.2g} deg, {1000 * calibration.sigma_translation_m:.2g} mm"
    )
    figures["verdict"] = calibration.verdict
    return figures
