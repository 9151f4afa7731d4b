"""Files of overlays: a session's check as images with contact sheets; two LiDARs as seen from the first."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from lce_rig.calibrate.between_lidars import optical_frame
from lce_rig.core.calibration import Calibration, CaptureResidual
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.core.geometry import Array, transform
from lce_rig.core.phrasing import significant
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import Detections
from lce_rig.judge.session_check import Meeting, SessionCheck
from lce_rig.session import Capture, Session
from lce_rig.session.durable import write_atomically
from lce_rig.show.overlays import canvas
from lce_rig.show.overlays.canvas import FAINT, GREEN, INK, ORANGE, RED, Picture
from lce_rig.show.overlays.overlay import (
    ImageWithEvents,
    camera_part,
    draw_legend,
    draw_overlay,
    range_limits,
)

CONTACT_SHEET = "contact_sheet.png"
# Overlays have large even areas and thin marks: run lengths compress them as well as a search, in half the
# time.
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]

# A sheet has at most four columns, 1970 px, and is about as high as wide.
_TILE_PX, _GAP_PX, _MOST_COLUMNS, _MOST_ROWS_PX = 480, 10, 4, 1660
_TEXT_PX, _LINE_PX = 11, 22
_COLOURS = {"pass": GREEN, "marginal": ORANGE, "fail": RED}


class Overlay(NamedTuple):
    """One capture's image.

    Attributes:
        name: of the capture.
        picture: (H, W, 3) BGR with title and legend.
        part: what of it goes onto the contact sheet.
        figures: its residuals, one line.
        warning: why the capture was not used; empty if it was.
    """

    name: str
    picture: Picture
    part: Picture
    figures: str = ""
    warning: str = ""


class SheetHead(NamedTuple):
    """What stands above the images of a contact sheet.

    Attributes:
        title: rig and sensors.
        verdict: of the calibration.
        lines: its figures, then findings, which only the first sheet shows.
        limits_m: ends of the range scale of all images.
    """

    title: str
    verdict: str
    lines: Sequence[str]
    limits_m: tuple[float, float]


def contact_sheets(tiles: Sequence[Overlay], head: SheetHead) -> list[Picture]:
    """Arrange images in rows on sheets at most 2000 px wide, each with name, residuals and state below.

    Raises:
        ValueError: there are no tiles.
    """
    if not tiles:
        raise ValueError("a contact sheet needs at least one image")
    n_columns = min(_MOST_COLUMNS, max(2, math.ceil(math.sqrt(len(tiles)))))
    rows = [_row(tiles[k : k + n_columns], n_columns) for k in range(0, len(tiles), n_columns)]
    n_per_sheet = max(1, _MOST_ROWS_PX // max(row.shape[0] for row in rows))
    # Rows are spread evenly, so that the last sheet does not hold a single one.
    n_sheets = math.ceil(len(rows) / n_per_sheet)
    n_per_sheet = math.ceil(len(rows) / n_sheets)
    parts = [rows[k : k + n_per_sheet] for k in range(0, len(rows), n_per_sheet)]
    return [
        np.vstack([_head(head, rows[0].shape[1], (number, len(parts))), *part])
        for number, part in enumerate(parts, 1)
    ]


def _row(tiles: Sequence[Overlay], n_columns: int) -> Picture:
    """Draw a row of images with their captions; orange frames mark captures that were not used."""
    height_px = max(round(_TILE_PX * tile.part.shape[0] / tile.part.shape[1]) for tile in tiles)
    warnings = [canvas.wrapped(tile.warning, _TILE_PX - 8, _TEXT_PX) for tile in tiles]
    n_lines = 1 + max(map(len, warnings))
    cell_px = _TILE_PX + _GAP_PX
    row = canvas.panel(n_columns * cell_px + _GAP_PX, height_px + n_lines * _LINE_PX + 2 * _GAP_PX)
    for k, (tile, warning) in enumerate(zip(tiles, warnings, strict=True)):
        u, bottom = _GAP_PX + k * cell_px, _GAP_PX + height_px
        row[_GAP_PX:bottom, u : u + _TILE_PX] = canvas.fitted(tile.part, _TILE_PX, height_px)
        if tile.warning:
            cv2.rectangle(row, (u, _GAP_PX), (u + _TILE_PX - 1, bottom - 1), ORANGE, 6)
        canvas.draw_text(row, tile.name, u + 4, bottom + 17, _TEXT_PX, INK)
        canvas.draw_text(row, tile.figures, u + _TILE_PX - 4, bottom + 17, _TEXT_PX, INK, align=1)
        for index, line in enumerate(warning, 1):
            canvas.draw_text(row, line, u + 4, bottom + 17 + index * _LINE_PX, _TEXT_PX, ORANGE)
    return row


def _head(head: SheetHead, width_px: int, page: tuple[int, int]) -> Picture:
    """Draw title, verdict, figures, and what marks and colours mean."""
    left, right = 1.5 * _GAP_PX, width_px - 1.5 * _GAP_PX
    number, n_pages = page
    stated = head.lines if number == 1 else head.lines[:1]
    lines = [part for line in stated for part in canvas.wrapped(line, right - left, _TEXT_PX)]
    strip = canvas.panel(width_px, 44 + len(lines) * _LINE_PX + 2 * _GAP_PX)
    canvas.draw_text(strip, head.title, left, 32, 16, INK)
    pages = f"sheet {number} of {n_pages}" if n_pages > 1 else ""
    canvas.draw_text(strip, pages, right, 32, _TEXT_PX, FAINT, align=1)
    verdict_left = left + canvas.text_width_px(head.title, 16) + 24
    canvas.draw_text(strip, head.verdict.upper(), verdict_left, 32, 16, _COLOURS.get(head.verdict, INK))
    baseline = 44 + 0.7 * _LINE_PX
    for line in lines:
        canvas.draw_text(strip, line, left, baseline, _TEXT_PX, INK)
        baseline += _LINE_PX
    legend = draw_legend(min(width_px, 1000), head.limits_m, {"orange frame": "not used"})
    marks = canvas.panel(width_px, legend.shape[0])
    marks[:, : legend.shape[1]] = legend
    return np.vstack([strip, marks])


def write_overlays(
    folder: Path, overlays: Iterable[Overlay], head: SheetHead
) -> tuple[list[Path], list[Path]]:
    """Write one PNG per named image and contact sheets of them all.

    Images are taken one at a time and only small copies are kept, so that a long session needs little memory.

    Args:
        folder: created if it does not exist.
        overlays: in the order of the sheets.
        head: above each sheet's images.

    Returns:
        The images; and the sheets, contact_sheet.png or contact_sheet_1.png and so on; none without images.

    Raises:
        SessionError: a file cannot be written.
    """
    files: list[Path] = []
    tiles: list[Overlay] = []
    for overlay in overlays:
        files.append(write_picture(folder / f"{overlay.name}.png", overlay.picture))
        part = overlay.part
        small = canvas.fitted(part, _TILE_PX, round(part.shape[0] * _TILE_PX / part.shape[1]))
        tiles.append(overlay._replace(picture=small, part=small))
    sheets = contact_sheets(tiles, head) if tiles else []
    stem, suffix = CONTACT_SHEET.split(".")
    names = (
        [f"{stem}_{k}.{suffix}" for k in range(1, len(sheets) + 1)] if len(sheets) > 1 else [CONTACT_SHEET]
    )
    written = [write_picture(folder / name, sheet) for name, sheet in zip(names, sheets, strict=False)]
    return files, written


def is_overlay(path: Path) -> bool:
    """Return whether a file has a name that `write_overlays` gives to a session's captures."""
    return re.fullmatch(r"([0-9]{6,}|contact_sheet(_[0-9]+)?)\.png", path.name) is not None


