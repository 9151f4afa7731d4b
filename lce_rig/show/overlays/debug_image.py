"""One image per capture: the detections of camera and LiDAR, or the cause of refusal."""

from collections.abc import Mapping, Sequence

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, transform
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.events.figures import outline_px
from lce_rig.detect.image.corners import find_grid, seen_grid
from lce_rig.detect.image.markers import marker_corners
from lce_rig.detect.lidar.search import plane_limit_m
from lce_rig.rig import QualitySettings
from lce_rig.show.overlays import canvas
from lce_rig.show.overlays.canvas import BLACK, BLUE, FAINT, INK, MAGENTA, ORANGE, WHITE, Colour, Picture
from lce_rig.show.overlays.overlay import draw_event_key, draw_events, draw_image_board, range_limits

_PANE_PX = 800
_PANORAMA_PX = 190
_TEXT_PX = 12
_REPORT_PX = 190

# Figures beside an image, in this order, with their formats.
_IMAGE_FIGURES = {
    "distance_m": "distance {:.2f} m",
    "tilt_deg": "tilt {:.0f} deg",
    "corner_rms_px": "corners {:.2f} px rms",
    "square_px": "squares {:.0f} px",
    "sharpness": "sharpness {:.1f}",
    "contrast": "contrast {:.0f}",
    "border_px": "{:.0f} px to the border",
    "events_px_s": "{:.1f} events/px/s",
    "events_px": "{:.1f} events/px in 1 s",
    "speed_mps": "speed {:.2f} m/s",
    "turn_deg_s": "turns {:.0f} deg/s",
    "smear_m": "swept over {:.1f} mm",
}
_LIDAR_FIGURES = {
    "distance_m": "distance {:.2f} m",
    "n_rings": "{:.0f} rings",
    "n_points": "{:.0f} points",
    "plane_rms_m": "plane {:.1f} mm rms",
    "width_m": "width {:.0f} mm",
    "height_m": "height {:.0f} mm",
    "edge_rms_m": "edges {:.1f} mm rms",
}


def draw_debug(
    image: Image | None,
    scan: Scan | None,
    image_result: ImageBoard | Refusal,
    lidar_result: Sequence[LidarBoard] | Refusal,
    *,
    board: Board,
    intrinsics: Intrinsics,
    limits: QualitySettings,
    title: str,
    chosen: int = 0,
    mismatch: Refusal | None = None,
    events: Events | None = None,
) -> Picture:
    """Draw the camera's image beside three views of the scan, with figures or cause and action below.

    Args:
        image: None if it could not be read.
        scan: None if it could not be read.
        image_result: the board in the image, or why it was refused.
        lidar_result: candidates, best first, or why the scan was refused.
        board: the board.
        intrinsics: the camera.
        limits: of the profile.
        title: one line above.
        chosen: index of the candidate used, which is drawn enlarged.
        mismatch: why no candidate is the board in the image, if the sensors disagree; the best one is drawn
            enlarged and in another colour.
        events: the events shortly before an image reconstructed from events, drawn over it below.

    Returns:
        (H, 1600, 3) uint8 BGR.
    """
    candidates = [] if isinstance(lidar_result, Refusal) else list(lidar_result)
    colour = MAGENTA
    if mismatch is not None:
        best = mismatch.figures.get("candidate", 0)
        chosen, colour = best if isinstance(best, int) else 0, ORANGE
    view_px = _PANE_PX // 2
    left = _camera_pane(image, image_result, board, intrinsics, _PANORAMA_PX + view_px)
    points = np.zeros((0, 3)) if scan is None else np.asarray(scan.points, dtype=np.float64)
    limits_m = (0.0, 10.0) if scan is None else range_limits([scan])
    views = np.hstack(
        [
            _top_view(points, candidates, chosen, colour, board, limits_m, view_px),
            _board_view(points, candidates, chosen, colour, board, view_px),
        ]
    )
    right = np.vstack([_panorama(points, candidates, chosen, colour, limits_m, _PANE_PX), views])
    strip = canvas.panel(2 * _PANE_PX, 34)
    canvas.draw_text(strip, title, 14, 23, 13, INK)
    if isinstance(image_result, Refusal):
        report = _refusal("camera: refused", image_result)
    else:
        notes = ["pose ambiguous from the image alone"] if image_result.is_ambiguous else []
        report = _figures("camera: board found", image_result.figures(), _IMAGE_FIGURES, notes)
    reports = [report, _lidar_report(lidar_result, chosen, mismatch, limits)]
    above = np.hstack([left, right])
    if image is None or events is None:
        return np.vstack([strip, above, np.hstack(reports)])
    below = _event_pane(image, events, image_result, board, intrinsics, left.shape[0])
    filler = canvas.panel(_PANE_PX, left.shape[0] - 2 * _REPORT_PX)
    return np.vstack([strip, above, np.hstack([below, np.vstack([*reports, filler])])])


