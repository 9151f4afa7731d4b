"""Project the point cloud into the camera's image, with the board of both sensors, and recent events."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.geometry import Array, transform
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.events.figures import outline_px
from lce_rig.show.overlays import canvas
from lce_rig.show.overlays.canvas import BLACK, FAINT, INK, MAGENTA, ORANGE, WHITE, Colour, Picture

# BGR; they also differ in lightness.
BRIGHTER: Colour = (70, 70, 255)
DARKER: Colour = (255, 150, 60)
# For a slow board all events of this time are drawn, for a fast one the latest per pixel.
_RECENT_NS = 100_000_000
_MOST_EVENTS_PX = 0.06
_DIM = 0.45


@dataclass(frozen=True, eq=False)
class ImageWithEvents:
    """A camera's view.

    Attributes:
        image: the image, captured or reconstructed from events.
        events: those shortly before it; None if the image was not reconstructed here.
    """

    image: Image
    events: Events | None = None

    @classmethod
    def of_events(cls, image: Image, events: Events) -> "ImageWithEvents":
        """Keep the events shortly before an image."""
        stamp_ns = image.stamp_ns if image.stamp_ns is not None else int(events.t_ns[-1])
        recent = events.between(stamp_ns - _RECENT_NS, stamp_ns)
        n_most = round(_MOST_EVENTS_PX * events.width_px * events.height_px)
        return cls(image, recent.select(slice(max(0, len(recent) - n_most), len(recent))))


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


def draw_event_key(
    picture: Picture, events: Events, left_px: float, baseline_px: float, text_px: float
) -> None:
    """Explain the colours in one line of text."""
    span_ms = 1e-6 * float(events.t_ns[-1] - events.t_ns[0]) if len(events) else 0.0
    texts = (
        (f"events of the last {span_ms:.{0 if span_ms >= 10 else 1}f} ms:", INK),
        ("brighter", BRIGHTER),
        ("darker", DARKER),
    )
    for text, colour in texts:
        canvas.draw_text(picture, text, left_px, baseline_px, text_px, colour)
        left_px += canvas.text_width_px(text, text_px) + text_px


_MARKS = (
    ("board, LiDAR points", "point"),
    ("board, ring ends", "end"),
    ("board outline", "line"),
    ("corners", "corner"),
)
"""What the legend calls each mark, those of the LiDAR first."""

_FOLD_MARGIN = 0.9
# Points of a dense scan become smaller, so that the image remains visible between them.
_MOST_COVERED = 0.15


def draw_overlay(
    image: Image,
    scan: Scan,
    intrinsics: Intrinsics,
    T_cam_lidar: Array,
    *,
    lidar_board: LidarBoard | None,
    image_board: ImageBoard | None,
    board: Board,
    residuals: Mapping[str, str],
    title: str,
    limits_m: tuple[float, float] | None = None,
    warning: str = "",
    events: Events | None = None,
) -> Picture:
    """Project a whole scan, coloured by range, into the image, and draw both sensors' detections.

    Points behind the image plane, and those that the distortion polynomial would fold back into the image,
    are not drawn; near points are drawn last.

    Args:
        image: the image; small ones are enlarged to at least 960 px wide.
        scan: points in frame lidar.
        intrinsics: the camera.
        T_cam_lidar: (4, 4) the extrinsics to judge.
        lidar_board: its points and ring ends are marked; None for the scan only.
        image_board: its outline and corners are drawn; None for none.
        board: the board, for its outline.
        residuals: figures by name, such as {"planes": "4.2 mm"}, in display order.
        title: one line above the image.
        limits_m: ends of the range scale; those of the scan if None.
        warning: why the capture was not used, below the legend.
        events: those shortly before an image reconstructed from events; drawn below it with the board's ring
            ends and outline.

    Returns:
        (H, W, 3) uint8 BGR, with a strip above and a legend below the image.
    """
    picture, factor = canvas.enlarged(image.pixels)
    unit = picture.shape[1] / 1000
    limits_m = limits_m or range_limits([scan])
    _draw_scan(picture, factor, scan, intrinsics, T_cam_lidar, limits_m, 1.6 * unit)
    if image_board is not None:
        draw_image_board(picture, factor, image_board, board, intrinsics)
    if lidar_board is not None:
        on_board = _to_picture(lidar_board.points, T_cam_lidar, intrinsics, factor)[0]
        canvas.draw_discs(picture, on_board, MAGENTA, 1.9 * unit, WHITE)
        ends = _to_picture(lidar_board.edge_points, T_cam_lidar, intrinsics, factor)[0]
        canvas.draw_diamonds(picture, ends, ORANGE, 4.2 * unit)
    width_px, has_lidar, has_image = picture.shape[1], lidar_board is not None, image_board is not None
    strip = canvas.panel(width_px, _title_px(width_px))
    text_px = 13 * unit
    canvas.draw_text(strip, title, text_px, 1.8 * text_px, text_px, INK)
    parts = [strip, picture, draw_legend(width_px, limits_m, residuals, has_lidar, has_image)]
    if warning:
        text_px, left = 11 * unit, 16 * unit
        lines = canvas.wrapped(warning, width_px - 2 * left, text_px)
        strip = canvas.panel(width_px, round((1.9 * len(lines) + 0.8) * text_px))
        canvas.draw_paragraph(strip, warning, left, 1.4 * text_px, width_px - 2 * left, text_px, ORANGE)
        parts.append(strip)
    if events is not None:
        # The LiDAR's ring ends too, as a board's border makes events.
        below, factor = draw_events(image, events)
        if image_board is not None:
            _draw_outline(below, factor, image_board, board, intrinsics)
        if lidar_board is not None:
            ends = _to_picture(lidar_board.edge_points, T_cam_lidar, intrinsics, factor)[0]
            canvas.draw_diamonds(below, ends, ORANGE, 4.2 * unit)
        strip = canvas.panel(width_px, round(28 * unit))
        draw_event_key(strip, events, 13 * unit, 20 * unit, 11 * unit)
        parts += [strip, below]
    return np.vstack(parts)


def draw_projection(
    image: Image, scan: Scan, intrinsics: Intrinsics, T_cam_lidar: Array, limits_m: tuple[float, float]
) -> Picture:
    """Project a whole scan, coloured by range, into the image at its own size, without title and legend."""
    picture = np.array(
        image.pixels if image.pixels.ndim == 3 else np.repeat(image.pixels[..., None], 3, axis=2)
    )
    _draw_scan(picture, 1, scan, intrinsics, T_cam_lidar, limits_m, max(1.0, 1.6e-3 * picture.shape[1]))
    return picture


def camera_part(overlay: Picture, image: Image) -> Picture:
    """Cut the camera's image out of the output of `draw_overlay`, without title and legend."""
    width_px = overlay.shape[1]
    top = _title_px(width_px)
    return overlay[top : top + image.pixels.shape[0] * width_px // image.pixels.shape[1]]


def _title_px(width_px: int) -> int:
    """Height of the strip above an image."""
    return round(2.6 * 13 * width_px / 1000)


def range_limits(scans: Sequence[Scan]) -> tuple[float, float]:
    """Choose the ends of the range scale in m: the nearest point and the 95th percentile, at most 20 m."""
    ranges_m = np.concatenate([np.zeros(0), *(np.linalg.norm(scan.points, axis=1) for scan in scans)])
    if not len(ranges_m):
        return 0.0, 10.0
    low_m = float(np.floor(ranges_m.min()))
    return low_m, max(float(min(np.ceil(np.percentile(ranges_m, 95)), 20.0)), low_m + 2.0)


def draw_image_board(
    picture: Picture, factor: int, image_board: ImageBoard, board: Board, intrinsics: Intrinsics
) -> None:
    """Draw the board's outline at T_cam_board, bent as the lens bends it, and the corners as measured."""
    _draw_outline(picture, factor, image_board, board, intrinsics)
    unit = picture.shape[1] / 1000
    seen_px = image_board.corners_px[np.isfinite(image_board.corners_px[:, 0])]
    at = (seen_px + 0.5) * factor - 0.5
    canvas.draw_discs(picture, at, WHITE, 1.6 * unit, BLACK)


def _draw_outline(
    picture: Picture, factor: int, image_board: ImageBoard, board: Board, intrinsics: Intrinsics
) -> None:
    pixels = outline_px(image_board.T_cam_board, board, intrinsics)
    width_px = max(1, round(2e-3 * picture.shape[1]))
    canvas.draw_line(picture, (pixels + 0.5) * factor - 0.5, WHITE, width_px)


def _to_picture(
    points_lidar: Array, T_cam_lidar: Array, intrinsics: Intrinsics, factor: int
) -> tuple[Array, Array]:
    """Project points (N, 3) to pixels (M, 2) of the enlarged image, with the ranges (M,) of those in it."""
    points_camera = transform(T_cam_lidar, points_lidar)
    pixels, _ = intrinsics.project(points_camera)
    # Near the radius where the distortion folds, pixels hardly move.
    rho, z = np.hypot(points_camera[:, 0], points_camera[:, 1]), points_camera[:, 2]
    limit = _FOLD_MARGIN * intrinsics.max_radius
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


def draw_legend(
    width_px: int,
    limits_m: tuple[float, float],
    residuals: Mapping[str, str],
    has_lidar: bool = True,
    has_image: bool = True,
) -> Picture:
    """Explain marks and colours and list figures, in columns."""
    unit = width_px / 1000
    text_px = 11 * unit
    line_px = 2.1 * text_px
    entries = [f"{name}  {value}" for name, value in residuals.items()]
    n_columns = 2 if len(entries) > 4 else 1
    n_lines = max(4, -(-len(entries) // n_columns))
    legend = canvas.panel(width_px, round((n_lines + 0.9) * line_px))
    rows = [(0.95 + row) * line_px for row in range(n_lines)]

    marks = (_MARKS[:2] if has_lidar else ()) + (_MARKS[2:] if has_image else ())
    for (name, kind), baseline in zip(marks, rows, strict=False):
        at = np.array([[24 * unit, baseline - 0.45 * text_px]])
        if kind == "point":
            canvas.draw_discs(legend, at, MAGENTA, 4 * unit, WHITE)
        elif kind == "end":
            canvas.draw_diamonds(legend, at, ORANGE, 6 * unit)
        elif kind == "corner":
            canvas.draw_discs(legend, at, WHITE, 3 * unit, BLACK)
        else:
            line = at + [[-12 * unit, 0], [12 * unit, 0]]
            canvas.draw_line(legend, line, WHITE, max(1, round(2 * unit)))
        canvas.draw_text(legend, name, 48 * unit, baseline, text_px)
    canvas.draw_text(legend, "range from the LiDAR", 300 * unit, rows[0], text_px)
    scale = (round(300 * unit), round(rows[0] + 0.7 * text_px), round(270 * unit), round(1.3 * text_px))
    canvas.draw_scale(legend, scale, *limits_m, "m", text_px)
    per_column = -(-len(entries) // n_columns)
    for index, entry in enumerate(entries):
        left = (630 + 185 * (index // max(per_column, 1))) * unit
        canvas.draw_text(legend, entry, left, rows[index % max(per_column, 1)], text_px)
    canvas.draw_line(
        legend, np.array([[605, 8], [605, 1e3 * legend.shape[0] / width_px - 8]]) * unit, FAINT, 1, None
    )
    return legend