def write_picture(path: Path, picture: Picture) -> Path:
    """Write one PNG in one step.

    Raises:
        SessionError: the file cannot be written.
    """
    is_encoded, data = cv2.imencode(".png", picture, _PNG)
    if not is_encoded:
        raise SessionError(f"{path}: an image of shape {picture.shape} cannot be written as PNG")
    write_atomically(path, np.asarray(data).tobytes())
    return path


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
        f"uncertainty {significant(c.sigma_rotation_deg)} deg, "
        f"{significant(1000 * c.sigma_translation_m)} mm (1 sigma)"
    )
    if m is not None:
        line += f"; mean over captures: {_residual_words(m.mpe_m, m.mee_m, m.reprojection_px)}"
    lines = [line, *(finding.sentence for finding in (*c.findings, *check.findings))]
    head = SheetHead(f"{session.rig.name}  {check.pair}", c.verdict, lines, limits_m)
    pictures, sheets = write_overlays(folder, overlays(), head)
    return replace(check, pictures=tuple(pictures), contact_sheets=tuple(sheets))


def _residual_words(plane_m: float, edge_m: float, corner_px: float) -> str:
    words = f"planes {1000 * plane_m:.1f} mm, edges {1000 * edge_m:.1f} mm"
    return words if math.isnan(corner_px) else f"{words}, corners {corner_px:.2f} px"


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
        rig.lens_of(calibration),
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
) -> dict[str, str]:
    figures: dict[str, str] = {}
    if residual is not None:
        figures = {
            "planes": f"{1000 * residual.plane_mean_m:.1f} mm",
            "edges": f"{1000 * residual.edge_mean_m:.1f} mm",
        }
        if math.isfinite(residual.reprojection_px):
            figures["corners"] = f"{residual.reprojection_px:.2f} px"
    if meeting is not None and meeting.way_m > 0:
        figures["moved"] = f"{1000 * meeting.way_m:.1f} mm"
    refusal = calibration.captures_refused.get(name)
    if calibration.captures_used:
        is_used = name in calibration.captures_used
        figures["capture"] = "used" if is_used else f"refused, {refusal.stage}" if refusal else "not used"
    figures["sigma"] = (
        f"{significant(calibration.sigma_rotation_deg)} deg, "
        f"{significant(1000 * calibration.sigma_translation_m)} mm"
    )
    figures["verdict"] = calibration.verdict
    return figures


