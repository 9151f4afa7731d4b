"""Outlines drawn with braille characters: two by four dots each, which every terminal shows."""

from itertools import pairwise

import numpy as np

from lce_rig.core.geometry import Array

# Bits of the dots of a braille character, by row and column; Unicode block U+2800.
_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
_STEPS = 400


def draw_outlines(
    picture_px: tuple[int, int], solid_px: Array | None, dotted_px: Array | None, size: tuple[int, int]
) -> list[str]:
    """Draw two closed polygons into a frame of the picture's shape.

    Args:
        picture_px: (width, height) of the picture.
        solid_px: (K, 2) polygon drawn as a line; None for none; NaN breaks it.
        dotted_px: (K, 2) polygon drawn dotted.
        size: (columns, rows) of characters, the frame's border included, at most.

    Returns:
        The lines.
    """
    # A character is about twice as high as wide: its dots are square.
    columns = min(size[0] - 2, round(2 * (size[1] - 2) * picture_px[0] / picture_px[1]))
    dots = np.zeros((4 * (size[1] - 2), 2 * columns), dtype=bool)
    scale = np.array(dots.shape[::-1]) / np.array(picture_px)
    for polygon, stride in ((solid_px, 1), (dotted_px, _STEPS // 12)):
        if polygon is not None:
            _draw(dots, polygon * scale, stride)
    bits = dots.reshape(size[1] - 2, 4, columns, 2).transpose(0, 2, 1, 3) * _BITS
    lines = ["".join(chr(0x2800 + int(code)) for code in row) for row in bits.sum(axis=(2, 3))]
    return [f"┌{'─' * columns}┐", *(f"│{line}│" for line in lines), f"└{'─' * columns}┘"]


def _draw(dots: np.ndarray, polygon: Array, stride: int) -> None:
    """Set the dots along a polygon, each edge sampled densely, every stride-th sample."""
    share = np.linspace(0, 1, max(_STEPS // max(len(polygon), 1), 8))[:, None]
    samples = np.concatenate([a + share * (b - a) for a, b in pairwise(polygon)])
    samples = samples[np.isfinite(samples).all(axis=1)][::stride]
    at = np.floor(samples).astype(int)
    is_inside = np.all((at >= 0) & (at < np.array(dots.shape[::-1])), axis=1)
    dots[at[is_inside, 1], at[is_inside, 0]] = True