def _camera_pane(
    image: Image | None, result: ImageBoard | Refusal, board: Board, intrinsics: Intrinsics, height_px: int
) -> Picture:
    if image is None:
        pane = canvas.panel(_PANE_PX, height_px, BLACK)
        canvas.draw_text(pane, "no image", _PANE_PX / 2, height_px / 2, 16, FAINT, align=0.5)
        return pane
    picture, factor = canvas.enlarged(image.pixels)
    unit = picture.shape[1] / 1000
    if isinstance(result, ImageBoard):
        draw_image_board(picture, factor, result, board, intrinsics)
        # The first corner, its row (x) and its column (-y), so that a flipped order is visible.
        predicted_px, _ = intrinsics.project(transform(result.T_cam_board, board.corners()))
        corners_px = np.where(np.isfinite(result.corners_px), result.corners_px, predicted_px)
        grid = ((corners_px + 0.5) * factor - 0.5).reshape(board.rows, board.cols, 2)
        canvas.draw_line(picture, grid[0], ORANGE, max(2, round(3 * unit)))
        canvas.draw_line(picture, grid[:, 0], BLUE, max(2, round(3 * unit)))
        canvas.draw_discs(picture, grid[0, :1], MAGENTA, 6 * unit, WHITE)
        left, baseline = grid[0, -1] + 8 * unit
        canvas.draw_text(picture, "x", float(left), float(baseline), 16 * unit, ORANGE)
    else:
        # The corners detected in a refused image, of the whole pattern or a part of it, or of markers.
        whole = None if board.has_markers else find_grid(image.grey, board, is_thorough=False)
        if board.has_markers:
            grid_px: Array | None = marker_corners(image.grey, board)
        else:
            grid_px = seen_grid(image.grey) if whole is None else whole.grid_px
        if grid_px is not None:
            pixels = (grid_px.reshape(-1, 2) + 0.5) * factor - 0.5
            canvas.draw_discs(picture, pixels, ORANGE, max(1.5, 2.5 * unit), BLACK)
    return canvas.fitted(picture, _PANE_PX, height_px, BLACK)


def _event_pane(
    image: Image,
    events: Events,
    result: ImageBoard | Refusal,
    board: Board,
    intrinsics: Intrinsics,
    height_px: int,
) -> Picture:
    """Draw recent events over the image, and the board's tracked path."""
    picture, factor = draw_events(image, events)
    if isinstance(result, ImageBoard):
        poses = [result.T_cam_board]
        if result.track_T_cam_board is not None:
            poses = [result.track_T_cam_board[0], result.track_T_cam_board[-1], *poses]
        for T_cam_board, colour in zip(
            poses, ((110, 110, 110), (170, 170, 170), WHITE)[-len(poses) :], strict=True
        ):
            pixels = (outline_px(T_cam_board, board, intrinsics) + 0.5) * factor - 0.5
            canvas.draw_line(picture, pixels, colour, 1, None)
    pane = canvas.fitted(picture, _PANE_PX, height_px, BLACK)
    pane[:24] = BLACK
    draw_event_key(pane, events, 8, 16, 10)
    if isinstance(result, ImageBoard) and result.track_ns is not None:
        canvas.draw_text(pane, "grey: tracked from, and to", _PANE_PX - 8, 16, 10, FAINT, 1.0)
    return pane