_WINDOW = Intrinsics(640.0, 640.0, 639.5, 359.5, 1280, 720)


def seen_through_window(check: SessionCheck) -> tuple[SessionCheck, Array]:
    """Put a camera in the first LiDAR's place that looks at the boards.

    Args:
        check: of two LiDARs.

    Returns:
        The same as of that camera, and T_camera_first (4, 4).
    """
    middles = [meeting.measured.image.T_cam_board[:3, 3] for meeting in check.meetings.values()]
    T_view = optical_frame(np.array(middles).reshape(-1, 3))
    c = check.calibration
    seen: Calibration = replace(c, T_cam_lidar=T_view @ c.T_cam_lidar, intrinsics=_WINDOW)
    meetings = {}
    for name, meeting in check.meetings.items():
        image = meeting.measured.image
        moved = replace(image, T_cam_board=T_view @ image.T_cam_board)
        meetings[name] = replace(meeting, measured=replace(meeting.measured, image=moved))
    return replace(check, calibration=seen, meetings=meetings), T_view


def draw_cloud(scan: Scan, T_view: Array) -> Image:
    """Draw the first LiDAR's cloud in grey, as the camera in its place would see it.

    Args:
        scan: of the first LiDAR.
        T_view: (4, 4) from its frame to the camera's.
    """
    points = transform(T_view, scan.points[np.isfinite(scan.points).all(axis=1)])
    pixels, is_valid = _WINDOW.project(points)
    is_seen = is_valid & (points[:, 2] > 0) & _WINDOW.is_inside(pixels, -0.5)
    picture = canvas.panel(_WINDOW.width_px, _WINDOW.height_px)
    canvas.draw_discs(picture, pixels[is_seen], FAINT, 1.6)
    return Image(scan.sensor, "", scan.stamp_ns, picture)
