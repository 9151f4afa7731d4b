"""Figures of the board in an image, and the resulting refusals."""

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.findings import Figure, Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import ImageQuality
from lce_rig.detect.findings import (
    IMAGE_BLURRED,
    IMAGE_CUT_OFF,
    IMAGE_LOW_CONTRAST,
    IMAGE_NO_BOARD,
    IMAGE_OTHER_BOARD,
    IMAGE_OVEREXPOSED,
    IMAGE_PART,
    IMAGE_TOO_DARK,
    IMAGE_UNCLEAR,
)
from lce_rig.detect.image.corners import seen_grid, square_values
from lce_rig.detect.image.saddle import Crossings
from lce_rig.rig import QualitySettings

# 10 to 90 % of an edge blurred by a Gaussian span 2.56 sigma.
_EDGE_WIDTH_PER_SIGMA = 2.56
LEAST_SQUARE_PX = 5.0
"""Least side of a square, foreshortened by the tilt, from which corners are found without fail."""
LEAST_MARKED_PX = 20.0
"""Least side of a square with a marker, or of a tag, from which markers are read without fail."""
# Limits of camera images: minimum contrast of black and white, grey values; minimum edge widths per square.
_MIN_CONTRAST, _MIN_SHARPNESS = 12.0, 1.5
# Limits of images without a board: minimum grey spread, and maximum width of the strongest edges, px.
_MIN_SPREAD, _MAX_EDGE_PX = 50.0, 6.0
# Minimum ratio of the outer squares' contrast to the inner ones'; off the board, a row has no contrast.
_MIN_OUTER_CONTRAST = 0.35


def grid_quality(grey: NDArray[np.uint8], crossings: Crossings) -> ImageQuality:
    """Measure the surroundings of the corners; NaN corners are hidden."""
    grid = crossings.grid_px
    height, width = grey.shape
    is_seen = np.isfinite(grid[..., 0])
    square_px = _shortest_side_px(grid)
    edge_width_px = _EDGE_WIDTH_PER_SIGMA * float(np.median(crossings.edge_sigma_px[crossings.is_fitted]))
    alternating = crossings.contrast * (-1.0) ** np.indices(crossings.contrast.shape).sum(axis=0)
    contrast = float(abs(np.median(alternating[is_seen])))
    to_border = np.nanmin(np.minimum(grid, [width - 1, height - 1] - grid))
    return ImageQuality(
        contrast=contrast,
        square_px=square_px,
        edge_width_px=edge_width_px,
        sharpness=square_px / edge_width_px if edge_width_px > 0 else 0.0,
        border_px=float(to_border),
        n_corners=int(crossings.is_fitted.sum()),
    )


