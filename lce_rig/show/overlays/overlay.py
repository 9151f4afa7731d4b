"""The point cloud or its edges projected into the camera's image, and a page of all captures of a session."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.calibrate.between_lidars import optical_frame
from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.core.geometry import Array, transform
from lce_rig.core.phrasing import sizes
from lce_rig.core.results import BoardPose, BoardSurface, ImageBoard, LidarBoard
from lce_rig.detect.detection import Detections
from lce_rig.detect.events.figures import outline_px
from lce_rig.judge.findings import causes_of
from lce_rig.judge.session_check import SessionCheck
from lce_rig.scene.outlines import Outlines
from lce_rig.session import Capture, Session
from lce_rig.session.durable import write_atomically
from lce_rig.show.overlays import canvas
from lce_rig.show.overlays.canvas import BLACK, FAINT, MAGENTA, ORANGE, RED, WHITE, Picture
from lce_rig.show.page import render

PAGE = "index.html"
_WIDTH_IN = 16
_TITLE_IN, _WIDE, _MANY = 0.3, 2.0, 600  # Height of a title; ratio of a wide image; edges drawn small.
# Points of a dense scan become smaller, so that the image remains visible between them.
_MOST_COVERED = 0.15
# Number of scans that determine the range scale of a session's images.
_SCANS_OF_SCALE = 8
_GROUND = (38, 34, 32)
_WINDOW = Intrinsics(640, 640, (1280 - 1) / 2, (720 - 1) / 2, 1280, 720)


def draw_overlay(
    image: Image,
    scan: Scan,
    intrinsics: Intrinsics,
    T_cam_lidar: Array,
    *,
    lidar_board: BoardSurface | None,
    image_board: BoardPose | None,
    board: Board,
    limits_m: tuple[float, float] | None = None,
) -> Picture:
    """Project a whole scan, coloured by range, into the image, and draw both sensors' detections.

    Points behind the image plane, and those that the distortion polynomial would fold back into the image,
    are not drawn; near points are drawn last.

    Args:
        image: the image; small ones are enlarged to at least 960 px wide.
        scan: points in frame lidar.
        intrinsics: the camera.
        T_cam_lidar: (4, 4) the extrinsics to judge.
        lidar_board: board in the scan, to mark its points and ring ends; None for the scan only.
        image_board: board in the image, to draw its outline and corners; None for none.
        board: the board, for its outline.
        limits_m: ends of the range scale; those of the scan if None.

    Returns:
        (H, W, 3) uint8 BGR.
    """
    picture, factor = canvas.enlarged(image.pixels)
    unit = picture.shape[1] / 1000
    _draw_scan(picture, factor, scan, intrinsics, T_cam_lidar, limits_m or range_limits([scan]), 1.6 * unit)
    if image_board is not None:
        draw_image_board(picture, factor, image_board, board, intrinsics)
    if lidar_board is not None:
        on_board = _to_picture(lidar_board.points, T_cam_lidar, intrinsics, factor)[0]
        canvas.draw_discs(picture, on_board, MAGENTA, 1.9 * unit, WHITE)
    if isinstance(lidar_board, LidarBoard):
        ends = _to_picture(lidar_board.edge_points, T_cam_lidar, intrinsics, factor)[0]
        canvas.draw_diamonds(picture, ends, ORANGE, 4.2 * unit)
    return picture


def draw_projection(
    image: Image, scan: Scan, intrinsics: Intrinsics, T_cam_lidar: Array, limits_m: tuple[float, float]
) -> Picture:
    """Project a whole scan, coloured by range, into the image at its own size, without title and legend."""
    picture = np.array(
        image.pixels if image.pixels.ndim == 3 else np.repeat(image.pixels[..., None], 3, axis=2)
    )
    _draw_scan(picture, 1, scan, intrinsics, T_cam_lidar, limits_m, max(1.0, 1.6e-3 * picture.shape[1]))
    return picture


def draw_edges(
    image: Image, edges: Outlines, intrinsics: Intrinsics, poses: Mapping[str, Array], title: str
) -> Picture:
    """Draw a scan's edges into the image under several extrinsics, side by side; wide images are stacked.

    Args:
        image: image of the capture.
        edges: edges of its scan.
        intrinsics: intrinsics of the camera.
        poses: T_cam_lidar (4, 4) by name.
        title: one line.

    Returns:
        BGR (H, W, 3).
    """
    from matplotlib.figure import Figure

    height_px, width_px = image.pixels.shape[:2]
    n_rows, n_columns = (len(poses), 1) if width_px > _WIDE * height_px else (1, len(poses))
    height_in = _WIDTH_IN / n_columns * height_px / width_px
    figure: Any = Figure(figsize=(_WIDTH_IN, n_rows * (height_in + _TITLE_IN)), dpi=100)
    panes = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    top, gap = height_in / (height_in + _TITLE_IN), _TITLE_IN / height_in
    figure.subplots_adjust(0, 0, 1, 1 - (1 - top) / n_rows, wspace=0.01, hspace=gap)
    size, rim = (4.0, 1.0) if len(edges) < _MANY else (3.0, 0.2)
    for axes, (name, T_cam_lidar) in zip(panes, poses.items(), strict=True):
        canvas.show_image(axes, image.pixels)
        pixels, _ = intrinsics.project(transform(T_cam_lidar, edges.points))
        axes.plot(
            *pixels[intrinsics.is_inside(pixels)].T,
            "o",
            color="magenta",
            markersize=size,
            mec="black",
            mew=rim,
        )
        axes.set_axis_off()
        axes.set_title(f"{title}  {name}", loc="left")
    return canvas.rendered(figure)


def range_limits(scans: Sequence[Scan]) -> tuple[float, float]:
    """Choose the ends of the range scale in m: the nearest point and the 95th percentile, at most 20 m."""
    ranges_m = np.concatenate([np.zeros(0), *(np.linalg.norm(scan.points, axis=1) for scan in scans)])
    if not len(ranges_m):
        return 0.0, 10.0
    low_m = float(np.floor(ranges_m.min()))
    return low_m, max(float(min(np.ceil(np.percentile(ranges_m, 95)), 20.0)), low_m + 2.0)


def draw_image_board(
    picture: Picture, factor: int, image_board: BoardPose, board: Board, intrinsics: Intrinsics
) -> None:
    """Draw the board's outline at T_cam_board, with lens distortion, and the measured corners."""
    outline = outline_px(image_board.T_cam_board, board, intrinsics)
    width_px = max(1, round(2e-3 * picture.shape[1]))
    canvas.draw_line(picture, (outline + 0.5) * factor - 0.5, WHITE, width_px)
    if not isinstance(image_board, ImageBoard):
        return
    seen_px = image_board.corners_px[np.isfinite(image_board.corners_px[:, 0])]
    at = (seen_px + 0.5) * factor - 0.5
    canvas.draw_discs(picture, at, WHITE, 1.6e-3 * picture.shape[1], BLACK)


