"""One image per capture: the detections of camera and LiDAR, or the cause of refusal."""

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

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
from lce_rig.show.overlays.canvas import Picture, rendered, show_image
from lce_rig.show.overlays.overlay import range_limits

# They also differ in lightness.
BRIGHTER, DARKER = "#ff4646", "#3c96ff"
# For a slow board all events of this time are drawn, for a fast one the latest per pixel.
_RECENT_NS = 100_000_000
_MOST_EVENTS_PX = 0.06
_DIM = 0.45
_DPI, _WIDTH_IN, _PANE_IN = 100, 16, 5.9
# Height, inches: of a line that the board was found, and of a refusal with its action.
_FOUND_IN, _REFUSED_IN = 0.5, 1.5
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
    """Draw the camera's image beside three views of the scan; if refused, with cause and action.

    Args:
        image: None if it could not be read.
        scan: None if it could not be read.
        image_result: the board in the image, or why it was refused.
        lidar_result: candidates, best first, or why the scan was refused.
        board: the board.
        intrinsics: the camera.
        title: one line above the drawing.
        chosen: index of the candidate used, which is drawn face on.
        mismatch: if the sensors disagree, why no candidate matches the board in the image; the best candidate
            is drawn face on in another colour.
        events: events that the image was reconstructed from; a pane below shows the latest over the image.

    Returns:
        (H, 1600, 3) uint8 BGR.
    """
    from matplotlib.figure import Figure
    from matplotlib.style import context

    rows = [["camera", "camera", "round", "round"], ["camera", "camera", "above", "face"]]
    heights_in = [0.3 * _PANE_IN, 0.7 * _PANE_IN]
    refused = isinstance(image_result, Refusal) or isinstance(lidar_result, Refusal) or mismatch is not None
    report_in = _REFUSED_IN if refused else _FOUND_IN
    if image is None or events is None:
        rows, heights_in = [*rows, ["seen", "seen", "scan", "scan"]], [*heights_in, report_in]
    else:
        rows += [["events", "events", name, name] for name in ("seen", "scan", ".")]
        heights_in += [report_in, report_in, _PANE_IN - 2 * report_in]
    height_in = sum(heights_in) + 0.4
    with context("dark_background"):
        figure: Any = Figure(figsize=(_WIDTH_IN, height_in), dpi=_DPI)
        at = {"left": 0.01, "right": 0.99, "bottom": 0.02, "top": 1 - 0.5 / height_in}
        panes = figure.subplot_mosaic(
            rows, height_ratios=heights_in, gridspec_kw=at | {"hspace": 0.12, "wspace": 0.1}
        )
        figure.text(0.01, 1 - 0.25 / height_in, title, fontsize=13)
        for name in panes.keys() & {"camera", "events", "face", "seen", "scan"}:
            panes[name].set_axis_off()
        if image is not None:
            _draw_camera(panes["camera"], image, image_result, board, intrinsics)
            if events is not None:
                _draw_events(panes["events"], image, events, image_result, board, intrinsics)
        _draw_scan(panes, scan, lidar_result, board, chosen, mismatch)
        _write(panes["seen"], "camera", image_result if isinstance(image_result, Refusal) else None)
        _write(panes["scan"], "LiDAR", lidar_result if isinstance(lidar_result, Refusal) else mismatch)
        return rendered(figure)


def _draw_camera(
    axes: Any, image: Image, result: ImageBoard | Refusal, board: Board, intrinsics: Intrinsics
) -> None:
    """Draw the detected board, or the corners in a refused image, of the pattern or a part of it."""
    show_image(axes, image.pixels)
    if isinstance(result, ImageBoard):
        axes.plot(*outline_px(result.T_cam_board, board, intrinsics).T, color="white")
        axes.plot(*result.corners_px.T, ".", color="white", markersize=4)
        # The first corner, its row (x) and its column (-y), so that a flipped order is visible.
        predicted_px, _ = intrinsics.project(transform(result.T_cam_board, board.corners()))
        corners_px = np.where(np.isfinite(result.corners_px), result.corners_px, predicted_px)
        grid_px = corners_px.reshape(board.rows, board.cols, 2)
        axes.plot(*grid_px[0].T, color=_REFUSED)
        axes.plot(*grid_px[:, 0].T, color=_FOUND)
        axes.plot(*grid_px[0, 0], "o", color=_CHOSEN, mec="white")
        axes.text(*grid_px[0, -1], " x", color=_REFUSED)
        return
    if board.has_markers:
        found_px: Array | None = marker_corners(image.grey, board)
    else:
        whole = find_grid(image.grey, board, is_thorough=False)
        found_px = seen_grid(image.grey) if whole is None else whole.grid_px
    if found_px is not None:
        axes.plot(*found_px.reshape(-1, 2).T, "o", color=_REFUSED, markersize=4, mec="black")


def recent_events(image: Image, events: Events) -> Events:
    """Keep the events shortly before an image."""
    stamp_ns = image.stamp_ns if image.stamp_ns is not None else int(events.t_ns[-1])
    recent = events.between(stamp_ns - _RECENT_NS, stamp_ns)
    n_most = round(_MOST_EVENTS_PX * events.width_px * events.height_px)
    return recent.select(slice(max(0, len(recent) - n_most), len(recent)))


def _draw_events(
    axes: Any,
    image: Image,
    events: Events,
    result: ImageBoard | Refusal,
    board: Board,
    intrinsics: Intrinsics,
) -> None:
    """Draw recent events over the image, and in grey the start and end of the board's track."""
    shown = recent_events(image, events)
    show_image(axes, (_DIM * image.pixels).astype(np.uint8))
    for is_kind, colour in ((shown.polarity, BRIGHTER), (~shown.polarity, DARKER)):
        axes.plot(shown.x[is_kind], shown.y[is_kind], "s", color=colour, markersize=2, mew=0)
    if isinstance(result, ImageBoard):
        track = () if result.track_T_cam_board is None else result.track_T_cam_board[[0, -1]]
        for T_cam_board, colour in (*((T, "0.5") for T in track), (result.T_cam_board, "white")):
            axes.plot(*outline_px(T_cam_board, board, intrinsics).T, color=colour, linewidth=1)
    span_ms = 1e-6 * float(shown.t_ns[-1] - shown.t_ns[0]) if len(shown) else 0.0
    axes.set_title(f"events of the last {span_ms:.1f} ms: red brighter, blue darker", loc="left", fontsize=9)


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
    """Write that a sensor found the board, or the refusal's cause and action."""
    state, colour = ("board found", _FOUND) if refusal is None else ("refused", _REFUSED)
    top: dict[str, Any] = {
        "xy": (0.02, 1),
        "xycoords": "axes fraction",
        "textcoords": "offset points",
        "va": "top",
    }
    pane.annotate(f"{sensor}: {state}", xytext=(0, -4), color=colour, fontsize=13, **top)
    if refusal is not None:
        words = "\n".join(fill(text, 90) for text in (refusal.text, refusal.advice))
        pane.annotate(words, xytext=(0, -28), fontsize=11, **top)
