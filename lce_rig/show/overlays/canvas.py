"""Anti-aliased marks and text on BGR images, and their files; sizes follow the image's width."""

import textwrap
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events
from lce_rig.core.errors import SessionError
from lce_rig.core.geometry import Array
from lce_rig.session.durable import write_atomically

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]


class Thumbnail(NamedTuple):
    """A reduced image.

    Attributes:
        pixels: (h, w) grey or (h, w, 3) BGR.
        width_px: width of the image.
    """

    pixels: Picture
    width_px: int


# By capture, camera and channel.
Thumbnails = dict[tuple[str, str, str], Thumbnail]
_THUMBNAIL_PX = 320

# BGR. The marks also differ in lightness and shape, so that they can be distinguished without hue; magenta is
# not in the turbo scale.
WHITE: Colour = (255, 255, 255)
BLACK: Colour = (0, 0, 0)
FAINT: Colour = (150, 150, 150)
MAGENTA: Colour = (235, 60, 255)
ORANGE: Colour = (60, 160, 255)
RED: Colour = (40, 40, 200)

# Text under an image: height of a line and mean width of a letter, in widths of the image; line height for
# cv2's font of scale 1, px.
_LINE, _LETTER, _FONT_PX = 0.022, 0.0085, 40.0
_SHIFT = 4  # cv2 takes sub-pixel coordinates in sixteenths
# Images have large uniform areas and thin marks: run-length encoding compresses them as well as a search, in
# half the time.
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]


def enlarged(pixels: Picture, min_width_px: int = 960) -> tuple[Picture, int]:
    """Copy an image to BGR, enlarged by a whole factor to at least `min_width_px`.

    Returns:
        The copy (H, W, 3) and the factor; a pixel at u lies at (u + 0.5) factor - 0.5 in it.
    """
    bgr = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels.copy()
    factor = max(1, -(-min_width_px // bgr.shape[1]))
    if factor > 1:
        bgr = cv2.resize(bgr, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    return np.asarray(bgr, dtype=np.uint8), factor


def reduced(pixels: Picture) -> Thumbnail:
    """Shrink an image to at most 320 px."""
    height, width = pixels.shape[:2]
    scale = min(1.0, _THUMBNAIL_PX / width, _THUMBNAIL_PX / height)
    size = max(1, round(scale * width)), max(1, round(scale * height))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return Thumbnail(np.asarray(small, dtype=np.uint8), width)


def show_image(axes: Any, pixels: Picture) -> None:
    """Show an image, grey or BGR, in Matplotlib axes, without changing their limits."""
    rgb = pixels[..., ::-1] if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
    axes.imshow(rgb, interpolation="antialiased")
    axes.autoscale(False)


def rendered(figure: Any) -> Picture:
    """Draw a figure of Matplotlib."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    drawn: Any = FigureCanvasAgg(figure)
    drawn.draw()
    return np.ascontiguousarray(np.asarray(drawn.buffer_rgba())[..., 2::-1])


def accumulated(events: Events) -> Picture:
    """Draw the number of events of each pixel (H, W), dark on white."""
    counts = np.zeros((events.height_px, events.width_px))
    np.add.at(counts, (events.y, events.x), 1.0)
    return np.asarray(np.clip(255 - 60 * counts, 0, 255), dtype=np.uint8)


def turbo(values: Array, low: float, high: float) -> NDArray[np.uint8]:
    """Colour values (N,) on the turbo scale, clipped to low..high, (N, 3) BGR."""
    if len(values) == 0:
        return np.zeros((0, 3), dtype=np.uint8)
    level = np.clip((np.asarray(values) - low) / max(high - low, 1e-9), 0, 1)
    grey = np.rint(255 * level).astype(np.uint8).reshape(-1, 1)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_TURBO), dtype=np.uint8).reshape(-1, 3)


def draw_discs(
    picture: Picture,
    pixels: Array,
    colours: NDArray[np.uint8] | Colour,
    radius_px: float,
    rim: Colour | None = None,
) -> None:
    """Draw anti-aliased discs at (N, 2) px, in order, each with a rim if requested."""
    table = np.broadcast_to(np.asarray(colours), (len(pixels), 3))
    if rim is not None:
        for centre in _fixed(pixels):
            cv2.circle(picture, centre, _length(radius_px + 1.2), rim, -1, cv2.LINE_AA, _SHIFT)
    for centre, colour in zip(_fixed(pixels), table.tolist(), strict=True):
        cv2.circle(picture, centre, _length(radius_px), colour, -1, cv2.LINE_AA, _SHIFT)


def draw_diamonds(
    picture: Picture, pixels: Array, colour: Colour, radius_px: float, rim: Colour = BLACK
) -> None:
    """Draw anti-aliased diamonds with a rim at (N, 2) px."""
    shape = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]], dtype=np.float64)
    for centre in pixels:
        for reach, tone in ((radius_px + 2.0, rim), (radius_px, colour)):
            corners = np.rint((centre + reach * shape) * 2**_SHIFT).astype(np.int32)
            cv2.fillConvexPoly(picture, corners, tone, cv2.LINE_AA, _SHIFT)


def draw_line(
    picture: Picture, pixels: Array, colour: Colour, width_px: int = 2, casing: Colour | None = BLACK
) -> None:
    """Draw a polyline through (N, 2) px, interrupted at NaN pixels, with a casing for contrast."""
    ends = np.flatnonzero(~np.isfinite(pixels).all(axis=1))
    for part in np.split(pixels, ends):
        part = part[np.isfinite(part).all(axis=1)]
        if len(part) < 2:
            continue
        path = [np.rint(part * 2**_SHIFT).astype(np.int32).reshape(-1, 1, 2)]
        if casing is not None:
            cv2.polylines(picture, path, False, casing, width_px + 2, cv2.LINE_AA, _SHIFT)
        cv2.polylines(picture, path, False, colour, width_px, cv2.LINE_AA, _SHIFT)


def with_note(picture: Picture, text: str, colour: Colour) -> Picture:
    """Add white text on a coloured band below an image."""
    line_px = _LINE * picture.shape[1]
    lines = textwrap.wrap(text, round(1 / _LETTER))
    band = np.empty((round((len(lines) + 0.5) * line_px), *picture.shape[1:]), dtype=np.uint8)
    band[:] = colour
    for k, line in enumerate(lines, start=1):
        at, width_px = (round(0.5 * line_px), round(k * line_px)), max(1, round(line_px / 18))
        cv2.putText(
            band, line, at, cv2.FONT_HERSHEY_SIMPLEX, line_px / _FONT_PX, WHITE, width_px, cv2.LINE_AA
        )
    return np.concatenate([picture, band])


def _fixed(pixels: Array) -> list[list[int]]:
    fixed: list[list[int]] = np.rint(np.asarray(pixels) * 2**_SHIFT).astype(np.int64).tolist()
    return fixed


def _length(radius_px: float) -> int:
    length: int = round(radius_px * 2**_SHIFT)
    return max(1, length)


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