def _to_picture(
    points_lidar: Array, T_cam_lidar: Array, intrinsics: Intrinsics, factor: int
) -> tuple[Array, Array]:
    """Project points (N, 3) to pixels (M, 2) of the enlarged image, with the ranges (M,) of those in it."""
    points_camera = transform(T_cam_lidar, points_lidar)
    pixels, _ = intrinsics.project(points_camera)
    # Near the radius where the distortion folds, pixels hardly move.
    rho, z = np.hypot(points_camera[:, 0], points_camera[:, 1]), points_camera[:, 2]
    limit = 0.9 * intrinsics.max_radius
    is_clear = (
        np.arctan2(rho, z) < limit if intrinsics.model == "equidistant" else (z > 0) & (rho < limit * z)
    )
    is_seen = intrinsics.is_inside(pixels, -0.5) & is_clear
    ranges_m = np.linalg.norm(points_lidar, axis=1)
    return (pixels[is_seen] + 0.5) * factor - 0.5, ranges_m[is_seen]


def _draw_scan(
    picture: Picture,
    factor: int,
    scan: Scan,
    intrinsics: Intrinsics,
    T_cam_lidar: Array,
    limits_m: tuple[float, float],
    radius_px: float,
) -> None:
    pixels, ranges_m = _to_picture(np.asarray(scan.points, dtype=np.float64), T_cam_lidar, intrinsics, factor)
    most_px = np.sqrt(_MOST_COVERED * picture.shape[0] * picture.shape[1] / (np.pi * max(len(pixels), 1)))
    radius_px = float(min(radius_px, most_px))
    order = np.argsort(-ranges_m, kind="stable")
    canvas.draw_discs(picture, pixels[order], canvas.turbo(ranges_m[order], *limits_m), radius_px)


