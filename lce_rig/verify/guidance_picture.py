"""Where the board is and where it should go, drawn into the camera's picture."""

from collections.abc import Sequence

import numpy as np

from lce_rig.core.geometry import Array
from lce_rig.verify.canvas import (
    MAGENTA,
    WHITE,
    Picture,
    draw_diamonds,
    draw_line,
    draw_text,
    enlarged,
    text_width_px,
)

GREEN = (90, 220, 90)


def draw_guidance(
    pixels: Picture,
    wanted_px: Array | None,
    present_px: Array | None,
    lines: Sequence[str] = (),
    *,
    is_there: bool = False,
) -> Picture:
    """Draw both outlines, an arrow from the board to its place, and what to do.

    Args:
        pixels: (H, W) or (H, W, 3) picture.
        wanted_px: (K, 2) closed outline of the wanted placement; None where there is none.
        present_px: (K, 2) closed outline of the board; None where it is not seen.
        lines: instructions, written below one another.
        is_there: whether the board is where it should be; outlines turn green.

    Returns:
        A BGR copy, enlarged by a whole factor where the picture is small.
    """
    picture, factor = enlarged(pixels)
    text_px = picture.shape[1] / 45

    def scaled(outline: Array) -> Array:
        return np.asarray((outline + 0.5) * factor - 0.5)

    width = max(2, round(picture.shape[1] / 400))
    if present_px is not None:
        draw_line(picture, scaled(present_px), GREEN if is_there else WHITE, width)
    if wanted_px is not None:
        draw_line(picture, scaled(wanted_px), GREEN if is_there else MAGENTA, 2 * width)
    if wanted_px is not None and present_px is not None and not is_there:
        way = np.stack([np.nanmean(scaled(present_px), axis=0), np.nanmean(scaled(wanted_px), axis=0)])
        draw_line(picture, way, MAGENTA, width)
        draw_diamonds(picture, way[1:], MAGENTA, 2.5 * width)
    for k, line in enumerate(lines):
        baseline_px = (1.6 + 1.9 * k) * text_px
        left, right = 0.6 * text_px, 1.2 * text_px + text_width_px(line, text_px)
        top, bottom = round(baseline_px - 1.3 * text_px), round(baseline_px + 0.5 * text_px)
        picture[top:bottom, round(left) : round(right)] //= 3
        draw_text(picture, line, 0.9 * text_px, baseline_px, text_px, WHITE)
    return picture