def _shortest_side_px(grid_px: Array) -> float:
    """Return a square's shortest side, px; estimated from other corners if no neighbours are visible."""
    sides = [np.linalg.norm(np.diff(grid_px, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    lengths = np.concatenate(sides)
    if np.isfinite(lengths).any():
        return float(np.nanmin(lengths))
    places = np.argwhere(np.isfinite(grid_px[..., 0]))
    seen_px = grid_px[tuple(places.T)]
    first, second = np.triu_indices(len(places), k=1)
    n_sides = np.linalg.norm(places[first] - places[second], axis=-1)
    return float(np.min(np.linalg.norm(seen_px[first] - seen_px[second], axis=-1) / n_sides))


def extent(grey: NDArray[np.uint8], grid_px: Array) -> tuple[float, bool]:
    """Check whether the grid of corners covers the whole pattern.

    The row of squares around the outermost corners must alternate like the inner squares; the next row
    outwards must not.

    Args:
        grey: (H, W) the image.
        grid_px: (rows, cols, 2) the corners.

    Returns:
        Lowest contrast of the four surrounding rows, relative to the inner squares (1 on a clean board), and
        whether the squares continue beyond any of them: then the grid is part of a larger board.
    """
    wide = _widened(_widened(grid_px))
    height, width = grey.shape
    # Pixels beyond the border repeat its value and therefore do not alternate.
    values = square_values(grey, np.clip(wide, 0, [width - 1, height - 1]))
    signs = (-1.0) ** np.indices(values.shape).sum(axis=0)
    inner = _alternation(values[2:-2, 2:-2], signs[2:-2, 2:-2])
    if inner == 0:
        return 0.0, False
    signs, inner = signs * np.sign(inner), abs(inner)
    sides = [(np.rot90(values, turn), np.rot90(signs, turn)) for turn in range(4)]
    outer = [_alternation(value[1, 1:-1], sign[1, 1:-1]) / inner for value, sign in sides]
    beyond = [_alternation(value[0, 1:-1], sign[0, 1:-1]) / inner for value, sign in sides]
    steps = [np.diff(value[0, 1:-1]) * sign[0, 2:-1] for value, sign in sides]
    is_beyond = any(ratio > 0.5 and bool(np.all(step > 0)) for ratio, step in zip(beyond, steps, strict=True))
    return min(outer), is_beyond


def is_whole(grey: NDArray[np.uint8], grid_px: Array) -> bool:
    """Check that a grid of corners covers a whole pattern, so that its size identifies the board."""
    outer_contrast, goes_on = extent(grey, grid_px)
    return outer_contrast >= _MIN_OUTER_CONTRAST and not goes_on


def _widened(grid_px: Array) -> Array:
    """Extrapolate one more line of corners on every side."""
    wide = np.concatenate(
        [2 * grid_px[:, :1] - grid_px[:, 1:2], grid_px, 2 * grid_px[:, -1:] - grid_px[:, -2:-1]], axis=1
    )
    return np.concatenate([2 * wide[:1] - wide[1:2], wide, 2 * wide[-1:] - wide[-2:-1]])


def _alternation(values: Array, signs: Array) -> float:
    """Compute the mean difference between the values of positive and of negative sign."""
    return float(values[signs > 0].mean() - values[signs < 0].mean())


def explain_absence(grey: NDArray[np.uint8], board: Board, is_from_events: bool = False) -> Refusal:
    """Return why the board was not found, from the grey values and from other checkerboards in the image."""
    low, dark, bright = (float(value) for value in np.percentile(grey, (1, 50, 99)))
    if bright < 50:
        return IMAGE_TOO_DARK.refusal(grey_99=bright)
    white_share = float(np.mean(grey >= 250))
    if white_share > 0.5:
        return IMAGE_OVEREXPOSED.refusal(white_share=white_share)
    seen = None if board.has_markers else seen_grid(grey)
    if seen is not None:
        return explain_other_grid(grey, board, seen, is_from_events)
    wanted = {"n_cols": board.cols, "n_rows": board.rows}
    action = "events" if is_from_events else ""
    if bright - low < _MIN_SPREAD:
        return IMAGE_LOW_CONTRAST.refusal(action=action, contrast=bright - low, min_contrast=_MIN_SPREAD)
    # The width of the strongest edges: grey spread over the 99.9 percentile of the gradient.
    dv, du = np.gradient(grey.astype(np.float32))
    edge_px = (bright - low) / max(float(np.percentile(np.hypot(du, dv), 99.9)), 1e-3)
    if edge_px > _MAX_EDGE_PX:
        return IMAGE_BLURRED.refusal(action=action, edge_px=edge_px, max_edge_px=_MAX_EDGE_PX)
    return IMAGE_NO_BOARD.refusal(action=action, **wanted, grey_50=dark)


def explain_other_grid(
    grey: NDArray[np.uint8], board: Board, seen_px: Array, is_from_events: bool = False
) -> Refusal:
    """Report that the image shows a grid of another size than the profile's, or only part of it.

    The number of detected corners is stated only for a whole pattern.

    Args:
        grey: (H, W) the image.
        board: the expected board.
        seen_px: (rows, cols, 2).
        is_from_events: whether the image was reconstructed from events.
    """
    rows, cols = seen_px.shape[:2]
    wanted = board.cols, board.rows
    # Orient the grid like the board.
    turned = ((cols, rows), (rows, cols))
    seen = min(turned, key=lambda size: abs(size[0] - wanted[0]) + abs(size[1] - wanted[1]))
    figures: dict[str, Figure] = {"n_cols": wanted[0], "n_rows": wanted[1]}
    action = "events" if is_from_events else ""
    if seen == wanted:
        return IMAGE_UNCLEAR.refusal(action=action, **figures)
    is_part = seen[0] <= wanted[0] and seen[1] <= wanted[1]
    height, width = grey.shape
    low, high = seen_px.min(axis=(0, 1)), seen_px.max(axis=(0, 1))
    to_border = {"left": low[0], "upper": low[1], "right": width - 1 - high[0], "lower": height - 1 - high[1]}
    side = min(to_border, key=lambda name: float(to_border[name]))
    square = max(float(np.linalg.norm(np.diff(seen_px, axis=axis), axis=-1).max()) for axis in (0, 1))
    if is_part and to_border[side] < 1.5 * square:
        return IMAGE_CUT_OFF.refusal(**figures, side=side)
    if is_whole(grey, seen_px):
        figures |= {"n_cols_seen": seen[0], "n_rows_seen": seen[1]}
    if is_part:
        # A pattern that continues beyond the detected corners is neither covered nor another one.
        kind = IMAGE_UNCLEAR if extent(grey, seen_px)[1] else IMAGE_PART
        return kind.refusal(action=action, **figures)
    return IMAGE_OTHER_BOARD.refusal(**figures)


def quality_problem(
    quality: ImageQuality, limits: QualitySettings, is_from_events: bool = False
) -> Refusal | None:
    """Compare the figures of a detected grid with the limits; None if they are sufficient."""
    action = "events" if is_from_events else ""
    min_contrast = limits.min_event_contrast if is_from_events else _MIN_CONTRAST
    min_sharpness = limits.min_event_sharpness if is_from_events else _MIN_SHARPNESS
    if quality.contrast < min_contrast:
        return IMAGE_LOW_CONTRAST.refusal(action=action, contrast=quality.contrast, min_contrast=min_contrast)
    if quality.sharpness < min_sharpness:
        max_edge_px = quality.square_px / min_sharpness
        return IMAGE_BLURRED.refusal(action=action, edge_px=quality.edge_width_px, max_edge_px=max_edge_px)
    return None