def _panorama(
    points: Array,
    candidates: Sequence[LidarBoard],
    chosen: int,
    colour: Colour,
    limits_m: tuple[float, float],
    width_px: int,
) -> Picture:
    """Unroll the scan: azimuth from +180 deg at the left to -180, elevation from +20 deg to -20."""
    pane = canvas.panel(width_px, _PANORAMA_PX, BLACK)

    def place(points_lidar: Array) -> Array:
        azimuth = np.arctan2(points_lidar[:, 1], points_lidar[:, 0])
        elevation = np.degrees(
            np.arctan2(points_lidar[:, 2], np.hypot(points_lidar[:, 0], points_lidar[:, 1]))
        )
        u = (0.5 - azimuth / (2 * np.pi)) * (width_px - 1)
        return np.stack([u, 26 + (20 - elevation) / 40 * (_PANORAMA_PX - 46)], axis=1)

    ranges_m = np.linalg.norm(points, axis=1)
    order = np.argsort(-ranges_m, kind="stable")
    canvas.draw_discs(pane, place(points[order]), canvas.turbo(ranges_m[order], *limits_m), 0.9)
    for index, plate in enumerate(candidates):
        pixels = place(plate.points)
        tone = colour if index == chosen else WHITE
        canvas.draw_discs(pane, pixels, tone, 1.4)
        centre = pixels.mean(axis=0)
        _draw_number(pane, index, tone, (float(centre[0]), float(pixels[:, 1].min() - 6)))
    _label(pane, "LiDAR, unrolled")
    for degrees in (135, 90, 45, 0, -45, -90, -135):
        u = (0.5 - degrees / 360) * (width_px - 1)
        canvas.draw_text(pane, f"{degrees}", u, _PANORAMA_PX - 5, 8, FAINT, align=0.5)
    return pane


def _top_view(
    points: Array,
    candidates: Sequence[LidarBoard],
    chosen: int,
    colour: Colour,
    board: Board,
    limits_m: tuple[float, float],
    size_px: int,
) -> Picture:
    """Look down on the scan, x up and y left, with circles every metre or two."""
    reach_m = 6.0
    if candidates:
        reach_m = max(
            3.0,
            1.25 * max(float(np.linalg.norm(plate.points.mean(axis=0)[:2])) for plate in candidates),
        )
    scale = size_px / 2 / reach_m
    pane = canvas.panel(size_px, size_px, BLACK)

    def place(points_lidar: Array) -> Array:
        return size_px / 2 - scale * points_lidar[:, [1, 0]]

    step_m = 1 if reach_m <= 5 else 2
    turn = np.linspace(0, 2 * np.pi, 90)
    for radius_m in range(step_m, int(reach_m) + 1, step_m):
        circle = radius_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        canvas.draw_line(pane, place(circle), (70, 70, 70), 1, None)
        canvas.draw_text(pane, f"{radius_m} m", size_px / 2 + 3, size_px / 2 - scale * radius_m - 3, 8, FAINT)
    near = points[np.abs(points[:, :2]).max(axis=1, initial=0) < reach_m]
    colours = canvas.turbo(np.linalg.norm(near, axis=1), *limits_m)
    canvas.draw_discs(pane, place(near), colours, 0.8)
    for index, plate in enumerate(candidates):
        outline = transform(plate.T_lidar_board, board.outline())[[0, 1, 2, 3, 0]]
        tone = colour if index == chosen else WHITE
        canvas.draw_line(pane, place(outline), tone, 2)
        centre = place(plate.points.mean(axis=0)[None])[0]
        _draw_number(pane, index, tone, (float(centre[0]) + 12, float(centre[1]) - 8))
    middle = np.array([[size_px / 2, size_px / 2]])
    canvas.draw_discs(pane, middle, WHITE, 4, BLACK)
    _label(pane, "from above, x up")
    return pane