def is_overlay(path: Path) -> bool:
    """Check whether a file or folder has a name or a page from `draw_check`."""
    names_file = re.fullmatch(r"[0-9]{6,}\.png", path.name) is not None or path.name == PAGE
    return names_file or (path / PAGE).is_file()


def draw_check(
    session: Session,
    detections: Detections,
    check: SessionCheck,
    folder: Path,
    *,
    image_of: Callable[[Capture], Image | None],
    scan_of: Callable[[Capture], Scan],
    progress: Callable[[int, int], None],
) -> None:
    """Project the point cloud of every capture into its image, and write a page that shows them all.

    Args:
        session: the source of the captures.
        detections: detections of the session.
        check: result for one channel on these captures.
        folder: receives `<capture>.png` and the page.
        image_of: returns the channel's image in a capture; None if it cannot be read.
        scan_of: returns the cloud to draw in a capture.
        progress: called with (done, total).

    Raises:
        SessionError: an image cannot be written.
    """
    names, c = detections.captures(check.pair), check.calibration
    images = detections.images.get((c.camera, check.pair.channel), {})
    scans = []
    for name in names[:: max(1, len(names) // _SCANS_OF_SCALE)]:
        with suppress(SessionError):
            scans.append(scan_of(session.capture(name)))
    limits_m = range_limits(scans)
    failure = _failure(check)
    shown = []
    for done, name in enumerate(names, start=1):
        capture = session.capture(name)
        image = image_of(capture)
        if image is not None:
            # A capture whose scan cannot be read is not drawn.
            with suppress(SessionError):
                scan, board = scan_of(capture), images.get(name)
                picture = _draw(name, image, scan, session, check, board, limits_m)
                if failure:
                    picture = canvas.with_note(picture, failure, RED)
                canvas.write_picture(folder / f"{name}.png", picture)
                shown.append((name, "; ".join(_figures(name, check)), _cause(name, c)))
        progress(done, len(names))
    page = render(
        "overlays.html",
        title=f"{session.rig.name}: {check.pair}",
        verdict=c.verdict,
        n_captures=len(names),
        n_used=len(c.captures_used),
        uncertainty=sizes(c.sigma_rotation_deg, c.sigma_translation_m),
        findings=[finding.sentence for finding in (*c.findings, *check.findings)],
        limits_m=limits_m,
        other_camera=c.lidar if c.is_of_cameras else "",
        shown=shown,
    )
    write_atomically(folder / PAGE, page)


def _figures(name: str, check: SessionCheck) -> Iterator[str]:
    """List a capture's residuals, and how far a hand-held board moved between scan and image."""
    for r in check.residuals:
        if r.capture == name:
            edges = f", edges {1000 * r.edge_mean_m:.1f} mm" if math.isfinite(r.edge_mean_m) else ""
            yield f"planes {1000 * r.plane_mean_m:.1f} mm{edges}"
            if math.isfinite(r.reprojection_px):
                yield f"corners {r.reprojection_px:.2f} px"
    meeting = check.meetings.get(name)
    if meeting is not None and meeting.way_m > 0:
        yield f"moved {1000 * meeting.way_m:.1f} mm"


def _failure(check: SessionCheck) -> str:
    """List the errors of extrinsics that failed, or that the captures contradict; "" for others."""
    errors = [
        finding
        for finding in (*causes_of(check.calibration.findings), *check.findings)
        if finding.severity == "error"
    ]
    return f"FAIL: {'; '.join(finding.text for finding in errors)}" if errors else ""


def _cause(name: str, c: Calibration) -> str:
    """State why a capture was not used; "" if it was used, or belongs to another session."""
    refusal = c.captures_refused.get(name)
    if not c.captures_used or name in c.captures_used:
        return ""
    return "not used" if refusal is None else f"refused, {refusal.stage}: {refusal.sentence}"


def _draw(
    name: str,
    image: Image,
    scan: Scan,
    session: Session,
    check: SessionCheck,
    detected: object,
    limits_m: tuple[float, float],
) -> Picture:
    """Draw one capture with the board of both sensors."""
    c, meeting = check.calibration, check.meetings.get(name)
    image_board = detected if isinstance(detected, ImageBoard) else None
    if meeting is not None:
        # The board's points are drawn separately, moved to the image's time.
        points, on_board = (
            np.ascontiguousarray(p, dtype=np.float32) for p in (scan.points, meeting.measured.surface.points)
        )
        row = np.dtype((np.void, points.dtype.itemsize * 3))
        scan = scan.select(~np.isin(points.view(row).ravel(), on_board.view(row).ravel()))
    return draw_overlay(
        image,
        scan,
        session.rig.lens_of(c),
        c.T_cam_lidar,
        lidar_board=None if meeting is None else meeting.lidar_at_image_time,
        image_board=image_board if meeting is None else meeting.measured.pose,
        board=session.rig.board.to_board(),
        limits_m=limits_m,
    )


def seen_through_window(check: SessionCheck) -> tuple[SessionCheck, Array]:
    """Convert a check to the view of a virtual camera at the first LiDAR, facing the boards.

    Args:
        check: result for two LiDARs.

    Returns:
        The check for that camera, and T_camera_first (4, 4).
    """
    middles = [meeting.measured.pose.T_cam_board[:3, 3] for meeting in check.meetings.values()]
    T_view = optical_frame(np.array(middles).reshape(-1, 3))
    c = check.calibration
    seen: Calibration = replace(c, T_cam_lidar=T_view @ c.T_cam_lidar, intrinsics=_WINDOW)
    meetings = {}
    for name, meeting in check.meetings.items():
        pose = meeting.measured.pose
        moved = replace(pose, T_cam_board=T_view @ pose.T_cam_board)
        meetings[name] = replace(meeting, measured=replace(meeting.measured, pose=moved))
    return replace(check, calibration=seen, meetings=meetings), T_view


def draw_cloud(scan: Scan, T_view: Array) -> Image:
    """Draw the first LiDAR's point cloud in grey, seen by a virtual camera in its place.

    Args:
        scan: scan of the first LiDAR.
        T_view: (4, 4) transform from its frame to the camera's.
    """
    points = transform(T_view, scan.points[np.isfinite(scan.points).all(axis=1)])
    pixels, is_valid = _WINDOW.project(points)
    is_seen = is_valid & (points[:, 2] > 0) & _WINDOW.is_inside(pixels, -0.5)
    picture = np.full((_WINDOW.height_px, _WINDOW.width_px, 3), _GROUND, np.uint8)
    canvas.draw_discs(picture, pixels[is_seen], FAINT, 1.6)
    return Image(scan.sensor, "", scan.stamp_ns, picture)
