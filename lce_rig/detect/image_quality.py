"""What a picture shows of the board in numbers, and in words where it shows too little."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import Refusal
from lce_rig.detect.image_corners import seen_grid, square_values
from lce_rig.detect.image_saddle import Crossings

#: What events need to show a board.
MOVE_SLOWLY = "move the board sideways slowly, about 10 cm/s, from a second before the capture on"
# 10 to 90 % of an edge blurred by a Gaussian span 2.56 sigma.
_EDGE_WIDTH_PER_SIGMA = 2.56


def grid_quality(grey: NDArray[np.uint8], crossings: Crossings) -> dict[str, float]:
    """Measure the corners' surroundings.

    Returns:
        mean_grey; contrast (grey values, white minus black); noise (grey values); square_px (shortest side);
        edge_width_px (10-90 %); sharpness (edge widths in a square: 1 is unreadable, above 5 is crisp);
        border_px (outermost corner to the border of the picture); n_corners (fitted).
    """
    grid = crossings.grid_px
    height, width = grey.shape
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1) for axis in (0, 1)]
    square_px = float(min(side.min() for side in sides))
    edge_width_px = _EDGE_WIDTH_PER_SIGMA * float(np.median(crossings.edge_sigma_px[crossings.is_fitted]))
    alternating = crossings.contrast * (-1.0) ** np.indices(crossings.contrast.shape).sum(axis=0)
    alternating *= -1.0 if np.median(alternating) < 0 else 1.0
    contrast = float(np.median(alternating))
    to_border = np.minimum(grid, [width - 1, height - 1] - grid).min()
    return {
        "mean_grey": float(grey.mean()),
        "contrast": contrast,
        "noise": crossings.noise,
        "square_px": square_px,
        "edge_width_px": edge_width_px,
        "sharpness": square_px / edge_width_px if edge_width_px > 0 else 0.0,
        "border_px": float(to_border),
        "n_corners": float(crossings.is_fitted.sum()),
    }


def extent(grey: NDArray[np.uint8], grid_px: Array) -> tuple[float, bool]:
    """Check that the pattern ends where the grid of corners says.

    The squares outside the outermost corners must alternate as those inside do, the next ones must not.

    Args:
        grid_px: (rows, cols, 2).

    Returns:
        Contrast of the weakest side of outer squares over that of the inner squares, 1 on a clean board, and
        whether the squares go on beyond them on some side, so that only a part of a larger board was taken.
    """
    wide = _widened(_widened(grid_px))
    height, width = grey.shape
    # Pixels beyond the border repeat its value, which alternates with nothing.
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


def _widened(grid_px: Array) -> Array:
    """Extrapolate one more line of corners on every side."""
    wide = np.concatenate(
        [2 * grid_px[:, :1] - grid_px[:, 1:2], grid_px, 2 * grid_px[:, -1:] - grid_px[:, -2:-1]], axis=1
    )
    return np.concatenate([2 * wide[:1] - wide[1:2], wide, 2 * wide[-1:] - wide[-2:-1]])


def _alternation(values: Array, signs: Array) -> float:
    """Measure by how much the values of positive sign exceed the others."""
    return float(values[signs > 0].mean() - values[signs < 0].mean())


def explain_absence(grey: NDArray[np.uint8], board: Board, is_from_events: bool = False) -> Refusal:
    """Say why the board was not found, from the grey values and from what checkerboard is there instead."""
    wanted = f"{board.cols}x{board.rows}"
    low, dark, bright = (float(value) for value in np.percentile(grey, (1, 50, 99)))
    if bright < 50:
        return Refusal(
            "image", f"too dark: 99 % of the picture below grey {bright:.0f}", "expose longer or add light"
        )
    if np.mean(grey >= 250) > 0.5:
        cause = f"overexposed: {100 * np.mean(grey >= 250):.0f} % of the picture is white"
        return Refusal("image", cause, "expose shorter or turn the board away from the light")
    seen = seen_grid(grey)
    if seen is not None:
        return explain_other_grid(grey, board, seen, is_from_events)
    if bright - low < 50:
        cause = f"contrast too low: grey values {low:.0f} to {bright:.0f}, no {wanted} inner corners seen"
        too_few = "move the board while events are recorded: only moving edges make them"
        return Refusal("image", cause, too_few if is_from_events else "light the board, expose longer")
    width_px = strongest_edge_px(grey, bright - low)
    if width_px > 6:
        cause = f"too blurred: the sharpest edges are {width_px:.0f} px wide, no {wanted} inner corners seen"
        action = MOVE_SLOWLY if is_from_events else "hold the board still, expose shorter, focus the lens"
        return Refusal("image", cause, action)
    action = (
        "show the whole print, uncovered; inner corners are where four squares meet, one less than squares"
    )
    return Refusal(
        "image",
        f"no board: {wanted} inner corners wanted, none seen (median grey {dark:.0f})",
        f"{action}; {MOVE_SLOWLY}" if is_from_events else action,
    )


def explain_other_grid(
    grey: NDArray[np.uint8], board: Board, seen_px: Array, is_from_events: bool = False
) -> Refusal:
    """Say that another grid of corners is in the picture than the profile's.

    Args:
        seen_px: (rows, cols, 2).
    """
    wanted, seen = _sizes(board, seen_px)
    text = f"{wanted[0]}x{wanted[1]} inner corners wanted, {seen[0]}x{seen[1]} seen"
    if seen == wanted:
        return Refusal(
            "image",
            f"the {wanted[0]}x{wanted[1]} inner corners are there but too unclear to measure",
            f"{MOVE_SLOWLY}; come closer"
            if is_from_events
            else "hold the board still, closer and better lit",
        )
    is_part = seen[0] <= wanted[0] and seen[1] <= wanted[1]
    side = _side_beyond(grey, seen_px)
    if is_part and side:
        return Refusal(
            "image",
            f"board cut off by the {side} border: {text}",
            f"move the board away from the {side} border",
        )
    if is_part:
        action = (
            "uncover the whole print; if it has these corners, correct board.inner_corners in the profile"
        )
        return Refusal("image", text, f"{MOVE_SLOWLY}; {action}" if is_from_events else action)
    return Refusal(
        "image", text, "correct board.inner_corners in the profile: one less than squares along each side"
    )


def quality_problem(
    quality: Mapping[str, float], min_contrast: float, min_sharpness: float, is_from_events: bool = False
) -> Refusal | None:
    """Judge the figures of a grid that was found; None where they will do."""
    if quality["contrast"] < min_contrast:
        cause = f"contrast too low: black and white differ by {quality['contrast']:.0f} grey values"
        cause += f" ({min_contrast:.0f} needed)"
        return Refusal("image", cause, MOVE_SLOWLY if is_from_events else "expose longer or add light")
    if quality["sharpness"] < min_sharpness:
        cause = f"too blurred: edges {quality['edge_width_px']:.1f} px wide on squares of"
        cause += f" {quality['square_px']:.1f} px"
        cause += f" ({min_sharpness:g} edge widths a square needed)" if is_from_events else ""
        still = "hold the board still, expose shorter, come closer, focus the lens"
        return Refusal("image", cause, f"{MOVE_SLOWLY}; come closer" if is_from_events else still)
    return None


def _sizes(board: Board, seen_px: Array) -> tuple[tuple[int, int], tuple[int, int]]:
    """Name wanted and seen size (cols, rows), the seen one turned the way that is nearer to the wanted."""
    rows, cols = seen_px.shape[:2]
    wanted = (board.cols, board.rows)
    either = ((cols, rows), (rows, cols))
    seen = min(either, key=lambda size: abs(size[0] - wanted[0]) + abs(size[1] - wanted[1]))
    return wanted, seen


def _side_beyond(grey: NDArray[np.uint8], grid_px: Array) -> str:
    """Name the border within 1.5 squares of the grid; empty where there is none."""
    height, width = grey.shape
    square = max(float(np.linalg.norm(np.diff(grid_px, axis=axis), axis=-1).max()) for axis in (0, 1))
    low, high = grid_px.min(axis=(0, 1)), grid_px.max(axis=(0, 1))
    room = {
        "left": low[0],
        "upper": low[1],
        "right": width - 1 - high[0],
        "lower": height - 1 - high[1],
    }
    side = min(room, key=lambda name: float(room[name]))
    return side if room[side] < 1.5 * square else ""


def strongest_edge_px(grey: NDArray[np.uint8], spread: float) -> float:
    """Measure the width of the strongest edges: grey spread over the 99.9 percentile of the gradient."""
    dv, du = np.gradient(grey.astype(np.float32))
    return spread / max(float(np.percentile(np.hypot(du, dv), 99.9)), 1e-3)