def _board_view(
    points: Array,
    candidates: Sequence[LidarBoard],
    chosen: int,
    colour: Colour,
    board: Board,
    size_px: int,
) -> Picture:
    """Look at the chosen candidate face on: returns, ring ends and the outline laid over them."""
    pane = canvas.panel(size_px, size_px, BLACK)
    if chosen >= len(candidates):
        canvas.draw_text(pane, "no board", size_px / 2, size_px / 2, 14, FAINT, align=0.5)
        return pane
    plate = candidates[chosen]
    centre = plate.T_lidar_board[:3, 3]
    # Seen from the LiDAR, up stays up: the room's axes rotated into the board's plane.
    normal = plate.plane[:3]
    right = np.cross([0.0, 0.0, 1.0], normal)
    right /= np.linalg.norm(right)
    axes = np.stack([right, -np.cross(normal, right)], axis=1)
    scale = size_px / (1.15 * np.hypot(board.width_m, board.height_m))

    def place(points_lidar: Array) -> Array:
        return np.asarray(size_px / 2 + scale * (points_lidar - centre) @ axes)

    around = points[np.linalg.norm(points - centre, axis=1) < np.hypot(board.width_m, board.height_m)]
    canvas.draw_discs(pane, place(around), (110, 110, 110), 1.5)
    canvas.draw_line(pane, place(transform(plate.T_lidar_board, board.outline())[[0, 1, 2, 3, 0]]), WHITE, 2)
    canvas.draw_discs(pane, place(plate.points), colour, 2.0)
    if colour == MAGENTA:
        canvas.draw_diamonds(pane, place(plate.edge_points), ORANGE, 4.5)
    refused = "" if colour == MAGENTA else ", refused"
    _label(pane, f"candidate {chosen + 1} of {len(candidates)}, face on{refused}")
    return pane


def _draw_number(pane: Picture, index: int, colour: Colour, at: tuple[float, float]) -> None:
    canvas.draw_text(pane, f"{index + 1}", at[0], at[1], 12, colour, align=0.5)


def _label(pane: Picture, text: str) -> None:
    pane[:24, : round(canvas.text_width_px(text, 10)) + 16] = BLACK
    canvas.draw_text(pane, text, 8, 16, 10, INK)


def _lidar_report(
    result: Sequence[LidarBoard] | Refusal, chosen: int, mismatch: Refusal | None, limits: QualitySettings
) -> Picture:
    if isinstance(result, Refusal):
        return _refusal("LiDAR: refused", result)
    if mismatch is not None:
        return _refusal("LiDAR: no candidate is the board", mismatch)
    rivals = len(result) - 1
    notes = [f"{rivals} other plate{'s' if rivals > 1 else ''} of the board's size"] if rivals else []
    figures = result[chosen].figures() if chosen < len(result) else {}
    if figures:
        limit_m = plane_limit_m(limits.max_thickness_m, figures["range_noise_m"])
        notes.append(f"plane limit {1000 * limit_m:.1f} mm")
    return _figures("LiDAR: board found", figures, _LIDAR_FIGURES, notes)


def _refusal(heading: str, refusal: Refusal) -> Picture:
    pane = canvas.panel(_PANE_PX, _REPORT_PX)
    canvas.draw_text(pane, heading, 14, 28, _TEXT_PX + 2, ORANGE)
    width_px = _PANE_PX - 120
    canvas.draw_text(pane, "seen", 14, 58, _TEXT_PX, FAINT)
    below = canvas.draw_paragraph(pane, refusal.text, 90, 58, width_px, _TEXT_PX)
    canvas.draw_text(pane, "do", 14, below + 8, _TEXT_PX, FAINT)
    canvas.draw_paragraph(pane, refusal.advice, 90, below + 8, width_px, _TEXT_PX, WHITE)
    return pane


def _figures(
    heading: str, figures: Mapping[str, float], wanted: Mapping[str, str], notes: Sequence[str]
) -> Picture:
    pane = canvas.panel(_PANE_PX, _REPORT_PX)
    canvas.draw_text(pane, heading, 14, 28, _TEXT_PX + 2, BLUE)
    lines = [
        text.format(figures[name] * (1000 if " mm" in text else 1))
        for name, text in wanted.items()
        if name in figures
    ]
    lines += notes
    for index, line in enumerate(lines):
        canvas.draw_text(pane, line, 14 + 260 * (index % 3), 62 + 26 * (index // 3), _TEXT_PX)
    return pane
