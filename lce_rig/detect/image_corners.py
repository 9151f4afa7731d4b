"""Inner corners of a checkerboard in a grey picture, in the order of `Board.corners()`."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.detect.image_saddle import Crossings, fit_crossings, sample

Grey = NDArray[np.uint8]

# Pictures wider than this are first searched at half their size, narrower ones at twice: the finders want
# squares of 10 to 60 px.
_WIDE_PX = 700
_SEARCH_PX = 640
# Of squares of a known size, pictures are searched in which they are so large: time goes with area.
_SQUARE_PX = 12.0
_MOST_SCALE = 1.5
# A grid of another size with this share of the wanted corners is another board, not a part of the board.
_OTHER_BOARD = 0.6
_SB_THOROUGH = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK


def find_grid(
    grey: Grey, board: Board, *, is_thorough: bool = True, square_px: float | None = None
) -> Crossings | None:
    """Find the inner corners, cheapest attempt first, and fit them to sub-pixel accuracy.

    Args:
        grey: (H, W).
        board: tells the number of inner corners.
        is_thorough: whether to go on after the quick attempts, which take a tenth of the time of all.
        square_px: about how large its squares are, where that is known: only such are looked for.

    Returns:
        The crossings, `grid_px` in the order of `Board.corners()`; None where no attempt finds that many.
    """
    seen = seen_grid(grey, None if square_px is None else min(_SQUARE_PX / square_px, _MOST_SCALE))
    if seen is not None and seen.shape[:2] == (board.cols, board.rows):
        seen = seen.swapaxes(0, 1)
    if seen is not None and seen.shape[:2] == (board.rows, board.cols):
        attempts: Iterator[Array | None] = iter([seen.reshape(-1, 2)])
    elif square_px is not None:
        return None
    else:
        n_seen = 0 if seen is None else seen.shape[0] * seen.shape[1]
        is_other_seen = n_seen >= _OTHER_BOARD * board.rows * board.cols
        attempts = _attempts(grey, (board.cols, board.rows), is_other_seen, is_thorough)
    for found in attempts:
        if found is not None:
            return fit_crossings(grey, order_corners(grey, found, board).reshape(board.rows, board.cols, 2))
    return None


def seen_grid(grey: Grey, scale: float | None = None) -> Array | None:
    """Find a checkerboard of any size of at least 5x4 inner corners, in about 30 ms.

    Args:
        grey: (H, W).
        scale: of the picture that is searched; None for what suits pictures of this width.

    Returns:
        (rows, cols, 2) px; which of the two is called rows means nothing. None where nothing is found.
    """
    width = grey.shape[1]
    if scale is None:
        scale = _SEARCH_PX / width if width > _WIDE_PX else _MOST_SCALE
    level = level_contrast(_resize(grey, scale))
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    is_found, corners, meta = cv2.findChessboardCornersSBWithMeta(level, (5, 4), flags)
    full = _to_full_scale(corners, scale) if is_found else None
    return None if full is None else full.reshape(*meta.shape[:2], 2)


def order_corners(grey: Grey, corners_px: Array, board: Board) -> Array:
    """Sort a grid of corners as `Board.corners()` does, row by row from the print's top left.

    A finder may start at any of the grid's ends. A camera looks at the front of the print, so the order that
    turns from rows to columns clockwise in the picture (v points down) is the one that is not mirrored. Where
    the pattern is not symmetric under 180 deg, the outer square at the top left is black by convention; where
    it is, the order with its top row up in the picture is taken.

    Args:
        grey: (H, W) the picture, whose squares tell black from white.
        corners_px: (rows * cols, 2) row by row in any direction.
        board: the board.
    """
    grid = corners_px.reshape(board.rows, board.cols, 2)
    along_row = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    along_column = grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    if along_row[0] * along_column[1] - along_row[1] * along_column[0] < 0:
        grid = grid[:, ::-1]
    turns = (0, 1, 2, 3) if board.rows == board.cols else (0, 2)
    candidates = [np.rot90(grid, turn) for turn in turns]
    if not board.is_symmetric or len(turns) == 4:
        dark = [candidate for candidate in candidates if black_top_left(grey, candidate) > 0]
        candidates = dark or candidates
    best = min(candidates, key=lambda candidate: candidate[0, :, 1].mean() - candidate[-1, :, 1].mean())
    return np.ascontiguousarray(best.reshape(-1, 2))


def black_top_left(grey: Grey, grid_px: Array) -> float:
    """Tell by how many grey values the squares of the top left one's colour are darker than the others.

    Args:
        grey: (H, W).
        grid_px: (rows, cols, 2).
    """
    values = square_values(grey, grid_px)
    is_even = np.indices(values.shape).sum(axis=0) % 2 == 0
    return float(np.mean(values[~is_even]) - np.mean(values[is_even]))


def square_values(grey: Grey, grid_px: Array) -> Array:
    """Sample the grey value at the centre of each square between four corners, (rows - 1, cols - 1)."""
    centres = (grid_px[:-1, :-1] + grid_px[1:, :-1] + grid_px[:-1, 1:] + grid_px[1:, 1:]) / 4
    return sample(grey, centres)


def _attempts(
    grey: Grey, size: tuple[int, int], is_other_seen: bool, is_thorough: bool
) -> Iterator[Array | None]:
    """Run the finders one after the other, cheapest first; the caller stops at the first success.

    The list is fixed, not timed, so that the same picture gives the same answer on any machine. The classic
    finder takes seconds to fit one size into the squares of another: it is left out where another was seen.
    """
    width = grey.shape[1]
    if width <= _WIDE_PX:
        # A far board in a small picture, of which `seen_grid` sees a part.
        yield _sector_based(grey, size, 2.0, cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not is_thorough:
        return
    if width > _WIDE_PX:
        scale = _SEARCH_PX / width
        if not is_other_seen:
            yield _classic(grey, size, min(1.0, 1280 / width))
        level = level_contrast(_resize(grey, scale))
        yield _to_full_scale(_sector_based(level, size, 1.0, _SB_THOROUGH), scale)
        # Squares of 10 px, as of a board 5 m away, are too small at half the size.
        yield _sector_based(grey, size, min(1.0, 1280 / width), _SB_THOROUGH)
        return
    level = level_contrast(grey)
    if not is_other_seen:
        yield _classic(grey, size, 2.0)
        yield _classic(level, size, 2.0)
    yield _sector_based(level, size, 1.5, _SB_THOROUGH)
    # Squares of 4 px in a picture of full contrast, as those made from events are.
    yield _sector_based(grey, size, 2.0, _SB_THOROUGH)


def level_contrast(grey: Grey) -> Grey:
    """Bring every neighbourhood of a low-contrast picture to the same mean and spread."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    mean = cv2.GaussianBlur(smooth, (0, 0), 8.0)
    spread = np.sqrt(cv2.GaussianBlur((smooth - mean) ** 2, (0, 0), 8.0)) + 4.0
    return np.asarray(np.clip(128 + 50 * (smooth - mean) / spread, 0, 255), dtype=np.uint8)


def _sector_based(grey: Grey, size: tuple[int, int], scale: float, flags: int) -> Array | None:
    """Run `cv2.findChessboardCornersSB` (A. Duda, U. Frese, BMVC 2018) at a scale of the picture."""
    is_found, corners = cv2.findChessboardCornersSB(_resize(grey, scale), size, flags=flags)
    return _to_full_scale(corners, scale) if is_found else None


def _classic(grey: Grey, size: tuple[int, int], scale: float) -> Array | None:
    is_found, corners = cv2.findChessboardCorners(_resize(grey, scale), size, flags=_CLASSIC)
    return _to_full_scale(corners, scale) if is_found else None


def _resize(grey: Grey, scale: float) -> Grey:
    if scale == 1.0:
        return grey
    how = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=how), dtype=np.uint8)


def _to_full_scale(corners: NDArray[Any] | None, scale: float) -> Array | None:
    if corners is None:
        return None
    # Pixel centres are integers: the centre of the first pixel lies half a pixel inside the picture.
    return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
