"""One image per capture: the detections of camera and LiDAR, or the cause of refusal."""

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import cv2
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
from lce_rig.show.overlays import canvas
from lce_rig.show.overlays.canvas import BLACK, BLUE, INK, MAGENTA, ORANGE, WHITE, Colour, Picture
from lce_rig.show.overlays.overlay import draw_image_board, range_limits

# BGR; they also differ in lightness.
BRIGHTER: Colour = (70, 70, 255)
DARKER: Colour = (255, 150, 60)
# For a slow board all events of this time are drawn, for a fast one the latest per pixel.
_RECENT_NS = 100_000_000
_MOST_EVENTS_PX = 0.06
_DIM = 0.45
_DPI, _WIDTH_IN, _PANE_IN, _REPORT_IN = 100, 16, 5.9, 1.9
# As MAGENTA and ORANGE of the canvas.
_CHOSEN, _REFUSED, _FOUND, _FAINT = "#ff3ceb", "#ffa03c", "#5ab4ff", "#969696"


def draw_debug(
    image: Image | None,
    scan: Scan | None,
    image_result: ImageBoard | Refusal,
    lidar_result: Sequence[LidarBoard] | Refusal,
    *,
    board: Board,
    intrinsics: Intrinsics,
    title: str,
    chosen: int = 0,
    mismatch: Refusal | None = None,
    events: Events | None = None,
) -> Picture:
    """Draw the camera's image beside three views of the scan, with cause and action where one is refused.

    Args:
        image: None if it could not be read.
        scan: None if it could not be read.
        image_result: the board in the image, or why it was refused.
        lidar_result: candidates, best first, or why the scan was refused.
        board: the board.
        intrinsics: the camera.
        title: one line above.
        chosen: index of the candidate used, which is drawn face on.
        mismatch: why no candidate is the board in the image, if the sensors disagree; the best one is drawn
            face on and in another colour.
        events: those that an image was reconstructed from; the latest before it are drawn over it below.

    Returns:
        (H, 1600, 3) uint8 BGR.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.style import context

    rows = [["camera", "camera", "round", "round"], ["camera", "camera", "above", "face"]]
    heights_in = [0.3 * _PANE_IN, 0.7 * _PANE_IN]
    if image is None or events is None:
        rows, heights_in = [*rows, ["seen", "seen", "scan", "scan"]], [*heights_in, _REPORT_IN]
    else:
        rows += [["events", "events", name, name] for name in ("seen", "scan", ".")]
        heights_in += [_REPORT_IN, _REPORT_IN, _PANE_IN - 2 * _REPORT_IN]
    height_in = sum(heights_in) + 0.4
    with context("dark_background"):
        figure: Any = Figure(figsize=(_WIDTH_IN, height_in), dpi=_DPI)
        drawn: Any = FigureCanvasAgg(figure)
        at = {"left": 0.01, "right": 0.99, "bottom": 0.02, "top": 1 - 0.5 / height_in}
        panes = figure.subplot_mosaic(
            rows, height_ratios=heights_in, gridspec_kw=at | {"hspace": 0.12, "wspace": 0.1}
        )
        figure.text(0.01, 1 - 0.25 / height_in, title, fontsize=13)
        for name in panes.keys() & {"camera", "events", "face", "seen", "scan"}:
            panes[name].set_axis_off()
        if image is not None:
            _show(panes["camera"], _camera_picture(image, image_result, board, intrinsics))
            if events is not None:
                _show(panes["events"], _event_picture(image, events, image_result, board, intrinsics))
        _draw_scan(panes, scan, lidar_result, board, chosen, mismatch)
        _write(panes["seen"], "camera", image_result if isinstance(image_result, Refusal) else None)
        _write(panes["scan"], "LiDAR", lidar_result if isinstance(lidar_result, Refusal) else mismatch)
        drawn.draw()
    return np.ascontiguousarray(np.asarray(drawn.buffer_rgba())[..., 2::-1])


def _show(axes: Any, picture: Picture) -> None:
    axes.imshow(picture[..., ::-1], interpolation="antialiased")


def _camera_picture(
    image: Image, result: ImageBoard | Refusal, board: Board, intrinsics: Intrinsics
) -> Picture:
    """Draw the board that was detected, or the corners in a refused image, of the pattern or a part of it."""
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
        return picture
    if board.has_markers:
        grid_px: Array | None = marker_corners(image.grey, board)
    else:
        whole = find_grid(image.grey, board, is_thorough=False)
        grid_px = seen_grid(image.grey) if whole is None else whole.grid_px
    if grid_px is not None:
        pixels = (grid_px.reshape(-1, 2) + 0.5) * factor - 0.5
        canvas.draw_discs(picture, pixels, ORANGE, max(1.5, 2.5 * unit), BLACK)
    return picture


def recent_events(image: Image, events: Events) -> Events:
    """Keep the events shortly before an image."""
    stamp_ns = image.stamp_ns if image.stamp_ns is not None else int(events.t_ns[-1])
    recent = events.between(stamp_ns - _RECENT_NS, stamp_ns)
    n_most = round(_MOST_EVENTS_PX * events.width_px * events.height_px)
    return recent.select(slice(max(0, len(recent) - n_most), len(recent)))


def draw_events(image: Image, events: Events) -> tuple[Picture, int]:
    """Draw events over their image, dimmed, enlarged.

    Args:
        image: the image.
        events: each pixel gets the colour of the majority of its events.

    Returns:
        The drawing (H, W, 3) BGR and the factor, as `canvas.enlarged`.
    """
    picture, factor = canvas.enlarged(image.pixels)
    dimmed = picture.astype(np.float32) * _DIM + 30
    shape = image.pixels.shape[:2]
    sums = np.zeros(shape, dtype=np.int32)
    is_inside = (events.x < shape[1]) & (events.y < shape[0])
    inside = events.select(is_inside)
    np.add.at(sums, (inside.y, inside.x), np.where(inside.polarity, 1, -1))
    for is_coloured, colour in ((sums > 0, BRIGHTER), (sums < 0, DARKER)):
        large = cv2.resize(
            is_coloured.astype(np.uint8), None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST
        )
        dimmed[large > 0] = colour
    return np.asarray(np.clip(dimmed, 0, 255), dtype=np.uint8), factor


def _event_picture(
    image: Image, events: Events, result: ImageBoard | Refusal, board: Board, intrinsics: Intrinsics
) -> Picture:
    """Draw recent events over the image, and in grey from where and to where the board was tracked."""
    events = recent_events(image, events)
    picture, factor = draw_events(image, events)
    if isinstance(result, ImageBoard):
        track = result.track_T_cam_board
        ends = [] if track is None else [(track[0], (110, 110, 110)), (track[-1], (170, 170, 170))]
        for T_cam_board, colour in [*ends, (result.T_cam_board, WHITE)]:
            pixels = (outline_px(T_cam_board, board, intrinsics) + 0.5) * factor - 0.5
            canvas.draw_line(picture, pixels, colour, 1, None)
    picture[:24] = BLACK
    span_ms = 1e-6 * float(events.t_ns[-1] - events.t_ns[0]) if len(events) else 0.0
    left_px, text_px = 8.0, 10
    for text, colour in (
        (f"events of the last {span_ms:.{0 if span_ms >= 10 else 1}f} ms:", INK),
        ("brighter", BRIGHTER),
        ("darker", DARKER),
    ):
        canvas.draw_text(picture, text, left_px, 16, text_px, colour)
        left_px += canvas.text_width_px(text, text_px) + text_px
    return picture


def _draw_scan(
    panes: Mapping[str, Any],
    scan: Scan | None,
    result: Sequence[LidarBoard] | Refusal,
    board: Board,
    chosen: int,
    mismatch: Refusal | None,
) -> None:
    """Draw the scan unrolled, from above (x up) and facing the chosen candidate, coloured by range."""
    candidates = [] if isinstance(result, Refusal) else list(result)
    colour = _CHOSEN if mismatch is None else _REFUSED
    if mismatch is not None:
        best = mismatch.figures.get("candidate", 0)
        chosen = best if isinstance(best, int) else 0
    points = np.zeros((0, 3)) if scan is None else np.asarray(scan.points, dtype=np.float64)
    low_m, high_m = (0.0, 10.0) if scan is None else range_limits([scan])
    by_range = {"c": np.linalg.norm(points, axis=1), "cmap": "turbo", "vmin": low_m, "vmax": high_m}
    middles = [plate.points.mean(axis=0) for plate in candidates]
    reach_m = max(3.0, 1.25 * max((float(np.linalg.norm(m[:2])) for m in middles), default=4.8))
    unrolled, above, face = panes["round"], panes["above"], panes["face"]
    unrolled.scatter(*_angles_deg(points), s=1.5, linewidths=0, **by_range)
    above.scatter(points[:, 1], points[:, 0], s=1, linewidths=0, **by_range)
    for k, (plate, middle) in enumerate(zip(candidates, middles, strict=True)):
        tone, number = colour if k == chosen else "white", str(k + 1)
        azimuth, elevation = _angles_deg(plate.points)
        unrolled.plot(azimuth, elevation, ".", color=tone, markersize=2.5)
        unrolled.text(azimuth.mean(), elevation.max() + 1, number, color=tone, ha="center")
        outline = transform(plate.T_lidar_board, board.outline())[[0, 1, 2, 3, 0]]
        above.plot(outline[:, 1], outline[:, 0], color=tone)
        above.text(middle[1] - 0.04 * reach_m, middle[0], number, color=tone)
    above.plot(0, 0, "wo")
    elevation_deg = _angles_deg(points)[1] if len(points) else np.array([-15.0, 15.0])
    low, high = float(elevation_deg.min()), float(elevation_deg.max())
    # Room for azimuths below and a candidate's number above.
    margin = 0.1 * max(high - low, 10.0)
    limits = low - 2.5 * margin, high + 1.5 * margin
    unrolled.set(xlim=(180, -180), ylim=limits, xticks=range(-135, 136, 45), yticks=[])
    above.set(xlim=(reach_m, -reach_m), ylim=(-reach_m, reach_m), aspect="equal", xticks=[])
    # Labels at the ends would be cut by the frame.
    above.set_yticks([y for y in above.get_yticks() if abs(y) < 0.95 * reach_m])
    unrolled.tick_params(axis="x", direction="in", length=0, pad=-15, colors=_FAINT)
    above.tick_params(axis="y", direction="in", length=0, pad=-20, colors=_FAINT)
    above.grid(color="#404040", linewidth=0.5)
    unrolled.set_title("LiDAR, unrolled, deg", loc="left", fontsize=9)
    above.set_title("from above, x up, m", loc="left", fontsize=9)
    if chosen >= len(candidates):
        face.text(0.5, 0.5, "no board", color=_FAINT, ha="center", transform=face.transAxes)
        return
    plate = candidates[chosen]
    centre, normal = plate.T_lidar_board[:3, 3], plate.plane[:3]
    # Seen from the LiDAR, up stays up: the room's axes rotated into the board's plane.
    right = np.cross([0.0, 0.0, 1.0], normal)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(normal, right)], axis=1)
    size_m = float(np.hypot(board.width_m, board.height_m))
    around = points[np.linalg.norm(points - centre, axis=1) < size_m]
    outline = transform(plate.T_lidar_board, board.outline())[[0, 1, 2, 3, 0]]
    face.plot(*((around - centre) @ axes).T, ".", color="#6e6e6e", markersize=3)
    face.plot(*((outline - centre) @ axes).T, color="white")
    face.plot(*((plate.points - centre) @ axes).T, ".", color=colour, markersize=4)
    face.plot(*((plate.edge_points - centre) @ axes).T, "D", color=_REFUSED, markersize=4, mec="black")
    face.set(xlim=(-0.6 * size_m, 0.6 * size_m), ylim=(-0.6 * size_m, 0.6 * size_m), aspect="equal")
    refused = "" if mismatch is None else ", refused"
    face.set_title(f"candidate {chosen + 1} of {len(candidates)}, face on{refused}", loc="left", fontsize=9)


def _angles_deg(points: Array) -> tuple[Array, Array]:
    """Compute azimuths and elevations (N,)."""
    level = np.hypot(points[:, 0], points[:, 1])
    return np.degrees(np.arctan2(points[:, 1], points[:, 0])), np.degrees(np.arctan2(points[:, 2], level))


def _write(pane: Any, sensor: str, refusal: Refusal | None) -> None:
    """State that a sensor found the board, or why not and what to do."""
    state, colour = ("board found", _FOUND) if refusal is None else ("refused", _REFUSED)
    pane.text(0.02, 0.95, f"{sensor}: {state}", color=colour, fontsize=13, va="top")
    if refusal is not None:
        words = "\n".join(fill(text, 90) for text in (refusal.text, refusal.advice))
        pane.text(0.02, 0.75, words, fontsize=11, va="top")
